"""Misplaced shadow edges are put back where the image shows them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.relighting.scene import SKY_ROWS, light, shadow_right_of
from tests.relighting.test_ratio import SUN, make_inputs

from lightsim.core.found_visibility import unoccluded_sun, with_sun_visibility
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs, relight_physical
from lightsim.relighting.physical.shadow_refine import refine_sun_visibility


@pytest.fixture
def misplaced(rng: np.random.Generator) -> RelightInputs:
    """The picture has the edge at column 70, the rendered light at 65: 25 cm off."""
    inputs = make_inputs(rng, shadow_right_of(1000))
    return replace(inputs, source=light(inputs.buffers, SUN, 0.5, shadow_right_of(65)))


def refined(inputs: RelightInputs) -> np.ndarray:
    return refine_sun_visibility(
        inputs.radiance,
        inputs.buffers,
        inputs.source,
        SUN,
        inputs.sky_matte < 0.5,
    )


def test_the_edge_moves_to_the_image_edge(misplaced: RelightInputs) -> None:
    truth = shadow_right_of(70)
    ground = np.s_[SKY_ROWS:]
    before = np.abs(misplaced.source.sun_visibility - truth)[ground].mean()
    after = np.abs(refined(misplaced) - truth)[ground].mean()
    assert after < 0.25 * before


def test_a_right_edge_stays(rng: np.random.Generator) -> None:
    inputs = make_inputs(rng, shadow_right_of(1000))
    error = np.abs(refined(inputs) - shadow_right_of(70))[SKY_ROWS:]
    assert error.mean() < 0.02


def test_relighting_loses_the_ghost(misplaced: RelightInputs) -> None:
    """With a flat base colour, so that only the shadow edge can help."""
    flat = np.full_like(misplaced.radiance, 0.37)
    wanted = misplaced.buffers.base_colour * misplaced.target.shaded
    case = replace(misplaced, buffers=replace(misplaced.buffers, base_colour=flat))
    band = np.s_[SKY_ROWS:, 64:72]
    with_it = np.abs(relight_physical(case, RatioConfig()) - wanted)[band].mean()
    without = relight_physical(case, RatioConfig(are_shadows_refined=False))
    assert with_it < 0.7 * np.abs(without - wanted)[band].mean()


def test_light_with_its_own_visibility_is_unchanged(misplaced: RelightInputs) -> None:
    source = misplaced.source
    sunlight = unoccluded_sun(misplaced.buffers, source, SUN)
    again = with_sun_visibility(source, sunlight, source.sun_visibility)
    np.testing.assert_array_equal(again.shaded, source.shaded)
    full = with_sun_visibility(source, sunlight, np.ones_like(source.sun_visibility))
    np.testing.assert_allclose(full.shaded[SKY_ROWS:], source.unshadowed[SKY_ROWS:], rtol=1e-5)


def test_a_wide_shadow_that_the_image_does_not_show_is_lifted(rng: np.random.Generator) -> None:
    """The rendering has a shadow over the whole ground, the picture on its right half alone."""
    inputs = make_inputs(rng, shadow_right_of(1000))
    false = replace(inputs, source=light(inputs.buffers, SUN, 0.5, shadow_right_of(0)))
    error = np.abs(refined(false) - shadow_right_of(70))[SKY_ROWS:]
    assert error.mean() < 0.05
