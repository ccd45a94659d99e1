"""Relit pictures against closed forms: where the shadow of a driving box falls, and when."""

from __future__ import annotations

import numpy as np
import pytest
from tests.render.rendering_scenes import constant_sky, sun_sky
from tests.tiny_world import (
    BOX_LWH_M,
    GAIN,
    GROUND,
    STEP_M,
    TinyWorkspace,
    ground_points,
    in_shadow,
    on_ground,
    overlap,
    psnr_db,
    rendered,
    scenario_of,
    tiny_world,
    with_pictures,
)

from lightsim.core.colour import luminance, srgb8_from_linear
from lightsim.core.dome import SkyDome
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relighter import RelightConfig, Relighter
from lightsim.simulation.target_sky import SkyFacts, TargetSky

SKY = 0.15
PIXEL_M = 0.32


def recorded(sky: SkyDome) -> TinyWorkspace:
    """The tiny world with the pictures that a camera takes of it under a sky."""
    work, pictures = tiny_world(sky), {}
    for frame in work.log.frames:
        buffers, light = rendered(work, frame, sky)
        pictures[frame.stem] = srgb8_from_linear(buffers.base_colour * light.shaded * GAIN)
    return with_pictures(work, pictures)


def relit(work: TinyWorkspace, sky: SkyDome, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Radiance and 8-bit picture of one frame under another sky."""
    relighter = Relighter(
        work, work.log, RelightConfig(), RelightOptions(name="tiny", method="physical")
    )
    target = relighter.target(TargetSky(sky, SkyFacts("source")))
    scenario = scenario_of(work)
    (found,) = relighter.relit(scenario.frames[number], scenario, [target])
    return found.radiance, found.image_srgb8


def is_dark(radiance: np.ndarray, sun_direction: np.ndarray) -> np.ndarray:
    """Less than half of the sun on the ground."""
    return luminance(radiance) < luminance(GROUND) * (SKY + 0.5 * sun_direction[2])


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(30.0, 35.0), (250.0, 25.0)])
@pytest.mark.parametrize("source", ["overcast", "another sun"])
def test_a_driving_boxs_shadow_falls_where_it_stands_at_the_frames_time(
    azimuth_deg: float, elevation_deg: float, source: str
) -> None:
    """Away from the sun, as long as the box is high over the tangent of the elevation, and with
    the box from frame to frame; nothing is left of the shadow of another source sun."""
    sky = sun_sky(np.radians(azimuth_deg), elevation_deg, SKY)
    assert sky.sun is not None
    sun = sky.sun.direction_world
    before = sun_sky(np.radians(azimuth_deg + 140.0), 40.0, SKY)
    work = recorded(constant_sky((0.6, 0.6, 0.6)) if source == "overcast" else before)
    shadows, points = [], ground_points(work.log.frames[0])
    for number, frame in enumerate(work.log.frames):
        radiance, _ = relit(work, sky, number)
        ground = on_ground(frame)
        shadow = is_dark(radiance, sun) & ground
        assert overlap(shadow, in_shadow(frame, sun) & ground) > 0.9
        for other in work.log.frames:
            if other is not frame:
                assert overlap(shadow, in_shadow(other, sun) & ground) < 0.5
        shadows.append(points[shadow])
    # The farthest shadow lies beyond the farthest corner of the footprint by the length wanted.
    away = -sun[:2] / np.linalg.norm(sun[:2])
    corner = (np.abs(away) * BOX_LWH_M[:2] / 2).sum()
    length_m = (shadows[1][:, :2] @ away).max() - corner
    wanted_m = BOX_LWH_M[2] / np.tan(np.radians(elevation_deg))
    assert length_m == pytest.approx(wanted_m, abs=1.5 * PIXEL_M)
    moved_m = shadows[2].mean(axis=0) - shadows[0].mean(axis=0)
    np.testing.assert_allclose(moved_m[:2], (0.0, 2 * STEP_M), atol=PIXEL_M)


def test_its_own_sky_gives_a_picture_back_and_another_sun_gives_the_other_picture() -> None:
    sky, other = sun_sky(np.radians(30.0), 35.0, SKY), sun_sky(np.radians(170.0), 60.0, SKY)
    work = recorded(sky)
    source, wanted = (w.log.frames[1].load_srgb8() for w in (work, recorded(other)))
    assert psnr_db(relit(work, sky, 1)[1], source) > 50
    assert psnr_db(source, wanted) < 25
    assert psnr_db(relit(work, other, 1)[1], wanted) > 35
