"""Changes of the edits: one entry an actor, rigid motions, waypoints, and what may be written."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lightsim.app import editing, paths
from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.fields import GroundMap
from lightsim.core.frames import Trajectory
from lightsim.errors import InputError
from lightsim.scenario.edits import Insert, Move, Path3, Waypoint, parse_scenario
from lightsim.scenario.ground import StandingGround
from lightsim.scenario.motion import moved_along

FIRST_NS = 1_557_540_000_000_000_000
LAST_S = 4.0
SPAN_NS = FIRST_NS, FIRST_NS + int(LAST_S * 1e9)
SIZE = np.array([4.5, 1.8, 1.5])
FLAT = StandingGround(
    GroundMap(np.full(2, -100.0), 1.0, np.zeros((201, 201), np.float32), np.ones((201, 201), bool))
)
METRES = st.floats(-50.0, 50.0)
DEGREES = st.floats(-180.0, 180.0)
POSES = st.tuples(METRES, METRES, DEGREES)
SHORT = settings(deadline=None, max_examples=50)


def track_of(actor_id: str, poses: np.ndarray, times_s: np.ndarray) -> ActorTrack:
    times_ns = FIRST_NS + np.rint(times_s * 1e9).astype(np.int64)
    is_moving = len(poses) > 1
    return ActorTrack(
        actor_id, ActorKind.CAR, SIZE, Trajectory("world", "actor", times_ns, poses), is_moving
    )


def turning_car() -> ActorTrack:
    """A drive on a quarter of a circle of 20 m, labelled before, during and after the log."""
    times_s = np.arange(-0.2, LAST_S + 0.21, 0.1)
    angle = np.linspace(0.0, np.pi / 2, len(times_s))
    poses = np.tile(np.eye(4), (len(angle), 1, 1))
    c, s = np.cos(angle), np.sin(angle)
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = c, -s, s, c
    poses[:, :3, 3] = np.column_stack([20 * s, 20 - 20 * c, np.full(len(angle), 0.75)])
    return track_of("car", poses, times_s)


def parked_car() -> ActorTrack:
    poses = np.eye(4)[None].copy()
    poses[0, :3, 3] = 3.0, -6.0, 0.75
    return track_of("parked", poses, np.zeros(1))


def place(x_m: float, y_m: float, yaw_deg: float, z_m: float | None = None) -> Waypoint:
    return Waypoint(x_m=x_m, y_m=y_m, yaw_deg=yaw_deg, z_m=z_m)


def read(edits: editing.Edits) -> tuple[Any, ...]:
    """The edits as the reader of SCENARIO.json understands them; it rejects wrong ones."""
    value = {"version": 1, "edits": [dict(edit) for edit in edits]}
    return parse_scenario(value, Path("view.json")).edits


def path_in(edits: editing.Edits) -> Path3:
    (edit,) = read(edits)
    assert isinstance(edit, Move | Insert)
    return edit.waypoints


def driven(path: Path3) -> ActorTrack:
    """The track that a simulation makes of a path."""
    where = "test"
    trajectory = moved_along(path, SPAN_NS, (ActorKind.CAR, SIZE), FLAT, where)
    return replace(turning_car(), trajectory=trajectory)


def positions(path: Path3) -> np.ndarray:
    return np.array([[w.x_m, w.y_m] for w in path])


def distances(path: Path3) -> np.ndarray:
    xy = positions(path)
    return np.linalg.norm(xy[:, None] - xy, axis=2)


CHANGES = st.lists(
    st.tuples(
        st.sampled_from(["remove", "restore", "move", "insert"]),
        st.sampled_from(["a", "b", "cone-1", "cone-2"]),
        POSES,
    ),
    max_size=12,
)


def changed(edits: editing.Edits, what: str, actor_id: str, pose: Any) -> editing.Edits:
    here = place(*pose)
    if what == "remove":
        return editing.remove_actor(edits, actor_id)
    if what == "restore":
        return editing.restore_actor(edits, actor_id)
    if what == "insert":
        return editing.insert_asset(edits, "cone", here, {"a", "b"})[0]
    return editing.set_path(edits, actor_id, (here,))


def actor_of(edit: Any) -> str:
    return edit.actor_id if isinstance(edit, Insert) else edit.actor


@SHORT
@given(CHANGES)
def test_an_actor_has_one_entry_which_later_changes_replace_in_place(changes: list[Any]) -> None:
    edits: editing.Edits = ()
    for what, actor_id, pose in changes:
        before = [actor_of(edit) for edit in read(edits)]
        if actor_id.startswith("cone") and what != "insert" and actor_id not in before:
            continue
        edits = changed(edits, what, actor_id, pose)
        after = [actor_of(edit) for edit in read(edits)]
        assert len(set(after)) == len(after)
        # Entries of other actors keep their order, and new ones are the last.
        kept = [name for name in before if name in after]
        assert after[: len(kept)] == kept
        if what == "restore":
            assert editing.entry_of(edits, actor_id) is None
        elif what == "move":
            assert editing.entry_of(edits, actor_id) in edits
    for name in ("a", "b", *(f"cone-{number}" for number in range(1, 13))):
        edits = editing.restore_actor(edits, name)
    assert edits == ()


def test_a_removed_actor_is_restored_and_an_inserted_one_vanishes() -> None:
    edits = editing.remove_actor((), "a")
    assert edits == ({"do": "remove", "actor": "a"},)
    assert editing.restore_actor(edits, "a") == ()
    edits, name = editing.insert_asset(edits, "cone", place(1.0, 2.0, 3.0), {"a"})
    assert editing.remove_actor(edits, name) == edits[:1]


def test_an_inserted_asset_has_a_unique_id_and_stands_on_the_ground() -> None:
    edits, name = editing.insert_asset((), "cone", place(1.00004, -0.00001, 90.0), {"cone-1"})
    at = {"x_m": 1.0, "y_m": 0.0, "yaw_deg": 90.0}
    assert edits == ({"do": "insert", "asset": "cone", "id": "cone-2", "at": at},)
    assert name == "cone-2"
    assert all(type(value) is float for value in at.values())
    edits, name = editing.insert_asset(edits, "cone", place(0.0, 0.0, 0.0), {"cone-1"})
    assert name == "cone-3"
    for asset, wanted in (("my models/Red van.glb", "Red-van-1"), ("other/work#id:7", "id-7-1")):
        edits, name = editing.insert_asset(edits, asset, place(0.0, 0.0, 0.0), ())
        assert name == wanted
    assert len(read(edits)) == 4


def test_a_parked_car_is_moved_with_one_waypoint() -> None:
    track = parked_car()
    edits = editing.move_actor((), track, SPAN_NS, SPAN_NS[1], place(1.5, 2.5, 30.0))
    assert edits[0] == {
        "do": "move", "actor": "parked", "at": {"x_m": 1.5, "y_m": 2.5, "yaw_deg": 30.0}
    }  # fmt: skip
    lifted = editing.move_actor(edits, track, SPAN_NS, SPAN_NS[0], place(1.5, 2.5, 30.0, 4.0))
    assert lifted[0]["at"]["z_m"] == 4.0
    assert path_in(lifted)[0].z_m == 4.0


@SHORT
@given(POSES, st.floats(0.0, LAST_S))
def test_a_driving_car_is_moved_like_a_rigid_body(pose: Any, time_s: float) -> None:
    """All distances between its poses are kept, all headings turn by the same angle, and at the
    time of the drag the car is where it was dropped."""
    track = turning_car()
    before = editing.path_of((), track, SPAN_NS)
    time_ns = SPAN_NS[0] + round(time_s * 1e9)
    edits = editing.move_actor((), track, SPAN_NS, time_ns, place(*pose))
    after = path_in(edits)
    assert [w.time_s for w in after] == pytest.approx([w.time_s for w in before], abs=1e-4)
    assert [w.z_m for w in after] == [None] * len(before)
    assert distances(after) == pytest.approx(distances(before), abs=2e-4)
    yaws = [np.array([w.yaw_deg for w in path]) for path in (before, after)]
    turn = (yaws[1] - yaws[0]) % 360.0
    assert np.abs((turn - turn[0] + 180) % 360 - 180).max() < 3e-4
    dropped = paths.place_of(driven(after), time_ns)
    # Between waypoints half a second apart a cubic and the circle differ by centimetres.
    assert dropped.x_m == pytest.approx(pose[0], abs=0.1)
    assert dropped.y_m == pytest.approx(pose[1], abs=0.1)
    assert dropped.yaw_deg is not None
    assert paths.wrapped_deg(dropped.yaw_deg - pose[2]) == pytest.approx(0.0, abs=0.1)


def test_a_sampled_path_reproduces_the_drive_of_the_log() -> None:
    """Both ends are in it, cut to the time of the log, and poses between waypoints agree."""
    track = turning_car()
    path = editing.path_of((), track, SPAN_NS)
    times_s = [w.time_s for w in path]
    assert (times_s[0], times_s[-1]) == (0.0, LAST_S)
    assert np.diff(times_s).max() <= 0.5
    again = driven(path)
    for time_ns in np.linspace(*SPAN_NS, 50).astype(np.int64).tolist():
        one, other = (paths.place_of(t, time_ns) for t in (track, again))
        assert np.hypot(one.x_m - other.x_m, one.y_m - other.y_m) < 0.06
        assert one.yaw_deg == pytest.approx(other.yaw_deg, abs=0.1)
        assert one.z_m == pytest.approx(other.z_m, abs=1e-4)


def test_repeated_drags_do_not_wear_a_path_out() -> None:
    """Waypoints are moved, not sampled again."""
    track = turning_car()
    edits = editing.move_actor((), track, SPAN_NS, SPAN_NS[0], place(0.0, 0.0, 0.0))
    first = path_in(edits)
    for _ in range(20):
        for pose in ((10.0, 5.0, 120.0), (0.0, 0.0, 0.0)):
            track = driven(path_in(edits))
            edits = editing.move_actor(edits, track, SPAN_NS, SPAN_NS[0], place(*pose))
    assert np.abs(positions(path_in(edits)) - positions(first)).max() < 5e-3


def test_a_lifted_drive_keeps_its_heights_and_is_put_back_on_the_ground() -> None:
    track = turning_car()
    here = paths.place_of(track, SPAN_NS[0])
    assert here.z_m == pytest.approx(0.0)
    edits = editing.move_actor((), track, SPAN_NS, SPAN_NS[0], replace(here, z_m=2.0))
    assert {w.z_m for w in path_in(edits)} == {2.0}
    higher = paths.place_of(driven(path_in(edits)), SPAN_NS[0])
    assert higher.z_m == pytest.approx(2.0)
    edits = editing.move_actor(edits, driven(path_in(edits)), SPAN_NS, SPAN_NS[0], here)
    assert {w.z_m for w in path_in(edits)} == {0.0}
    down = replace(here, z_m=None)
    edits = editing.move_actor(edits, driven(path_in(edits)), SPAN_NS, SPAN_NS[0], down)
    assert {w.z_m for w in path_in(edits)} == {None}


def test_a_lifting_offset_is_a_lifted_path() -> None:
    for up, is_lifted in ((0.0, False), (1.0, True)):
        edits = ({"do": "move", "actor": "car", "offset_m": [1.0, 0.0, up]},)
        path = editing.path_of(edits, turning_car(), SPAN_NS)
        assert (path[0].z_m is not None) == is_lifted


def test_a_track_outside_the_log_or_too_short_gives_one_place() -> None:
    car = turning_car().trajectory
    late = track_of("late", car.matrices[:3], np.array([LAST_S - 0.001, LAST_S + 1, LAST_S + 2]))
    assert len(editing.path_of((), late, SPAN_NS)) == 1
    assert len(editing.path_of((), parked_car(), SPAN_NS)) == 1


WAYPOINT_CHANGES = st.lists(
    st.tuples(
        st.sampled_from(["drag", "turn", "time", "add", "delete"]),
        st.integers(0, 100), METRES, METRES, st.floats(-1.0, 6.0),
    ),
    max_size=15,
)  # fmt: skip


def with_change(path: Path3, what: str, number: int, x_m: float, y_m: float, s: float) -> Path3:
    number %= len(path)
    if what == "drag":
        return paths.drag_waypoint(path, number, x_m, y_m)
    if what == "turn":
        return paths.turn_waypoint(path, number, 30 * s)
    if what == "time":
        return paths.time_waypoint(path, number, s, LAST_S)
    with suppress(InputError):
        if what == "add":
            return paths.add_waypoint(path, number, LAST_S)
        return paths.delete_waypoint(path, number)
    return path


@SHORT
@given(WAYPOINT_CHANGES, st.sampled_from(["parked", "car", "follows"]))
def test_every_sequence_of_waypoint_changes_can_be_simulated(
    changes: list[Any], which: str
) -> None:
    track = parked_car() if which == "parked" else turning_car()
    path = editing.path_of((), track, SPAN_NS)
    if which == "follows":
        path = tuple(replace(waypoint, yaw_deg=None) for waypoint in path)
    for change in changes:
        path = with_change(path, *change)
        edits = editing.set_path((), track.actor_id, path)
        written = path_in(edits)
        assert positions(written) == pytest.approx(positions(path), abs=1e-4)
        assert editing.path_of(edits, track, SPAN_NS) == written
        assert np.isfinite(driven(written).trajectory.matrices).all()


def test_dragging_a_waypoint_turns_the_car_along_its_path() -> None:
    """Also if it drives backwards; where it stands, its heading stays."""
    ahead = tuple(Waypoint(time_s=float(k), x_m=5.0 * k, y_m=0.0, yaw_deg=180.0) for k in range(4))
    path = (*ahead, replace(ahead[-1], time_s=4.0))
    dragged = paths.drag_waypoint(path, 1, 5.0, 5.0)
    yaws = [w.yaw_deg for w in dragged]
    assert yaws == pytest.approx([-135.0, 180.0, 153.43495, 180.0, 180.0])


def test_a_parked_car_drives_off() -> None:
    path = editing.path_of((), parked_car(), SPAN_NS)
    path = paths.add_waypoint(path, 0, LAST_S)
    assert [w.time_s for w in path] == [0.0, LAST_S]
    assert positions(path) == pytest.approx(np.array([[3.0, -6.0], [8.0, -6.0]]))
    path = paths.drag_waypoint(path, 1, 3.0, 10.0)
    assert paths.place_of(driven(path), SPAN_NS[1]).yaw_deg == pytest.approx(90.0)
    back = paths.delete_waypoint(path, 1)
    assert back[0].yaw_deg == pytest.approx(90.0)
    with pytest.raises(InputError, match="only waypoint"):
        paths.delete_waypoint(back, 0)


def test_new_waypoints_lie_on_the_path_or_continue_it() -> None:
    path = editing.path_of((), turning_car(), SPAN_NS)
    between = paths.add_waypoint(path, 2, LAST_S)
    assert between[:3] + between[4:] == path
    on_path = paths.place_of(turning_car(), SPAN_NS[0] + round(between[3].time_s * 1e9))
    assert between[3].x_m == pytest.approx(on_path.x_m, abs=0.06)
    assert between[3].yaw_deg == pytest.approx(on_path.yaw_deg, abs=0.1)
    with pytest.raises(InputError, match="no time for another waypoint"):
        paths.add_waypoint(path, len(path) - 1, LAST_S)
    short = path[:3]
    longer = paths.add_waypoint(short, 2, LAST_S)
    xy = positions(longer)
    assert xy[3] - xy[2] == pytest.approx(xy[2] - xy[1])
    assert longer[3].time_s == 1.5


def test_times_stay_between_neighbours_and_in_the_log() -> None:
    path = editing.path_of((), turning_car(), SPAN_NS)
    for number, wanted, found in ((0, -3.0, 0.0), (8, 9.0, LAST_S), (1, 3.0, 0.99), (1, 0.7, 0.7)):
        assert paths.time_waypoint(path, number, wanted, LAST_S)[number].time_s == found


def test_the_offset_of_the_ego_is_one_entry_and_zero_drops_it() -> None:
    assert editing.ego_offset(()) == (0.0, 0.0, 0.0)
    edits = editing.set_ego_offset(editing.remove_actor((), "a"), (0.0, 1.5, -0.25))
    assert editing.ego_offset(edits) == (0.0, 1.5, -0.25)
    edits = editing.set_ego_offset(edits, (2.0, 0.0, 0.0))
    assert edits[1:] == ({"do": "ego", "offset_m": [2.0, 0.0, 0.0]},)
    assert editing.set_ego_offset(edits, (0.0, 0.0, 0.00001)) == edits[:1]


def test_a_path_of_the_ego_is_kept_below_its_offset() -> None:
    ends = [{"time_s": t, "x_m": 5 * t, "y_m": 0.0} for t in (0.0, LAST_S)]
    path = {"do": "ego", "trajectory": ends}
    before = {"do": "ego", "offset_m": [1.0, 0.0, 0.0]}
    assert editing.ego_offset((before, path)) == (0.0, 0.0, 0.0)
    assert editing.ego_offset((path, before, before)) == (2.0, 0.0, 0.0)
    assert editing.set_ego_offset((before, path), (0.0, 1.0, 0.0)) == (
        path, {"do": "ego", "offset_m": [0.0, 1.0, 0.0]}
    )  # fmt: skip
