"""Styles of the synthetic street: one builder and one table of dimensions and finishes each."""
