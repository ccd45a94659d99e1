"""Soft borders of the sky matte."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.colour import srgb8_from_linear
from lightsim.masks.sky_matting import _long, _thin_lines, refine_matte
from lightsim.masks.sky_regions import ImageEvidence

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


def test_specks_in_the_open_sky_are_clouds_and_wires_and_twigs_are_not() -> None:
    is_matter = np.zeros((100, 200), bool)
    is_matter[80:] = True
    wire, twig, specks, cloud = (np.zeros((100, 200), np.float32) for _ in range(4))
    wire[10, 20:60:2] = 0.6  # Dashes of a faint one.
    twig[77:80, 100] = 1.0
    specks[[20, 21, 40, 60], [150, 150, 30, 120]] = 0.8
    cloud[30:38, 80:100] = 0.3  # As long as a wire, and broad.
    found = _long(np.max([wire, twig, specks, cloud], axis=0), is_matter)
    np.testing.assert_array_equal(found, np.maximum(wire, twig))


def test_a_dark_cloud_before_a_bright_one_is_sky_beside_a_roof(rng: np.random.Generator) -> None:
    """Its colour lies between the mean of the sky around and the roof's."""
    is_sky = np.zeros((120, 160), bool)
    is_sky[:70] = True
    srgb8 = np.where(is_sky, 225.0, 70.0)[..., None] + rng.normal(0, 2, (120, 160, 3))
    cloud = (slice(40, 70), slice(60, 110))
    srgb8[cloud] -= 75.0
    no = np.zeros(is_sky.shape, bool)
    nothing = np.zeros((*is_sky.shape, 3), np.float32)
    evidence = ImageEvidence(nothing, nothing, nothing[..., 0], no, no, no, no)
    probability = np.where(is_sky, 0.99, 0.0).astype(np.float32)
    matte = refine_matte(np.clip(srgb8, 0, 255).astype(np.uint8), probability, evidence)
    assert matte.expected[cloud].min() > 0.95
    assert matte.likeliest[:70].min() > 0.99
    assert matte.likeliest[70:].max() < 0.01
