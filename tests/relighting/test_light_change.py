"""The light's change: shadows that pictures show stay thin, relief that meshes guess goes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from tests.relighting.scene import (
    HEIGHT_PX,
    SKY_ROWS,
    WALL_ROWS,
    WIDTH_PX,
    everywhere_lit,
    geometry,
    light,
    sun_towards,
)

from lightsim.core.buffers import GBuffers
from lightsim.core.dome import SkyDome, add_sun
from lightsim.core.found_visibility import unoccluded_sun
from lightsim.relighting.physical import ratio
from lightsim.relighting.physical.light_change import Lights, log_light_change
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs, relight_physical

SUN = sun_towards(150.0, 40.0)
STRIPES = np.broadcast_to(np.arange(WIDTH_PX) % 10 < 3, (HEIGHT_PX, WIDTH_PX)).astype(np.float32)
"""Of sun between leaves, thinner than what the light's change is smoothed over."""
PICTURE_PX = 480
"""Of which these arrays are a window."""
MATTER = np.s_[SKY_ROWS:]


@pytest.fixture
def buffers(rng: np.random.Generator) -> GBuffers:
    return geometry(rng)


def _change(buffers: GBuffers, lights: Lights, is_surface: np.ndarray | None = None) -> np.ndarray:
    is_surface = buffers.has_surface if is_surface is None else is_surface
    return log_light_change(lights, buffers, is_surface, 0.0, PICTURE_PX)


def test_told_shadows_stay_as_thin_as_they_are_and_others_go(buffers: GBuffers) -> None:
    source, target = light(buffers, SUN, 0.5, STRIPES), light(buffers, None, 0.5, STRIPES)
    sunlight = unoccluded_sun(buffers, source, SUN)
    lights = Lights(source, target, sunlight, np.ones_like(STRIPES))
    exact = np.log(target.shaded[MATTER] / source.shaded[MATTER])
    # But for where wall and ground meet.
    inner = np.abs(np.arange(SKY_ROWS, HEIGHT_PX) - WALL_ROWS) > 4
    np.testing.assert_allclose(_change(buffers, lights)[MATTER][inner], exact[inner], atol=2e-3)
    wall = np.s_[SKY_ROWS + 8 : WALL_ROWS - 8, 16:-16]
    plain = _change(buffers, Lights(source, target))[wall]
    assert np.ptp(plain, axis=(0, 1)).max() < 1e-4


def test_dapples_that_pictures_show_leave_no_ghost_under_an_overcast_sky(
    buffers: GBuffers, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = light(buffers, SUN, 0.5, STRIPES), light(buffers, None, 1.0, STRIPES)
    # All pictures together tell it blurred; the mesh has none of it.
    found = ndimage.gaussian_filter1d(STRIPES, 1.0, axis=1)
    flat = np.full_like(buffers.base_colour, 0.3)
    radiance = flat * source.shaded
    case = RelightInputs(
        radiance=radiance,
        is_clipped=np.any(radiance > 1, axis=-1),
        sky_matte=(~buffers.has_surface).astype(np.float32),
        buffers=replace(buffers, base_colour=flat),
        source=light(buffers, SUN, 0.5, everywhere_lit()),
        target=target,
        target_sky=np.ones_like(radiance),
        source_sun=SUN,
        found_visibility=found,
        picture_width_px=PICTURE_PX,
    )
    wall = np.s_[SKY_ROWS + 8 : WALL_ROWS - 8, 16:-16]
    wanted = (flat * target.shaded)[wall]
    relit = relight_physical(case, RatioConfig())[wall]
    monkeypatch.setattr(ratio, "border_fraction", lambda visibility, _: 0 * visibility)
    # A copy computes the source anew.
    smoothed = relight_physical(replace(case), RatioConfig())[wall]
    ghost, before = (np.abs(made / wanted - 1).mean() for made in (relit, smoothed))
    assert ghost < 0.65 * before


def test_far_from_all_meshes_the_skies_as_a_whole_tell(buffers: GBuffers) -> None:
    """A wire high above a facade that the sun now lights is not lit as the facade is."""
    source, target = (light(buffers, sun, 0.5, everywhere_lit()) for sun in (None, SUN))
    is_surface = buffers.has_surface & (np.arange(HEIGHT_PX) > 40)[:, None]
    log_sky_ratio = np.array([0.1, 0.2, 0.3], np.float32)
    made = _change(buffers, Lights(source, target, log_sky_ratio=log_sky_ratio), is_surface)
    np.testing.assert_allclose(
        made[:20], np.broadcast_to(log_sky_ratio, made[:20].shape), atol=1e-5
    )
    before = _change(buffers, Lights(source, target), is_surface)
    np.testing.assert_allclose(made[41:], before[41:], atol=1e-5)
    assert before[:20].min() > 0.9


def test_mean_radiance_is_that_of_sky_and_sun() -> None:
    even = np.full((32, 64, 3), 0.7, np.float32)
    np.testing.assert_allclose(SkyDome(even, None).mean_radiance, 0.7, rtol=1e-6)
    with_sun = add_sun(even, SUN).mean_radiance
    np.testing.assert_allclose(with_sun, 0.7 + SUN.irradiance / (4 * np.pi), rtol=1e-3)
