"""scenario.json has the whole scenario, and is a request that gives the same scenario again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from lightsim.core.dome import SkyDome
from lightsim.core.mesh import TriMesh
from lightsim.core.reading import LogReading
from lightsim.core.sky_choice import SkyChoice
from lightsim.core.twin import ActorAsset, DigitalTwin, SceneAssets, SkyEstimate
from lightsim.datasets.reader import read_log
from lightsim.scenario.edits import read_scenario_request
from lightsim.scenario.replay import replay
from lightsim.store.scenario import SCENARIO_NAME, write_scenario
from lightsim_lab.synthetic import shipped_street


def _twin() -> DigitalTwin:
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


def test_a_written_scenario_is_complete_and_a_request(tmp_path: Path) -> None:
    twin = _twin()
    sky = SkyChoice("sun:180,60", 30.0, "2.5", "90,20", 3.0)
    edits = ({"do": "remove", "actor": twin.log.actors[0].actor_id},)
    made = replace(
        replay(twin, "noon", twin.log.frames[3:9], "composite", seed=7), sky=sky, edits=edits
    )
    write_scenario(tmp_path, made, target_sky={"scale_factor": 2.5})
    asked = read_scenario_request(tmp_path / SCENARIO_NAME)
    assert (asked.name, asked.sky, asked.spelt) == ("noon", sky, edits)
    written = json.loads((tmp_path / SCENARIO_NAME).read_text())
    assert written["target_sky"] == {"scale_factor": 2.5}
    assert {a["actor_id"]: a["number"] for a in written["actors"]} == made.number_by_actor
    has_asset = {a["actor_id"] for a in written["actors"] if a["asset"] is not None}
    assert has_asset == set(twin.assets.actors)
    for entry, frame in zip(written["frames"], made.frames, strict=True):
        assert (entry["frame"], entry["source"]) == (frame.stem, "composite")
        np.testing.assert_array_equal(entry["world_from_camera"], frame.world_from_camera.matrix)
        tracks = made.tracks_at(frame.time_ns)
        assert [a["actor_id"] for a in entry["actors"]] == [t.actor_id for t in tracks]
        for box, track in zip(entry["actors"], tracks, strict=True):
            pose = track.world_from_actor(frame.time_ns)
            np.testing.assert_array_equal(box["world_from_actor"], pose.matrix)
