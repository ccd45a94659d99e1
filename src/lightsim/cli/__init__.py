"""Command line of LightSim; entry point `main`."""

from lightsim.cli.app import main

__all__ = ["main"]
