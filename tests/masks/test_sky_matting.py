"""Soft borders of the sky matte."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.colour import srgb8_from_linear
from lightsim.masks.sky_matting import _thin_lines

_FINE = 8


@pytest.mark.parametrize("width_px", [1.0, 1.6])
@pytest.mark.parametrize("darkness", [0.02, 0.3])
def test_a_wire_covers_the_fraction_of_each_pixel_that_it_covers(
    width_px: float, darkness: float
) -> None:
    """Drawn eight times as fine and averaged in linear light, aslant over an even sky."""
    row, column = (np.mgrid[: 120 * _FINE, : 320 * _FINE] + 0.5) / _FINE
    away = np.abs((row - 60) - 0.4 * (column - 160)) / np.hypot(1, 0.4)
    cover = (away < width_px / 2).reshape(120, _FINE, 320, _FINE).mean(axis=(1, 3))
    linear = np.repeat(0.4 * (1 - cover * (1 - darkness))[..., None], 3, axis=2)
    error = _thin_lines(srgb8_from_linear(linear.astype(np.float32))) - cover
    assert np.abs(error).mean(where=cover > 0) < 0.1
    assert np.abs(error).max(where=cover == 0, initial=0) == 0
