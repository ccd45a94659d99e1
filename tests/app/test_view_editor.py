"""Boxes and conflicts of the viewer are those of `lightsim simulate`."""

from __future__ import annotations

import json
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.app.edit_comparison import largest_difference
from tests.render.rendering_scenes import constant_sky
from tests.tiny_world import BOX_LWH_M, NOTHING, TinyWorkspace, driving_box, tiny_world

from lightsim import cli
from lightsim.app import paths
from lightsim.app.editing import Edits, remove_actor, set_ego_offset, set_path
from lightsim.app.editor import Editor
from lightsim.app.session import scenario_of
from lightsim.app.state import ViewState
from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.fields import GroundMap
from lightsim.core.frames import Trajectory
from lightsim.core.scenario import Scenario
from lightsim.core.twin import SceneAssets
from lightsim.errors import InputError
from lightsim.scenario.edits import Waypoint
from lightsim.simulation import edited
from lightsim.store.scenario import write_scenario

FRAMES = 6
STEP_NS = 250_000_000
PARKED = "parked"
PERSON = "person without a mesh"


def hilly() -> GroundMap:
    """Ground that rises to the east and has waves, in cells of half a metre."""
    x, y = np.meshgrid(*[np.arange(-60.0, 60.0, 0.5)] * 2, indexing="ij")
    height = (0.05 * x + 0.3 * np.sin(y / 9)).astype(np.float32)
    return GroundMap(np.full(2, -60.0), 0.5, height, np.ones(height.shape, bool))


def street() -> TinyWorkspace:
    """A car that drives, a parked one, and a person without a mesh, on hilly ground."""
    work = tiny_world(
        constant_sky(),
        background=NOTHING,
        fields=SimpleNamespace(ground=hilly()),
        reading=SimpleNamespace(image_scale=1.0),
    )
    camera_frame = work.log.frames[0]
    frames = tuple(
        replace(camera_frame, stem=f"{k:02d}", time_ns=k * STEP_NS) for k in range(FRAMES)
    )
    actors = (driving_box()[1], standing(PARKED, 6.0, ActorKind.CAR),
              standing(PERSON, -9.0, ActorKind.PEDESTRIAN))  # fmt: skip
    ego = replace(work.log.ego, times_ns=np.array([0, 1, FRAMES - 1]) * STEP_NS)
    log = replace(work.log, frames=frames, actors=actors, ego=ego)
    car = work.assets.actors["car"]
    assets = SceneAssets(work.assets.background, {"car": car, PARKED: car}, {})
    work.__dict__.update(log=log, assets=assets, twin=replace(work.twin, log=log, assets=assets))
    return work


def standing(name: str, x_m: float, kind: ActorKind) -> ActorTrack:
    times_ns = np.array([0, FRAMES], dtype=np.int64) * STEP_NS
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = x_m, 3.0, 0.9
    path = Trajectory("world", "actor", times_ns, poses)
    return ActorTrack(name, kind, BOX_LWH_M, path, is_moving=False)


@pytest.fixture(scope="module")
def editor() -> Editor:
    return Editor(street(), library=Path("no library"))


def place(x_m: float, y_m: float, yaw_deg: float = 0.0, z_m: float | None = None) -> Waypoint:
    return Waypoint(x_m=x_m, y_m=y_m, yaw_deg=yaw_deg, z_m=z_m)


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """`lightsim simulate` up to the file with the boxes, without pictures."""
    work = street()

    @contextmanager
    def opened(*_: object) -> Generator[TinyWorkspace]:
        yield work

    def written(_work: object, scenario: Scenario, *_: object) -> list[Path]:
        write_scenario(tmp_path, scenario)
        return [tmp_path]

    monkeypatch.setattr(edited, "opened_for", opened)
    monkeypatch.setattr(edited, "make_frames", written)

    def run(edits: Edits, *options: str) -> Any:
        path = tmp_path / "asked.json"
        path.write_text(json.dumps(scenario_of(ViewState("above", "00", edits=edits), "mine")))
        cli.main(["simulate", "work", str(path), "--library", str(tmp_path), *options])
        return json.loads((tmp_path / "scenario.json").read_text())

    return run


CHANGES = st.lists(
    st.tuples(
        st.sampled_from(["move", "lift", "remove", "insert", "add", "drag", "ego"]),
        st.integers(0, 100), st.floats(-20.0, 20.0), st.floats(-20.0, 20.0),
        st.floats(-180.0, 180.0),
    ),
    max_size=6,
)  # fmt: skip


def with_change(
    editor: Editor, edits: Edits, what: str, number: int, x_m: float, y_m: float, yaw_deg: float
) -> Edits:
    inserted = [str(edit["id"]) for edit in edits if edit["do"] == "insert"]
    names = ["car", PARKED, *inserted]
    name = names[number % len(names)]
    if what == "insert":
        return editor.insert(edits, "cone", place(x_m, y_m, yaw_deg))[0]
    if what == "remove":
        return remove_actor(edits, name)
    if what == "ego":
        return set_ego_offset(edits, (x_m, y_m, 0.0))
    if what in ("move", "lift"):
        z_m = 3.0 if what == "lift" else None
        time_ns = number % FRAMES * STEP_NS
        return editor.move(edits, name, time_ns, place(x_m, y_m, yaw_deg, z_m))
    path = editor.path(edits, name)
    number %= len(path)
    if what == "drag" or (len(path) > 1 and number + 1 == len(path)):
        return set_path(edits, name, paths.drag_waypoint(path, number, x_m, y_m))
    return set_path(edits, name, paths.add_waypoint(path, number, editor.last_s))


