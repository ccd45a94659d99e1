"""Entry point of `python -m lightsim`."""

from lightsim.cli import main

main()
