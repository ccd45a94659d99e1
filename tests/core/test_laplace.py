"""Holes in grids: harmonic between what is known."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.laplace import fill_smoothly


@pytest.mark.parametrize("gap", [7, 2000])
def test_holes_are_harmonic_with_mirrored_borders(gap: int) -> None:
    """Between two known columns a straight line, whatever the rows; beyond them, constant.

    Across 2000 cells an iterative solver without its status checked stops half-way.
    """
    expected = np.tile(np.clip(np.arange(gap + 5.0) - 2.0, 0.0, gap) * 3.0, (5, 1))
    is_known = np.zeros(expected.shape, dtype=bool)
    is_known[:, [2, gap + 2]] = True
    filled = fill_smoothly(np.where(is_known, expected, 99.0), is_known)
    np.testing.assert_allclose(filled, expected, rtol=1e-8, atol=1e-8)
    np.testing.assert_array_equal(filled[is_known], expected[is_known])
