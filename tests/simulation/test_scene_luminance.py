"""Skies are scaled to be as bright as the log where its cameras look."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.render.rendering_scenes import box, plane, sun_sky
from tests.tiny_world import GROUND, TinyWorkspace, tiny_world

from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.reading import LogReading
from lightsim.core.sky_choice import SkyChoice
from lightsim.simulation.scene_luminance import SceneLuminance
from lightsim.simulation.skies import resolve_sky
from lightsim.store.sky import write_sky

EVENING = sun_sky(np.radians(90.0), 15.0, 0.2)
NOON = sun_sky(0.0, 60.0, 0.1)


def street(background: TriMesh) -> TinyWorkspace:
    """Nothing moves in it."""
    work = tiny_world(
        EVENING, background=background, reading=LogReading(source="tiny", image_scale=1.0)
    )
    work.__dict__["twin"] = replace(work.twin, assets=replace(work.twin.assets, actors={}))
    return work


def scale_of(sky: SkyDome, work: TinyWorkspace, folder: Path) -> float:
    write_sky(folder, replace(work.sky, dome=sky), None)
    factor = resolve_sky(SkyChoice(str(folder / "source.exr")), work).facts.scale_factor
    assert factor is not None
    return factor


def level(sky: SkyDome) -> float:
    return float(luminance(sky.horizontal_irradiance()))


def test_open_ground_keeps_its_light(tmp_path: Path) -> None:
    work = street(plane(60.0, 1, GROUND))
    seen = SceneLuminance(work)
    for sky in (EVENING, NOON):
        assert seen.mean_luminance(sky) == pytest.approx(level(sky) / np.pi, rel=2e-3)
    assert seen.mean_luminance(NOON.scaled(7.0)) == pytest.approx(7 * seen.mean_luminance(NOON))
    assert scale_of(NOON, work, tmp_path) == pytest.approx(level(EVENING) / level(NOON), rel=3e-3)


def test_a_street_in_the_shade_is_shown_as_one(tmp_path: Path) -> None:
    """The noon's sun stands behind a tower: its light counts for nothing."""
    tower = box((60.0, 0.0, 100.0), (20.0, 120.0, 200.0))
    work = street(concatenate_meshes([plane(60.0, 1, GROUND), tower]))
    assert scale_of(NOON, work, tmp_path) > 3 * level(EVENING) / level(NOON)


def test_the_source_itself_is_not_scaled() -> None:
    found = resolve_sky(SkyChoice("source"), tiny_world(EVENING))
    assert found.is_source
    assert found.facts.scale_factor == 1.0


def test_a_log_that_sees_no_surface_has_no_light() -> None:
    assert SceneLuminance(street(plane(cells=0))).mean_luminance(NOON) == 0
