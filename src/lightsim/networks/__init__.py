"""Building blocks of networks (torch) that several stages share. Like core, it imports no stage."""
