"""Building blocks of networks (torch) for several stages. Like core, it imports no stage."""
