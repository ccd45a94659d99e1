"""Sharpness and noise of pictures of which both are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import convolve1d, gaussian_filter

from lightsim.core.colour import (
    linear_from_srgb,
    linear_from_srgb8,
    luminance,
    srgb8_from_linear,
    srgb_from_linear,
)
from lightsim.relighting.physical.blur_noise import (
    CameraBlurNoise,
    blurred,
    camera_noise,
    estimate_blur_noise,
    sharpened,
)

SIDE, FINE = 320, 8
NOBODY = np.zeros((SIDE, SIDE), dtype=bool)


def discs(sigma_px: float = 0.0) -> np.ndarray:
    """Discs of all greys on a grey ramp, as a sensor with square pixels sees them through a lens
    with a Gaussian point spread."""
    rng = np.random.default_rng(1)
    y, x = (np.indices((SIDE * FINE, SIDE * FINE), dtype=np.float32) + 0.5) / FINE
    image = 0.1 + 0.5 * x / SIDE
    for row in range(4):
        for column in range(4):
            u, v = rng.uniform(-8, 8, 2) + [column * 80 + 40, row * 80 + 40]
            grey = rng.uniform(0.05, 0.75)
            image[(x - u) ** 2 + (y - v) ** 2 < 22**2] = grey
    if sigma_px:
        image = gaussian_filter(image, sigma_px * FINE)
    return image.reshape(SIDE, FINE, SIDE, FINE).mean(axis=(1, 3)).astype(np.float32)


def grained(shape: tuple[int, int], grain: float, rng: np.random.Generator) -> np.ndarray:
    kernel = np.array([grain, 1.0, grain]) / np.sqrt(1 + 2 * grain**2)
    noise = rng.standard_normal(shape)
    for axis in (0, 1):
        noise = convolve1d(noise, kernel, axis=axis, mode="wrap")
    return noise


def coded(grey: np.ndarray) -> np.ndarray:
    return srgb8_from_linear(np.repeat(grey[..., None], 3, axis=-1))


def noise_std(blur_noise: CameraBlurNoise, signal: float) -> float:
    return float(blur_noise.noise_std(np.full(1, signal, np.float32))[0])


@pytest.mark.parametrize("sigma_px", [0.0, 0.6, 1.2])
def test_blur_is_recovered(sigma_px: float) -> None:
    grey = discs(sigma_px) + 0.003 * grained((SIDE, SIDE), 0.0, np.random.default_rng(2))
    found = estimate_blur_noise([coded(grey)], NOBODY)
    assert found.spread_px2 == pytest.approx(sigma_px**2, abs=0.08)


def test_a_rendered_picture_becomes_as_sharp_as_it_is_told_to() -> None:
    soft = blurred(discs(), CameraBlurNoise(0.4))
    assert estimate_blur_noise([coded(soft)], NOBODY).spread_px2 == pytest.approx(0.4, abs=0.1)
    sharp = linear_from_srgb(sharpened(srgb_from_linear(discs()), CameraBlurNoise(-0.3)))
    assert estimate_blur_noise([coded(sharp)], NOBODY).spread_px2 == pytest.approx(-0.3, abs=0.1)


@pytest.mark.parametrize("grain", [0.0, 0.4])
def test_noise_is_recovered(grain: float) -> None:
    rng, dark, slope = np.random.default_rng(3), 0.001**2, 1e-4
    grey = discs()
    pictures = []
    for _ in range(2):
        noise = np.sqrt(dark + slope * grey) * grained(grey.shape, grain, rng)
        pictures.append(coded(grey + noise))
    found = estimate_blur_noise(pictures, NOBODY)
    assert found.grain == pytest.approx(grain, abs=0.08)
    for signal in (0.1, 0.5):
        wanted = np.sqrt(dark + slope * signal)
        assert noise_std(found, signal) == pytest.approx(wanted, rel=0.15)


def test_added_noise_has_the_statistics_of_the_picture() -> None:
    """Half of a picture is rendered: nothing tells it from the recorded half."""
    rng = np.random.default_rng(4)
    grey = np.tile(np.linspace(0.1, 0.6, SIDE, dtype=np.float32), (SIDE, 1)).T.copy()
    recorded = coded(grey + np.sqrt(1e-6 + 1e-4 * grey) * grained(grey.shape, 0.3, rng))
    blur_noise = estimate_blur_noise([recorded], NOBODY)
    rendered = coded(grey + camera_noise(grey, blur_noise, np.random.default_rng(5)))
    rest = [luminance(linear_from_srgb8(p)) - grey for p in (recorded, rendered)]
    for rows in np.array_split(np.arange(SIDE), 4):
        a, b = (r[rows].std() for r in rest)
        assert b == pytest.approx(a, rel=0.12)
    a, b = ((r[:, 1:] * r[:, :-1]).mean() / r.var() for r in rest)
    assert b == pytest.approx(a, abs=0.08)


def test_a_picture_that_tells_nothing_leaves_renderings_as_they_are() -> None:
    grey = np.full((SIDE, SIDE, 3), 128, np.uint8)
    blur_noise = estimate_blur_noise([grey], NOBODY)
    assert (blur_noise.spread_px2, noise_std(blur_noise, 0.5)) == (
        0.0,
        pytest.approx(0, abs=1e-4),
    )
    assert estimate_blur_noise([grey], ~NOBODY) == CameraBlurNoise()
