"""Sensors, path and boxes of a log brought into agreement before anything is built from it."""
