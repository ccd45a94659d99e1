"""Holes in grids: harmonic between what is known."""

from __future__ import annotations

import numpy as np

from lightsim.core.laplace import fill_smoothly


def test_holes_are_harmonic_with_mirrored_borders() -> None:
    """Between two known columns a straight line, whatever the rows; beyond them, constant."""
    expected = np.tile(np.clip(np.arange(12.0) - 2.0, 0.0, 7.0) * 3.0, (5, 1))
    is_known = np.zeros((5, 12), dtype=bool)
    is_known[:, [2, 9]] = True
    filled = fill_smoothly(np.where(is_known, expected, 99.0), is_known)
    np.testing.assert_allclose(filled, expected, atol=1e-3)
    np.testing.assert_array_equal(filled[is_known], expected[is_known])
