"""Common scenes on a straight street: parked cars, walls and traffic in their usual places."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.render.rendering_scenes import box, constant_sky, look_at, plane
from tests.tiny_world import GROUND, STEMS, STEP_NS, TinyWorkspace, tiny_world, unseen

from lightsim import cli
from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.fields import GroundMap
from lightsim.core.frames import Trajectory
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.sensors import CameraFrame
from lightsim.scenario.edits import read_scenario_request
from lightsim.scenario.replay import replay
from lightsim.simulation import placing
from lightsim.simulation.edited import asset_library, edited_scenario

_LOADED = placing
"""Loaded before tests replace `Workspace`: its checked annotations name that class."""
SPEED_M_S = 6.0
HALF_M = 100.0
WIDE = 3.4
"""A car of this width fills its lane."""


def ego_m(stem: int) -> float:
    return SPEED_M_S * stem * STEP_NS / 1e9


def car(name: str, ahead_m: float, left_m: float = 0.0, length_m: float = 4.5) -> ActorTrack:
    """Standing, from before the log to after it."""
    times_ns = np.arange(-1, len(STEMS) + 1) * STEP_NS
    poses = np.tile(np.eye(4), (len(times_ns), 1, 1))
    poses[:, :3, 3] = ahead_m, left_m, 0.75
    path = Trajectory("world", "actor", times_ns, poses)
    return ActorTrack(name, ActorKind.CAR, np.array([length_m, WIDE, 1.5]), path, False)


def street(actors: Sequence[ActorTrack] = (), walls: Sequence[TriMesh] = ()) -> TinyWorkspace:
    """A drive along world +x with one camera that looks ahead."""
    frames = tuple(
        CameraFrame(
            "ahead", stem, k * STEP_NS, look_at([ego_m(k), 0, 1.6], [ego_m(k) + 9, 0, 1.6]), unseen
        )
        for k, stem in enumerate(STEMS)
    )
    poses = np.tile(np.eye(4), (len(STEMS), 1, 1))
    poses[:, 0, 3] = [ego_m(k) for k in range(len(STEMS))]
    ego = Trajectory("world", "ego", np.arange(len(STEMS)) * STEP_NS, poses)
    background = concatenate_meshes([plane(HALF_M, 1, GROUND), *walls])
    cells = int(2 * HALF_M) + 1
    ground = GroundMap(
        np.full(2, -HALF_M),
        1.0,
        np.zeros((cells, cells), np.float32),
        np.ones((cells, cells), bool),
    )
    work = tiny_world(constant_sky(), background=background, fields=SimpleNamespace(ground=ground))
    camera = PinholeCamera("ahead", 96, 64, 48.0, 48.0, 48.0, 32.0)
    log = replace(work.log, cameras={"ahead": camera}, frames=frames, ego=ego, actors=tuple(actors))
    work.__dict__.update(log=log, twin=replace(work.twin, log=log))
    return work


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Run `lightsim scenario` on a street; the edits and the conflicts that simulate finds."""

    def run(work: TinyWorkspace, *words: str) -> tuple[list[dict[str, Any]], tuple[str, ...]]:
        monkeypatch.setattr("lightsim.build.workspace.Workspace", lambda _: work)
        out = tmp_path / "scene.json"
        cli.main(["scenario", words[0], "street", "--out", str(out), *words[1:]])
        request = read_scenario_request(out)
        recorded = replay(work.twin, "scene", work.log.frames)
        library = asset_library(tmp_path, tmp_path)
        return json.loads(out.read_text())["edits"], edited_scenario(
            work, recorded, request, library
        ).notes

    return run


SCENES = {
    "cut-in": ("--from-left",),
    "lane-change": ("--to-left",),
    "hard-brake": (),
    "stalled": ("--left-m", "0"),
    "construction": ("--from-right", "--length-m", "12", "--next-lane"),
    "parked-row": ("--left-m", "-4", "--count", "2"),
}
"""Scenes, and options that leave some fifty places: each is tried where all are taken."""


