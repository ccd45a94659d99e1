"""Camera response, and the small filters."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from lightsim.core.colour import linear_from_srgb8
from lightsim.errors import InputError
from lightsim.relighting.physical.compose import camera_image
from lightsim.relighting.physical.filters import (
    _enlarged,
    box_mean,
    fill_holes,
    guided_filter,
    median,
    median_smoothed,
)
from lightsim.relighting.physical.matte import foreground_radiance


def test_gain_and_exposure_are_factors_on_linear_light(rng: np.random.Generator) -> None:
    codes = rng.integers(0, 256, (6, 8, 3)).astype(np.uint8)
    gain = np.array([0.9, 1.0, 1.1], np.float32)
    radiance = (linear_from_srgb8(codes) / gain / 2).astype(np.float32)
    np.testing.assert_array_equal(camera_image(radiance, gain, 1.0), codes)
    with pytest.raises(InputError, match="gain"):
        camera_image(radiance, np.zeros(3, np.float32), 0.0)
    radiance[0, 0, 0] = np.nan
    with pytest.raises(InputError, match="finite"):
        camera_image(radiance, gain, 0.0)


def test_filters_keep_constants(rng: np.random.Generator) -> None:
    flat = np.full((20, 30), 0.7, np.float32)
    guide, weight = (rng.random((20, 30)).astype(np.float32) for _ in range(2))
    np.testing.assert_allclose(box_mean(flat, 3), 0.7, rtol=1e-5)
    np.testing.assert_allclose(guided_filter(guide, flat, weight, 3, 0.01), 0.7, rtol=1e-3)


def test_guided_filter_puts_edges_where_the_guide_has_them() -> None:
    guide = np.zeros((20, 40), np.float32)
    guide[:, 20:] = 1
    wrong = np.zeros_like(guide)
    wrong[:, 22:] = 1
    made = guided_filter(guide, wrong, np.ones_like(guide), 8, 1e-3)
    assert made[10, 19] < 0.1
    assert made[10, 20] > 0.5


@pytest.mark.parametrize("size", [(16, 16), (13, 29), (1, 5)])
def test_holes_are_filled_from_around(rng: np.random.Generator, size: tuple[int, int]) -> None:
    image = np.full((*size, 3), 0.4, np.float32)
    is_known = rng.random(size) < 0.4
    is_known[0, 0] = True
    image[~is_known] = 9.0
    np.testing.assert_allclose(fill_holes(image, is_known), 0.4, rtol=1e-4)
    nothing = fill_holes(image, np.zeros(size, bool))
    np.testing.assert_array_equal(nothing, 0)


def test_unmixing_recovers_the_foreground() -> None:
    """A dark twig in front of a bright sky, 40 % covered."""
    matte = np.ones((12, 12), np.float32)
    matte[:, :4] = 0
    matte[:, 4] = 0.6
    twig, sky = np.array([0.1, 0.08, 0.05]), np.array([0.6, 0.7, 0.9])
    image = (1 - matte[..., None]) * twig + matte[..., None] * sky
    found = foreground_radiance(image.astype(np.float32), matte)
    np.testing.assert_allclose(found[:, :5], np.broadcast_to(twig, (12, 5, 3)), atol=1e-5)


@pytest.mark.parametrize("size", [(7, 9, 14, 18), (7, 9, 13, 17), (1, 3, 2, 5), (5, 1, 9, 1)])
def test_pictures_are_enlarged_as_scipy_does(
    rng: np.random.Generator, size: tuple[int, int, int, int]
) -> None:
    height, width, rows, columns = size
    image = rng.random((height, width, 3), dtype=np.float32)
    zoom = (rows / height, columns / width, 1)
    expected = np.asarray(ndimage.zoom(image, zoom, order=1, mode="nearest", grid_mode=True))
    np.testing.assert_allclose(_enlarged(image, rows, columns), expected, atol=1e-6)


@pytest.mark.parametrize("size_px", [1, 3, 5, 7, 9, 15])
def test_sliding_medians_are_those_of_each_square(rng: np.random.Generator, size_px: int) -> None:
    image = rng.normal(size=(40, 57)).astype(np.float32)
    image[10:20, :30] = 0.25
    for part in (image, image[:3, :4]):
        expected = ndimage.median_filter(part, size_px, mode="nearest")
        everywhere = np.ones(part.shape, dtype=bool)
        np.testing.assert_array_equal(median(part, size_px, everywhere), expected)


@pytest.mark.parametrize("width", [480, 1000])
@pytest.mark.parametrize("detail", [5 / 480, 14 / 480])
def test_medians_of_wanted_pixels_are_those_of_the_whole_picture(
    rng: np.random.Generator, width: int, detail: float
) -> None:
    image = rng.normal(size=(121, width, 3)).astype(np.float32)
    is_wanted = ndimage.gaussian_filter(rng.normal(size=(121, width)), 9) > 0.01
    is_wanted[:30] = False
    wanted = median_smoothed(image, detail, is_wanted=is_wanted)[is_wanted]
    np.testing.assert_array_equal(wanted, median_smoothed(image, detail)[is_wanted])


@pytest.mark.parametrize("width", [480, 960])
def test_medians_of_a_window_are_those_of_the_picture(rng: np.random.Generator, width: int) -> None:
    image = rng.normal(size=(96, width, 3)).astype(np.float32)
    whole = median_smoothed(image, 9 / 480)
    part = median_smoothed(image[:, 64:320], 9 / 480, width)
    np.testing.assert_allclose(part[:, 24:-24], whole[:, 88:296], atol=1e-6)


@pytest.mark.parametrize("width", [480, 1000])
def test_medians_drop_thin_details_and_keep_large_edges(width: int) -> None:
    image = np.zeros((120, width, 3), np.float32)
    image[:, width // 2 :] = 1.0
    image[:, width // 4] = 5.0
    image[60, :] += 2.0
    smooth = median_smoothed(image, 9 / 480)
    assert smooth.shape == image.shape
    step = -(-width // 480)
    away = np.abs(np.arange(width) - width // 2) > 2 * step
    truth = (np.arange(width) >= width // 2).astype(np.float32)
    inner = smooth[20:-20, 20:-20]
    np.testing.assert_allclose(
        inner[:, away[20:-20]],
        np.broadcast_to(truth[20:-20, None], inner.shape)[:, away[20:-20]],
        atol=1e-6,
    )