@settings(
    deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(CHANGES)
def test_boxes_are_those_of_simulate(editor: Editor, simulated: Any, changes: list[Any]) -> None:
    """Within 1 cm and 0.1 degrees, whatever was changed, in every frame."""
    edits: Edits = ()
    for change in changes:
        edits = with_change(editor, edits, *change)
    written = simulated(edits)
    metres, degrees = largest_difference(editor, edits, written)
    assert metres < 0.01
    assert degrees < 0.1
    assert list(editor.conflicts(edits)) == written["notes"]


def test_the_comparison_notices_a_difference(editor: Editor, simulated: Any) -> None:
    edits = editor.move((), PARKED, 0, place(1.0, 2.0, 10.0))
    written = simulated(editor.move((), PARKED, 0, place(1.0, 2.5, 12.0)))
    metres, degrees = largest_difference(editor, edits, written)
    assert metres == pytest.approx(0.5, abs=0.1)
    assert degrees == pytest.approx(2.0, abs=0.2)
    with pytest.raises(AssertionError):
        largest_difference(editor, remove_actor((), PARKED), written)


def test_boxes_of_fewer_frames_are_the_same(editor: Editor, simulated: Any) -> None:
    edits = editor.move((), "car", 0, place(9.0, 9.0, 45.0))
    written = simulated(edits, "--frames", "2:3")
    assert len(written["frames"]) == 1
    assert largest_difference(editor, edits, written) == pytest.approx((0.0, 0.0), abs=1e-4)


def test_a_moved_car_is_where_it_was_dropped_and_follows_the_ground(editor: Editor) -> None:
    time_ns = 3 * STEP_NS
    edits = editor.move((), "car", time_ns, place(10.0, 12.0, -60.0))
    box = editor.boxes(edits, time_ns)["car"]
    assert box.world_from_actor.translation_m[:2] == pytest.approx([10.0, 12.0], abs=0.1)
    assert np.degrees(box.world_from_actor.yaw_rad) == pytest.approx(-60.0, abs=0.1)
    ground = hilly().look_up(np.array([[10.0, 12.0]]))[0]
    assert box.world_from_actor.translation_m[2] == pytest.approx(ground + 0.75, abs=0.1)


def test_boxes_tell_what_can_be_done_with_an_actor(editor: Editor) -> None:
    edits, name = editor.insert((), "cone", place(6.0, 3.0))
    edits = remove_actor(edits, "car")
    boxes = editor.boxes(edits, 0)
    assert list(boxes) == [PARKED, PERSON, name]
    assert [box.is_edited for box in boxes.values()] == [False, False, True]
    assert [box.has_mesh for box in boxes.values()] == [True, False, True]
    assert boxes[name].kind is ActorKind.CONE
    # The cone stands in the parked car.
    assert [box.is_in_conflict for box in boxes.values()] == [True, False, True]
    assert editor.conflicts(edits) == (f"'{name}' and '{PARKED}' overlap: frames 00 to 05",)


def test_a_conflict_is_marked_while_it_lasts(editor: Editor) -> None:
    """The car passes through the parked one in the middle of its drive."""
    edits: Edits = editor.move((), "car", 2 * STEP_NS, place(6.0, 3.0, 0.0))
    marked = [editor.boxes(edits, k * STEP_NS)["car"].is_in_conflict for k in range(FRAMES - 1)]
    assert marked[2]
    assert not marked[0]
    (sentence,) = (text for text in editor.conflicts(edits) if PARKED in text)
    assert "'car'" in sentence


def test_without_edits_the_scenario_is_the_recorded_one(editor: Editor) -> None:
    """And the scenarios of a drag are kept: that of its start and the current one."""
    assert editor.scenario(()) is editor.recorded
    start = remove_actor((), PARKED)
    before = editor.scenario(start)
    for x_m in range(20):
        edits = editor.move(start, "car", 0, place(float(x_m), 0.0))
        assert editor.scenario(edits) is editor.scenario((*start, dict(edits[1])))
    assert editor.scenario(start) is before


def test_wrong_edits_are_named_and_do_no_harm(editor: Editor) -> None:
    edits = remove_actor((), "car")
    before = editor.scenario(edits)
    with pytest.raises(InputError, match="no such actor"):
        editor.scenario(remove_actor((), "nobody"))
    with pytest.raises(InputError, match="no such actor"):
        editor.move(edits, "nobody", 0, place(0.0, 0.0))
    with pytest.raises(InputError, match="no reconstructed mesh"):
        editor.scenario(editor.move((), PERSON, 0, place(0.0, 0.0)))
    assert editor.scenario(edits) is before


@pytest.mark.parametrize(("group", "left"), [("all", []), ("all-moving", [PARKED, PERSON])])
def test_groups_become_single_actors(editor: Editor, group: str, left: list[str]) -> None:
    at = {"x_m": 0.0, "y_m": 0.0, "yaw_deg": 0.0}
    insert = {"do": "insert", "asset": "cone", "id": "mine", "at": at}
    after = {"do": "insert", "asset": "cone", "id": "later", "at": at}
    single = editor.without_groups((insert, {"do": "remove", "actor": group}, after))
    wanted = [*left, *(["mine"] if group == "all-moving" else []), "later"]
    assert sorted(editor.boxes(single, 0)) == sorted(wanted)
    assert all(edit.get("actor") not in ("all", "all-moving") for edit in single)
    assert editor.without_groups(single) == single


def test_shipped_assets_can_be_inserted(editor: Editor) -> None:
    assert {"cone", "car-red"} <= set(editor.asset_names)
    for asset in editor.asset_names[:3]:
        edits, name = editor.insert((), asset, place(20.0, 20.0))
        assert name in editor.boxes(edits, 0)