@pytest.mark.parametrize("scene", SCENES)
def test_on_an_empty_street_a_scene_has_its_usual_place(
    scene: str, written: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    edits, conflicts = written(street(), scene, *SCENES[scene])
    assert not conflicts
    assert {edit["do"] for edit in edits} == {"insert"}
    assert "place" not in capsys.readouterr().out


IN_THE_WAY = {
    "cut-in": (10.0, 3.5), "lane-change": (16.0, 0.0), "hard-brake": (17.0, 0.0),
    "stalled": (26.0, 0.0), "construction": (20.0, -3.5), "parked-row": (12.0, -4.0),
}  # fmt: skip


@pytest.mark.parametrize("scene", SCENES)
def test_a_scene_evades_a_parked_car(
    scene: str, written: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    work = street([car("parked", *IN_THE_WAY[scene])])
    edits, conflicts = written(work, scene, *SCENES[scene])
    assert not conflicts
    assert {edit["do"] for edit in edits} == {"insert"}
    assert "not at the usual place, but at: --" in capsys.readouterr().out


def test_the_printed_options_give_the_same_place(
    written: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    work = street([car("parked", 28.0), car("other", 33.0)])
    edits, _ = written(work, "stalled")
    told = capsys.readouterr().out
    (line,) = [x for x in told.splitlines() if x.startswith("not at the usual place")]
    assert written(work, "stalled", *line.split("but at: ")[1].split())[0] == edits
    assert "usual" not in capsys.readouterr().out


def test_a_wall_is_evaded_though_one_actor_could_be_removed(written: Any) -> None:
    """A wall from 14 m on closes all but 12 to 20 m behind the ego's end, where a car stands."""
    end_m = ego_m(len(STEMS) - 1)
    wall = box((end_m + 45.0, 0.0, 1.5), (50.0, 20.0, 3.0), 0.5)
    work = street([car("parked", end_m + 13.0, length_m=14.0)], [wall])
    edits, conflicts = written(work, "stalled", "--left-m", "0")
    assert len(conflicts) >= 1
    assert all("parked" in conflict for conflict in conflicts)
    edits, conflicts = written(work, "stalled", "--left-m", "0", "--remove-blockers")
    assert not conflicts
    assert edits[0] == {"do": "remove", "actor": "parked"}
    assert [edit["do"] for edit in edits[1:]] == ["insert"] * 4


@pytest.mark.parametrize("scene", SCENES)
def test_where_all_is_taken_the_fewest_actors_are_named_and_removed(
    scene: str, written: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    """One long vehicle over each lane; a scene in two lanes names two."""
    rows = [car(f"row{k}", 60.0, 3.5 * k, length_m=116.0) for k in range(-3, 4)]
    work = street(rows)
    written(work, scene, *SCENES[scene])
    told = capsys.readouterr().out
    is_wide = scene in ("cut-in", "lane-change", "construction")
    count, noun, verb, pronoun = (
        ("2", "actors", "block", "them") if is_wide else ("1", "actor", "blocks", "it")
    )
    (line,) = [x for x in told.splitlines() if x.startswith("no free place")]
    assert line.startswith(f"no free place; {count} {noun} {verb} the place: row")
    assert line.endswith(f"; add --remove-blockers to remove {pronoun}")
    edits, conflicts = written(work, scene, *SCENES[scene], "--remove-blockers")
    assert not conflicts
    removed = [edit["actor"] for edit in edits if edit["do"] == "remove"]
    assert f": {', '.join(removed)};" in line


def test_walls_everywhere_are_told(
    written: Any, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    walls = [box((x, 0.0, 1.5), (0.1, 40.0, 3.0), 0.5) for x in range(16, 100, 2)]
    work = street([car("parked", 30.0)], walls)
    _, conflicts = written(work, "stalled", "--left-m", "0", "--remove-blockers")
    assert conflicts
    assert "no free place; an obstacle that cannot be removed blocks" in capsys.readouterr().out
    assert any("overlaps a wall" in message for message in caplog.messages)


def test_what_a_wall_hides_from_the_front_camera_is_not_offered(written: Any) -> None:
    """A screen hides the road from 18 m on."""
    end_m = ego_m(len(STEMS) - 1)
    screen = box((end_m + 27.0, 0.0, 2.5), (0.2, 80.0, 5.0), 0.5)
    edits, conflicts = written(street((), [screen]), "stalled")
    assert not conflicts
    assert edits[0]["at"]["x_m"] < end_m + 25.0
    near = box((end_m + 19.0, 0.0, 2.5), (0.2, 80.0, 5.0), 0.5)
    edits, conflicts = written(street((), [near]), "stalled")
    assert not conflicts
    assert edits[0]["at"]["x_m"] < end_m + 17.0


def test_the_ego_vehicle_does_not_drive_into_a_scene(written: Any) -> None:
    """It drives 6 m in the log; who brakes 7 m ahead would be hit."""
    edits, conflicts = written(street(), "hard-brake", "--gap-m", "4")
    assert any("the ego vehicle" in conflict for conflict in conflicts)
    assert not written(street(), "hard-brake")[1]
    assert edits[0]["trajectory"]


def moving(name: str, start_m: float, left_m: float) -> ActorTrack:
    """At the ego vehicle's speed."""
    track = car(name, start_m, left_m)
    poses = track.trajectory.matrices.copy()
    poses[:, 0, 3] += SPEED_M_S * track.trajectory.times_ns / 1e9
    path = Trajectory("world", "actor", track.trajectory.times_ns, poses)
    return replace(track, trajectory=path, is_moving=True, size_lwh_m=np.array([4.5, 1.8, 1.5]))


def test_only_what_the_front_camera_sees_is_replaced(written: Any) -> None:
    work = street([moving("behind", -8.0, 0.0), moving("ahead", 20.0, 0.0)])
    edits, conflicts = written(work, "replace")
    assert not conflicts
    assert [edit["actor"] for edit in edits if edit["do"] == "remove"] == ["ahead"]
    assert len(edits) == 2
