"""scenario.json is written from the scenario, and reads back as the same scenario."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lightsim.core.dome import SkyDome
from lightsim.core.mesh import TriMesh
from lightsim.core.reading import LogReading
from lightsim.core.scenario import FrameSource
from lightsim.core.sky_choice import SkyChoice
from lightsim.core.twin import ActorAsset, DigitalTwin, SceneAssets, SkyEstimate
from lightsim.datasets.reader import read_log
from lightsim.errors import ArtefactError
from lightsim.scenario.replay import replay
from lightsim.store.scenario import SCENARIO_NAME, read_scenario, write_scenario
from lightsim_lab.synthetic import shipped_street


@pytest.fixture(scope="module")
def twin() -> DigitalTwin:
    """The shipped street, with a mesh for every second actor."""
    log = read_log(LogReading(source=str(shipped_street() / "log"), frames="0:4"))
    xyz = np.eye(3, dtype=np.float32)
    mesh = TriMesh("actor", xyz, np.arange(3, dtype=np.int32)[None], xyz)
    actors = {a.actor_id: ActorAsset(a.actor_id, a.kind, mesh) for a in log.actors[::2]}
    assets = SceneAssets(replace(mesh, frame="world"), actors, {})
    dome = SkyDome(np.ones((8, 16, 3), np.float32), None)
    return DigitalTwin(
        log, assets, SkyEstimate(dome, None, 30.0, "image", 5.0, 1.0, np.ones(3, np.float32), 0.1)
    )


@pytest.mark.parametrize("source", ["recorded", "rendered", "composite"])
def test_a_scenario_reads_back_as_it_was(
    twin: DigitalTwin, tmp_path: Path, source: FrameSource
) -> None:
    made = replace(
        replay(twin, "noon", twin.log.frames[3:9], source, seed=7),
        sky=SkyChoice("sun:180,60", 30.0, "2.5", "90,20", 3.0),
        edits=({"do": "remove", "actor": twin.log.actors[0].actor_id},),
    )
    write_scenario(tmp_path, made, target_sky={"scale_factor": 2.5})
    read = read_scenario(tmp_path, twin)
    for name in ("name", "cameras", "sky", "edits", "seed", "number_by_actor"):
        assert getattr(read, name) == getattr(made, name), name
    assert [p.asset for p in read.placements] == [p.asset for p in made.placements]
    np.testing.assert_array_equal(read.frames[0].load_srgb8(), made.frames[0].load_srgb8())
    written = (tmp_path / SCENARIO_NAME).read_text()
    write_scenario(tmp_path, read, target_sky={"scale_factor": 2.5})
    assert (tmp_path / SCENARIO_NAME).read_text() == written


def test_what_the_twin_does_not_have_is_named(twin: DigitalTwin, tmp_path: Path) -> None:
    write_scenario(tmp_path, replay(twin, "noon", twin.log.frames[:1]))
    text = (tmp_path / SCENARIO_NAME).read_text()
    stem = twin.log.frames[0].stem
    (tmp_path / SCENARIO_NAME).write_text(text.replace(f'"frame": "{stem}"', '"frame": "99"'))
    with pytest.raises(ArtefactError, match=r"no such frame in the log.*99"):
        read_scenario(tmp_path, twin)
    (tmp_path / SCENARIO_NAME).write_text(text.replace('"rendered"', '"painted"'))
    with pytest.raises(ArtefactError, match=r"recorded, rendered, composite.*painted"):
        read_scenario(tmp_path, twin)
