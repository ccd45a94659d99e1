"""LightSim: a lighting simulator for driving logs."""

__version__ = "0.1.0"
