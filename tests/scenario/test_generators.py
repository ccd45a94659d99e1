"""Common scenes: every one is a valid scenario, laid out where it says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import Trajectory
from lightsim.errors import InputError
from lightsim.scenario import generators
from lightsim.scenario.edits import Insert, parse_scenario
from lightsim.scenario.generators import Edits, EgoLane

SPEED_M_S, DURATION_S = 8.0, 4.0


@pytest.fixture
def lane() -> EgoLane:
    """A straight drive along world y at 8 m/s."""
    times_ns = np.linspace(0, DURATION_S * 1e9, 41).astype(np.int64)
    poses = np.tile(np.eye(4), (41, 1, 1))
    poses[:, :2, :2] = [[0, -1], [1, 0]]
    poses[:, 1, 3] = SPEED_M_S * times_ns / 1e9
    return EgoLane(Trajectory("world", "ego", times_ns, poses), 0, int(DURATION_S * 1e9))


SCENES: dict[str, Callable[[EgoLane], Edits]] = {
    "cut-in": lambda lane: generators.cut_in(lane, "car"),
    "lane-change": lambda lane: generators.lane_change(lane, "car"),
    "hard-brake": lambda lane: generators.hard_brake(lane, "car"),
    "stalled": lambda lane: generators.stalled(lane, "van"),
    "construction": generators.construction,
    "parked-row": lambda lane: generators.parked_row(lane, ("car", "van")),
}


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_is_a_valid_scenario(name: str, lane: EgoLane) -> None:
    found = parse_scenario({"version": 1, "edits": SCENES[name](lane)}, Path("s.json"))
    assert found.edits
    assert all(isinstance(edit, Insert) for edit in found.edits)


def path_of(edits: Edits) -> np.ndarray:
    """Columns time_s, x_m, y_m, yaw_deg."""
    return np.array([list(point.values()) for point in edits[0]["trajectory"]])


def test_who_cuts_in_comes_from_the_left_into_the_lane(lane: EgoLane) -> None:
    path = path_of(generators.cut_in(lane, "car", gap_m=10.0))
    # Left of a drive along +y is -x.
    assert path[0, 1] == pytest.approx(-3.5)
    assert path[-1, 1] == pytest.approx(0.0)
    np.testing.assert_allclose(path[:, 2], 10.0 + SPEED_M_S * path[:, 0], atol=1e-3)
    assert (np.diff(path[:, 1]) >= 0).all()
    # It looks where it drives: at most 12 degrees off the lane.
    drift = np.degrees(np.arctan2(*np.diff(path[:, 1:3], axis=0).T))
    np.testing.assert_allclose(90.0 - path[:-1, 3], drift, atol=1.5)
    assert np.abs(drift).max() < 15.0


def test_who_brakes_stops_within_the_braking_distance(lane: EgoLane) -> None:
    path = path_of(generators.hard_brake(lane, "car", gap_m=15.0, after_s=0.5))
    wanted_m = 15.0 + 0.5 * SPEED_M_S + SPEED_M_S**2 / (2 * 7.0)
    assert path[-1, 2] == pytest.approx(wanted_m, abs=1e-3)
    assert np.diff(path[:, 2])[-5:] == pytest.approx(0.0)


def test_road_works_stand_on_the_right_half_of_the_lane(lane: EgoLane) -> None:
    edits = generators.construction(lane, ahead_m=8.0, length_m=24.0)
    places = np.array([[e["at"]["x_m"], e["at"]["y_m"]] for e in edits])
    assert (places[:, 0] > 0.8).all()
    assert places[:, 1].min() >= SPEED_M_S * DURATION_S + 5.0
    assert {e["asset"] for e in edits} == {"sign", "cone", "barrier"}


def test_an_actor_of_the_log_cuts_in_on_the_same_path(lane: EgoLane) -> None:
    [inserted] = generators.cut_in(lane, "car")
    [moved] = generators.cut_in(lane, "car", actor_id="white")
    assert moved["actor"] == "white"
    assert moved["trajectory"] == inserted["trajectory"]


def test_road_works_in_the_next_lane_leave_the_ego_its_own(lane: EgoLane) -> None:
    edits = generators.construction(lane, from_left=True, is_next_lane=True)
    left_m = np.array([-edit["at"]["x_m"] for edit in edits])
    assert left_m.min() >= lane.width_m / 2
    assert left_m.max() == pytest.approx(1.5 * lane.width_m)


def track_of(name: str, along_m_s: float, left_m: float) -> ActorTrack:
    """Along world y at a constant speed, 0.3 s longer than the log at both ends."""
    times_ns = np.arange(-300_000_000, 4_400_000_000, 100_000_000)
    poses = np.tile(np.eye(4), (len(times_ns), 1, 1))
    poses[:, :2, :2] = [[0, -1], [1, 0]]
    poses[:, 0, 3] = -left_m
    poses[:, 1, 3] = 12.0 + along_m_s * times_ns / 1e9
    path = Trajectory("world", "actor", times_ns, poses)
    size = np.array([4.5, 1.8, 1.5])
    return ActorTrack(name, ActorKind.CAR, size, path, along_m_s != 0.0)


def test_others_drive_where_the_nearest_movers_drove(lane: EgoLane) -> None:
    tracks = [track_of("far", 7.0, 40.0), track_of("near", 7.0, 3.5), track_of("parked", 0.0, -2)]
    edits = generators.replaced(lane, tracks, ("van",), count=1)
    assert edits[0] == {"do": "remove", "actor": "near"}
    assert edits[1]["asset"] == "van"
    path = path_of(edits[1:])
    # Within the log's pictures, on the track itself.
    assert path[[0, -1], 0].tolist() == [0.0, DURATION_S]
    np.testing.assert_allclose(path[:, 1], -3.5)
    np.testing.assert_allclose(path[:, 2], 12.0 + 7.0 * path[:, 0], atol=1e-3)
    np.testing.assert_allclose(path[:, 3], 90.0)


def test_who_is_named_is_replaced_where_he_stands(lane: EgoLane) -> None:
    tracks = [track_of("near", 7.0, 3.5), track_of("parked", 0.0, -2.0)]
    edits = generators.replaced(lane, tracks, ("van",), ("parked",))
    assert edits[0]["actor"] == "parked"
    assert edits[1]["at"] == {"x_m": 2.0, "y_m": 12.0, "yaw_deg": 90.0}
    with pytest.raises(InputError, match="no such actor"):
        generators.replaced(lane, tracks, ("van",), ("nobody",))
