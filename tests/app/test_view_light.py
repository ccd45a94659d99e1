"""Baked light of the viewer: shadows and brightness in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.app.test_view_meshes import document_of, primitives_of
from tests.render.rendering_scenes import plane, sun_sky
from tests.tiny_world import (
    BOX_LWH_M,
    GROUND,
    STEP_NS,
    TinyWorkspace,
    meets_box,
    overlap,
    scenario_of,
    tiny_world,
)

from lightsim.app.baked import LightTracer, Surface, TracedLight
from lightsim.app.meshes import ViewMeshes
from lightsim.core.dome import SkyDome

ELEVATION_DEG = 35.0


def traced(work: TinyWorkspace) -> TracedLight:
    return LightTracer(work).traced(scenario_of(work), STEP_NS)


def lit(dome: SkyDome) -> ViewMeshes:
    """Level ground with the car at the origin, at the middle frame."""
    work = tiny_world(dome, background=plane(30.3, 151, GROUND))
    return traced(work).lit(dome)


def radiance_of_ground(meshes: ViewMeshes, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions on the ground, and the radiance shown there."""
    (part,) = primitives_of(meshes.background, folder)
    return part.vertices, part.colour


def test_open_ground_under_a_uniform_sky_shows_base_colour_times_radiance(tmp_path: Path) -> None:
    meshes = lit(SkyDome(np.full((32, 64, 3), 0.5, np.float32), None))
    places, shown = radiance_of_ground(meshes, tmp_path)
    far = np.linalg.norm(places[:, :2], axis=1) > 20.0
    np.testing.assert_allclose(shown[far].mean(axis=0), 0.5 * GROUND, rtol=0.02)
    beside = np.abs(places[:, :2] - [0.0, BOX_LWH_M[1] / 2 + 0.1]).max(axis=1) < 0.3
    assert shown[beside, 1].mean() < 0.8 * shown[far, 1].mean()  # the car hides sky


@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, 200.0])
def test_the_shadow_falls_away_from_the_sun(azimuth_deg: float, tmp_path: Path) -> None:
    dome = sun_sky(np.radians(azimuth_deg), ELEVATION_DEG)
    places, shown = radiance_of_ground(lit(dome), tmp_path)
    far = np.linalg.norm(places[:, :2], axis=1) > 20.0
    lit_value = np.sin(np.radians(ELEVATION_DEG)) * GROUND  # the sun's irradiance is pi
    np.testing.assert_allclose(np.median(shown[far], axis=0), lit_value, rtol=0.02)
    towards = sky_direction(azimuth_deg)
    frame = tiny_world(dome).log.frames[1]
    expected = meets_box(places, np.broadcast_to(towards, places.shape), frame)
    dark = shown[:, 1] < 0.5 * lit_value[1]
    assert expected.sum() > 50
    assert overlap(dark, expected) > 0.85  # vertices are 0.4 m apart
    centre = places[dark].mean(axis=0)[:2]
    assert centre @ towards[:2] < -0.3


def sky_direction(azimuth_deg: float) -> np.ndarray:
    azimuth, elevation = np.radians([azimuth_deg, ELEVATION_DEG])
    level = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
    return np.array([*level, np.sin(elevation)])


def test_lit_meshes_are_not_shaded_again() -> None:
    meshes = lit(SkyDome(np.full((32, 64, 3), 0.5, np.float32), None))
    assert meshes.inferred is None
    for glb in (meshes.background, meshes.glb_by_actor["car"]):
        document, _ = document_of(glb)
        assert document["extensionsUsed"] == ["KHR_materials_unlit"]
        assert all("KHR_materials_unlit" in m["extensions"] for m in document["materials"])


def test_level_ground_under_a_uniform_sky_of_radiance_1_has_light_1() -> None:
    dome = SkyDome(np.ones((32, 64, 3), np.float32), None)
    work = tiny_world(dome, background=plane(30.3, 11, GROUND))
    light = LightTracer(work).traced(scenario_of(work), 10 * STEP_NS)  # without the car
    np.testing.assert_allclose(light.irradiance_over_pi(dome), 1.0, rtol=1e-5)


def test_two_skies_from_one_tracing_equal_two_tracings() -> None:
    skies = [sun_sky(np.radians(azimuth), ELEVATION_DEG, sky=0.3) for azimuth in (20.0, 200.0)]
    work = tiny_world(skies[0], background=plane(30.3, 51, GROUND))
    once = traced(work)
    found = [once.lit(sky) for sky in skies]
    for sky, meshes in zip(skies, found, strict=True):
        alone = traced(work).lit(sky)
        assert meshes.background == alone.background
        assert meshes.glb_by_actor == alone.glb_by_actor
    assert found[0].background != found[1].background


def test_exposure_scales_the_light(tmp_path: Path) -> None:
    dome = SkyDome(np.full((32, 64, 3), 0.5, np.float32), None)
    light = traced(tiny_world(dome, background=plane(30.3, 11, GROUND)))
    _, before = radiance_of_ground(light.lit(dome), tmp_path)
    _, after = radiance_of_ground(light.lit(dome, 1.0), tmp_path)
    np.testing.assert_allclose(after, 2.0 * before, atol=2.0**-7)


def test_an_absent_actor_has_the_light_of_an_open_place(tmp_path: Path) -> None:
    dome = sun_sky(0.3, ELEVATION_DEG, sky=0.2)
    work = tiny_world(dome)
    light = LightTracer(work).traced(scenario_of(work), 10 * STEP_NS)
    assert not light.present
    (part,) = primitives_of(light.lit(dome).glb_by_actor["car"], tmp_path)
    roof = part.vertices[:, 2] > 0.7
    level = dome.horizontal_irradiance() / np.pi
    assert part.colour[roof].max() == pytest.approx(
        float((level * work.assets.actors["car"].mesh.base_colour[0]).max()), rel=0.02
    )
    ground = Surface.of(plane(30.3, 1, GROUND)).lit_by_open_sky(dome)
    (part,) = primitives_of(ground, tmp_path)
    np.testing.assert_allclose(part.colour, np.tile(level * GROUND, (4, 1)), atol=2.0**-8)
