"""`lightsim build --preset paper`: the published system, and nothing of ours in any stage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lightsim.build.options import BuildOptions
from lightsim.build.pipeline import build
from lightsim.build.workspace import Workspace
from lightsim.core.mesh import Provenance
from lightsim.core.reading import LogReading
from lightsim.core.solar import angle_between_deg
from lightsim.errors import InputError
from lightsim.progress import SilentProgress
from lightsim.reconstruct.field.refine import vertex_radiance
from lightsim_lab.synthetic import shipped_street

OPTIONS = BuildOptions(
    reading=LogReading(
        source=str((shipped_street() / "log").resolve()),
        cameras=("front_camera",),
        frames="0:3",
        image_scale=0.25,
    ),
    preset="paper",
    neural_steps=120,
)


@pytest.mark.slow
def test_no_stage_adds_anything_to_the_field(tmp_path: Path) -> None:
    build(tmp_path, OPTIONS, SilentProgress(), until="twin")
    work = Workspace(tmp_path)
    # Nothing is known before the field is read out.
    assert all((grid.sdf_m == grid.truncation_m).all() for grid in work.fused.background)
    assert work.initial_rooflines == work.rooflines == []
    assert len(work.inferred.faces) == len(work.unobserved_occluders.faces) == 0
    twin, field, numbers = work.twin, work.scene_field, work.log.number_by_actor
    meshes = {-1: twin.assets.background}
    meshes |= {numbers[a]: actor.mesh for a, actor in twin.assets.actors.items()}
    assert min(len(mesh.faces) for mesh in meshes.values()) > 0
    assert len(meshes[-1].faces) > 10_000
    assert len({mesh.materials for mesh in meshes.values()}) <= 2
    for number, mesh in meshes.items():
        assert mesh.has_provenance(Provenance.MEASURED).all()
        assert mesh.texture is None
        assert mesh.sun_visibility is None
        # The file rounds positions and colours, no more.
        expected = vertex_radiance(field, mesh, number)
        error = np.abs(mesh.base_colour - expected).max(axis=1)
        assert np.percentile(error, 99) < 0.02
    assert {tuple(gain) for gain in twin.assets.camera_gains.values()} == {(1.0, 1.0, 1.0)}
    geo, middle = twin.log.geo, twin.log.frames[len(twin.log.frames) // 2].time_ns
    assert geo is not None
    towards = geo.direction_at(middle)
    assert towards is not None
    assert twin.sky.dome.sun is not None
    # A network of the published form paints the sun with the rest of the sky.
    assert any("sky-paper" in note for note in twin.sky.notes)
    assert (twin.sky.dome.sun.irradiance > 0).all()
    assert angle_between_deg(twin.sky.dome.sun.direction_world, towards) < 0.1


@pytest.mark.parametrize(
    "ours",
    [{"colour": "texture"}, {"sky_model": "analytic"}, {"neural_steps": 0}],
    ids=lambda ours: next(iter(ours)),
)
def test_parts_of_ours_are_refused(ours: dict) -> None:
    name = next(iter(ours)).replace("_", "-")
    with pytest.raises(InputError, match=f"--{name}.*--preset standard"):
        replace(OPTIONS, **ours)
