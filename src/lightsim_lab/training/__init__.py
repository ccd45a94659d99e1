"""Training of the shipped networks: data, loops, and the functions of the commands."""
