"""Training of the networks that ship with the package: data, loops, command line's functions."""
