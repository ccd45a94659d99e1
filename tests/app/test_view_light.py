"""Light of the shared page: shadows and brightness in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.app.test_view_meshes import document_of, primitives_of
from tests.render.rendering_scenes import plane, sun_sky
from tests.tiny_world import (
    BOX_LWH_M,
    GROUND,
    NOTHING,
    STEMS,
    STEP_NS,
    meets_box,
    overlap,
    scenario_of,
    tiny_world,
)

from lightsim.app.baked import lit_meshes
from lightsim.app.meshes import ViewMeshes
from lightsim.core.dome import SkyDome
from lightsim.progress import SilentProgress

ELEVATION_DEG = 35.0


def lit(dome: SkyDome) -> ViewMeshes:
    """Level ground with the car at the origin, at the middle frame."""
    work = tiny_world(dome, background=plane(30.3, 151, GROUND))
    scenario = scenario_of(work)
    assert len(scenario.frames) == len(STEMS)
    background = work.assets.background
    return lit_meshes(background, NOTHING, scenario, STEP_NS, dome, SilentProgress())


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
