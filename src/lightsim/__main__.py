"""`python -m lightsim`."""

from lightsim.cli import main

main()
