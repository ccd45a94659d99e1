"""Preview and final picture: equal to those of the commands, and shadows in closed form."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.render.rendering_scenes import box, constant_sky, plane, sun_sky
from tests.tiny_world import (
    GAIN,
    GROUND,
    STEMS,
    TinyWorkspace,
    ground_points,
    rendered,
    scenario_of,
    tiny_world,
    with_pictures,
)

from lightsim.app.pictures import Pictures
from lightsim.app.preview import Previews
from lightsim.core.colour import luminance, srgb8_from_linear
from lightsim.core.dome import SkyDome
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.sky_choice import SkyChoice
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relighter import RelightConfig, Relighter
from lightsim.simulation.scene_luminance import SceneLuminance
from lightsim.simulation.skies import resolve_sky

POLE_M = 3.0
SOURCE = SkyChoice("source")


def recorded(sky: SkyDome, background: TriMesh | None = None) -> TinyWorkspace:
    """The tiny world with the pictures of its camera under a sky."""
    work = tiny_world(sky, background=background)
    work.__dict__["reading"] = SimpleNamespace(image_scale=1.0)
    pictures = {}
    for frame in work.log.frames:
        buffers, light = rendered(work, frame, sky)
        pictures[frame.stem] = srgb8_from_linear(buffers.base_colour * light.shaded * GAIN)
    return with_pictures(work, pictures)


@pytest.fixture(scope="module")
def pictures() -> Pictures:
    """Pictures of a world that was recorded in the sun."""
    work = recorded(sun_sky(np.radians(30.0), 35.0, 0.15, rows=64))
    return Pictures(work, scenario_of(work), "physical")


@pytest.mark.parametrize(
    "sky", [SkyChoice("sun:200,40,3"), SkyChoice("source", move_sun="100,50", sun_factor=0.7)]
)
def test_the_final_picture_is_that_of_relight(pictures: Pictures, sky: SkyChoice) -> None:
    work, scenario = pictures.workspace, pictures.recorded
    frame = scenario.frames[1]
    final = pictures.final(frame, scenario, sky, 0.0)
    options = RelightOptions(name="tiny", sky=(sky.sky,), method="physical")
    relighter = Relighter(work, work.log, RelightConfig(), options, scenario)
    target = relighter.target(resolve_sky(sky, work, SceneLuminance(work)))
    (wanted,) = relighter.relit(frame, scenario, [target])
    np.testing.assert_array_equal(final.relit, wanted.image_srgb8)
    assert np.abs(final.relit.astype(int) - final.recorded).max() > 20
    # Another exposure of the same frame, which is kept.
    brighter = pictures.final(frame, scenario, sky, 1.0).relit
    options = replace(options, exposure_ev=1.0)
    relighter = Relighter(work, work.log, RelightConfig(), options, scenario)
    (wanted,) = relighter.relit(frame, scenario, [target])
    np.testing.assert_array_equal(brighter, wanted.image_srgb8)


def test_under_the_source_sky_the_picture_is_the_recorded_one(pictures: Pictures) -> None:
    scenario = pictures.recorded
    frame = scenario.frames[2]
    final = pictures.final(frame, scenario, SOURCE, 0.0)
    np.testing.assert_array_equal(final.relit, frame.load_srgb8())
    np.testing.assert_array_equal(final.recorded, frame.load_srgb8())
    preview = Previews(pictures).preview(frame, scenario, SOURCE, 0.0)
    np.testing.assert_allclose(preview.astype(int), final.relit, atol=2)


@pytest.mark.parametrize("azimuth_deg", [30.0, 120.0, 300.0])
def test_the_shadow_of_a_pole_points_away_from_the_sun(azimuth_deg: float) -> None:
    """Azimuths are clockwise from north, and world +x is assumed to be east."""
    pole = box((0.0, 0.0, POLE_M / 2), (0.5, 0.5, POLE_M), 0.3)
    ground = concatenate_meshes([plane(60.0, 1, GROUND), pole])
    work = recorded(constant_sky((0.6, 0.6, 0.6), rows=64), ground)
    pictures = Pictures(work, scenario_of(work), "physical")
    scenario = pictures.recorded
    frame = scenario.frames[STEMS.index("00")]  # the car is 5 m south of the pole
    sky = SkyChoice(f"sun:{azimuth_deg},45")
    shown = Previews(pictures).preview(frame, scenario, sky, 0.0)
    bright = luminance((shown / np.float32(255.0)) ** np.float32(2.2))
    points = ground_points(frame)[..., :2]
    distance = np.linalg.norm(points, axis=-1)
    is_near = (distance > 0.6) & (distance < POLE_M)
    is_dark = is_near & (bright < 0.5 * np.median(bright))
    assert is_dark.sum() > 8
    east, north = points[is_dark].mean(axis=0)
    found_deg = np.degrees(np.arctan2(east, north))
    turn_deg = (found_deg - (azimuth_deg + 180.0) + 180.0) % 360.0 - 180.0
    assert abs(turn_deg) < 4.0
    # At 45 degrees the shadow is as long as the pole is high.
    assert distance[is_dark].max() > 0.85 * POLE_M
    assert is_dark.sum() < 0.4 * is_near.sum()
