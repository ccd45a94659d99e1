from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.buffers import GBuffers
from lightsim.core.colour import srgb8_from_linear
from lightsim.core.dome import Sun, add_sun
from lightsim.errors import InputError
from lightsim.view import figures


def test_tone_mapping_keeps_order_and_hue(rng: np.random.Generator) -> None:
    grey = np.sort(rng.lognormal(0, 3, 400)).astype(np.float32)
    picture = figures.tone_mapped(np.repeat(grey.reshape(20, 20, 1), 3, axis=2))
    assert (np.diff(picture[..., 0].reshape(-1).astype(int)) >= 0).all()
    assert picture[..., 0].max() <= 255
    even = figures.tone_mapped(np.full((2, 2, 3), 7.0, np.float32))
    assert (even == srgb8_from_linear(np.full((1, 1, 3), 0.35, np.float32))).all()


def test_the_ring_marks_the_sun_where_it_is() -> None:
    sun = Sun(np.array([0.0, 0.8, 0.6]), np.full(3, 5.0, np.float32))
    dome = add_sun(np.full((64, 128, 3), 0.2, np.float32), sun)
    picture = figures.dome_preview(dome)
    assert picture.shape == (384, 768, 3)
    rows, columns = np.nonzero((picture == (255, 64, 32)).all(axis=2))
    assert columns.mean() == pytest.approx(0.25 * 768, abs=1.0)
    assert rows.mean() == pytest.approx(np.arccos(0.6) / np.pi * 384, abs=1.0)


def test_colour_maps_tell_near_from_far_and_sky() -> None:
    depth = np.array([[2.0, 10.0, 80.0, np.inf]])
    near, middle, far, sky = figures.depth_colours(depth)[0].astype(int)
    assert near[0] > near[2]
    assert far[2] > far[0]
    assert middle[1] > 150
    assert (sky == 24).all()
    flat = np.zeros((1, 2, 3), np.float32)
    normals = np.array([[[0, 0, 1], [0, 0, 0]]], np.float32)
    z = np.array([[5.0, np.inf]], np.float32)
    buffers = GBuffers(z, flat, normals, flat, z, np.array([[-1, -2]], np.int32))
    np.testing.assert_array_equal(
        figures.normal_colours(buffers)[0], [[128, 128, 255], [24, 24, 24]]
    )


def test_strips() -> None:
    one = np.ones((4, 5, 3), np.uint8)
    half = figures.ratio_grey(np.full((4, 5, 3), 0.5, np.float32))
    wide = figures.strip([one, half])
    assert wide.shape == (4, 2 * 5 + 6, 3)
    assert (wide[:, -5:] == 128).all()
    assert (wide[:, :5] == 1).all()
    with pytest.raises(InputError, match="one height"):
        figures.strip([one, one[:2]])
