"""Resizing keeps the mean and is exact on linear ramps."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.resample import resize_area


@pytest.mark.parametrize("size", [(4, 8), (5, 7), (3, 16), (12, 16)])
def test_mean_is_kept(rng: np.random.Generator, size: tuple[int, int]) -> None:
    image = rng.random((12, 16, 3)).astype(np.float32)
    again = resize_area(image, *size)
    assert again.shape == (*size, 3)
    np.testing.assert_allclose(again.mean((0, 1)), image.mean((0, 1)), rtol=1e-5)


def test_fractional_box_is_exact() -> None:
    """Three pixels into two: the middle one is shared half and half."""
    image = np.array([[1.0, 2.0, 4.0]], np.float32)[..., None]
    np.testing.assert_allclose(resize_area(image, 1, 2)[0, :, 0], [4 / 3, 10 / 3], rtol=1e-6)
