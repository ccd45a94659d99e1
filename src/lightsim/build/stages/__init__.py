"""Stages of the build, one module each; pipeline.py defines their order."""
