"""Alignment of a log's cameras, ego path and actor boxes before the twin is built from it."""
