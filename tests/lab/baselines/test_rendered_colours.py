"""Colour transfer towards the rendered target: statistics are taken over, shadows are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from skimage.color import rgb2lab
from tests.relighting.scene import everywhere_lit, geometry, light, sun_towards

from lightsim.core.colour import srgb_from_linear
from lightsim.relighting.methods import relight_by
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs

relight = relight_by("colour-transfer")


@pytest.fixture
def inputs(rng: np.random.Generator) -> RelightInputs:
    """Lit from the right; wanted is a bluer, darker light from the left, before a grey sky."""
    buffers = geometry(rng)
    source, target = (
        light(buffers, sun_towards(azimuth, 40.0, strength), sky, everywhere_lit())
        for azimuth, strength, sky in ((200.0, 3.0, 0.2), (120.0, 1.0, 0.4))
    )
    recorded = np.where(buffers.has_surface[..., None], buffers.base_colour * source.shaded, 0.8)
    return RelightInputs(
        radiance=recorded.astype(np.float32),
        is_clipped=np.zeros(recorded.shape[:2], bool),
        sky_matte=(~buffers.has_surface).astype(np.float32),
        buffers=buffers,
        source=source,
        target=target,
        target_sky=np.full(recorded.shape, 0.5, np.float32),
    )


def rendered(inputs: RelightInputs) -> np.ndarray:
    is_surface = inputs.buffers.has_surface[..., None]
    lit = inputs.buffers.base_colour * inputs.target.shaded
    return np.where(is_surface, lit, inputs.target_sky).astype(np.float32)


def lab(linear: np.ndarray) -> np.ndarray:
    return rgb2lab(srgb_from_linear(linear)).reshape(-1, 3)


def test_statistics_become_those_of_the_rendered_target(inputs: RelightInputs) -> None:
    made, wanted = lab(relight(inputs, RatioConfig()).radiance), lab(rendered(inputs))
    np.testing.assert_allclose(made.mean(axis=0), wanted.mean(axis=0), atol=0.3)
    np.testing.assert_allclose(made.std(axis=0), wanted.std(axis=0), atol=0.3)


def test_each_channel_changes_alike_everywhere(inputs: RelightInputs) -> None:
    """No shadow is cast: what was brighter stays brighter."""
    before = lab(inputs.radiance)[:, 0]
    after = lab(relight(inputs, RatioConfig()).radiance)[:, 0]
    inside = (after > 2) & (after < 98)
    slope, offset = np.polyfit(before[inside], after[inside], 1)
    assert slope > 0
    assert np.abs(slope * before + offset - after)[inside].max() < 1.5


def test_a_picture_that_is_its_own_target_stays(inputs: RelightInputs) -> None:
    same = replace(inputs, radiance=rendered(inputs))
    np.testing.assert_allclose(relight(same, RatioConfig()).radiance, rendered(inputs), atol=2e-3)


def test_a_picture_of_one_colour_becomes_the_target_s_mean(inputs: RelightInputs) -> None:
    flat = replace(inputs, radiance=np.full_like(inputs.radiance, 0.3))
    made = lab(relight(flat, RatioConfig()).radiance)
    np.testing.assert_allclose(made.mean(axis=0), lab(rendered(inputs)).mean(axis=0), atol=0.3)
    np.testing.assert_allclose(made.std(axis=0), 0.0, atol=1e-2)
