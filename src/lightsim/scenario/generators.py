"""Common scenes as edits, laid out along the ego vehicle's own path: cut-ins, road works and more.

Each function returns edits in the form of SCENARIO.json, which users can read, change and combine.
Places are given by the distance along the recorded path and the offset from it, positive to the
left; beyond its ends the path is extended by straight lines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64

from lightsim.core.actors import ActorTrack
from lightsim.core.frames import Trajectory
from lightsim.core.log import DrivingLog
from lightsim.errors import InputError

# Time between waypoints, in seconds: a lane change has fifteen of them.
_STEP_S = 0.2
# Deceleration of an emergency stop on dry road, m/s^2.
_BRAKING_M_S2 = 7.0
# Duration of a brisk lane change, in seconds; shorter logs show the middle of it.
_CHANGE_S = 3.0
# Least speed of inserted traffic, in m/s, for logs with a standing ego.
_SLOWEST_M_S = 2.0
# Poses of the path closer than this are dropped, in metres: their direction is noise.
_MIN_STEP_M = 0.05

Edits = list[dict[str, Any]]


@dataclass(frozen=True, eq=False)
class EgoLane:
    """The recorded drive as a lane.

    Args:
        path: world_from_ego.
        start_ns, end_ns: times of the first and last picture of the log.
        width_m: width of a lane.
    """

    path: Trajectory
    start_ns: int
    end_ns: int
    width_m: float = 3.5

    @classmethod
    def of(cls, log: DrivingLog, width_m: float = 3.5) -> EgoLane:
        """Return the lane of a log's drive."""
        times_ns = [frame.time_ns for frame in log.frames]
        return cls(log.ego, min(times_ns), max(times_ns), width_m)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last picture, in seconds."""
        return (self.end_ns - self.start_ns) / 1e9

    def times_s(self) -> Float64[np.ndarray, " n"]:
        """Times from the first to the last picture, at most 0.2 s apart."""
        return np.linspace(
            0.0, self.duration_s, max(2, int(np.ceil(self.duration_s / _STEP_S)) + 1)
        )

    def ego_m(self, times_s: Float[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Return the distance of the ego vehicle along the path, in metres."""
        # Every step counts here, while `_line` drops small ones: for a standing ego, whose
        # positions jitter, the two distances differ slightly.
        keys_s = (self.path.times_ns - self.start_ns) / 1e9
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(self._steps, axis=1))])
        return np.interp(times_s, keys_s, along)

    @property
    def speed_m_s(self) -> float:
        """Mean speed of the ego vehicle over the log."""
        ends = self.ego_m(np.array([0.0, self.duration_s]))
        return float(np.diff(ends)[0] / max(self.duration_s, 1e-3))

    @property
    def _steps(self) -> Float64[np.ndarray, "_ 2"]:
        return np.diff(self.path.positions_m[:, :2], axis=0)

    @cached_property
    def _line(self) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, "k 2"]]:
        """Distances and points of the moving part of the path, extended by long straight ends."""
        points = self.path.positions_m[:, :2]
        kept = [points[0]]
        for point in points[1:]:
            if np.linalg.norm(point - kept[-1]) > _MIN_STEP_M:
                kept.append(point)
        first, last = (self.path.matrices[i, :2, 0] for i in (0, -1))
        # 100 m behind and 1 km ahead exceed every layout: np.interp would hold the ends otherwise.
        line = np.array([kept[0] - 100.0 * first, *kept, kept[-1] + 1000.0 * last])
        length = np.linalg.norm(np.diff(line, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(length)]) - length[0], line

    def place(
        self, along_m: Float[np.ndarray, " n"], left_m: Float[np.ndarray, " n"]
    ) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
        """Return (x, y) and heading in degrees, frame `world`."""
        distance, line = self._line
        xy = np.column_stack([np.interp(along_m, distance, line[:, k]) for k in (0, 1)])
        # Over the length of a car: positions of a slow drive jitter by centimetres.
        ends = [
            np.column_stack([np.interp(along_m + s, distance, line[:, k]) for k in (0, 1)])
            for s in (-2.5, 2.5)
        ]
        ahead = ends[1] - ends[0]
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
        return xy + left_m[:, None] * left, np.degrees(np.arctan2(ahead[:, 1], ahead[:, 0]))

    def standing(self, along_m: float, left_m: float, turned_deg: float = 0.0) -> dict[str, float]:
        """Return the entry 'at' of an insertion."""
        xy, yaw_deg = self.place(np.array([along_m]), np.array([left_m]))
        x_m, y_m = (round(float(v), 3) for v in xy[0])
        return {"x_m": x_m, "y_m": y_m, "yaw_deg": round(float(yaw_deg[0]) + turned_deg, 2)}

    def driving(
        self,
        along_m: Callable[[Float64[np.ndarray, " n"]], Float64[np.ndarray, " n"]],
        left_m: Callable[[Float64[np.ndarray, " n"]], Float64[np.ndarray, " n"]],
    ) -> list[dict[str, float]]:
        """Return the entry 'trajectory' of an insertion, from its places over time."""
        times_s = self.times_s()
        along, left = along_m(times_s), left_m(times_s)
        xy, lane_deg = self.place(along, left)
        # Heading follows the motion across the lane; below 0.5 m/s it would jump.
        drift = np.gradient(left, times_s) / np.maximum(np.abs(np.gradient(along, times_s)), 0.5)
        yaw_deg = lane_deg + np.degrees(np.arctan(drift))
        rows = np.column_stack([times_s, xy, yaw_deg])
        keys = ("time_s", "x_m", "y_m", "yaw_deg")
        return [dict(zip(keys, np.round(row, 4).tolist(), strict=True)) for row in rows]


def cut_in(
    lane: EgoLane, asset: str, gap_m: float = 10.0, from_left: bool = True, actor_id: str = ""
) -> Edits:
    """Return a cut-in: a car changes from the neighbouring lane into the ego's lane, `gap_m` ahead
    of the ego (centre to centre), around the middle of the log.

    Args:
        asset: name of the inserted car, if no actor is given.
        actor_id: actor of the log that changes lane.
    """
    side = lane.width_m * (1.0 if from_left else -1.0)
    path = _changing(lane, gap_m, side, 0.0)
    if actor_id:
        return [{"do": "move", "actor": actor_id, "trajectory": path}]
    return [{"do": "insert", "asset": asset, "trajectory": path}]


def lane_change(lane: EgoLane, asset: str, gap_m: float = 15.0, to_left: bool = True) -> Edits:
    """Return a lane change: the car ahead leaves the ego's lane."""
    side = lane.width_m * (1.0 if to_left else -1.0)
    path = _changing(lane, gap_m, 0.0, side)
    return [{"do": "insert", "asset": asset, "trajectory": path}]


def _changing(lane: EgoLane, gap_m: float, start_m: float, end_m: float) -> list[dict[str, float]]:
    speed = max(lane.speed_m_s, _SLOWEST_M_S)
    first_m = float(lane.ego_m(np.zeros(1))[0]) + gap_m

    def left_m(times_s: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        part = np.clip((times_s - lane.duration_s / 2) / _CHANGE_S + 0.5, 0.0, 1.0)
        # A cubic with zero slope at both ends: the car starts and ends parallel to the lane.
        return start_m + (end_m - start_m) * part * part * (3 - 2 * part)

    return lane.driving(lambda t: first_m + speed * t, left_m)


def hard_brake(lane: EgoLane, asset: str, gap_m: float = 15.0, after_s: float = 0.5) -> Edits:
    """Return an emergency stop of the car ahead, which before drives at the ego's mean speed."""
    speed = max(lane.speed_m_s, _SLOWEST_M_S)
    first_m = float(lane.ego_m(np.zeros(1))[0]) + gap_m

    def along_m(times_s: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        braking_s = np.clip(times_s - after_s, 0.0, speed / _BRAKING_M_S2)
        driven = speed * (np.minimum(times_s, after_s) + braking_s)
        return first_m + driven - 0.5 * _BRAKING_M_S2 * braking_s**2

    return [{"do": "insert", "asset": asset, "trajectory": lane.driving(along_m, np.zeros_like)}]


def stalled(lane: EgoLane, asset: str, ahead_m: float = 20.0, left_m: float = 0.0) -> Edits:
    """Return a stalled vehicle in the ego's lane, slightly rotated, with three cones behind it."""
    here = float(lane.ego_m(np.array([lane.duration_s]))[0]) + ahead_m
    cones = [
        {"do": "insert", "asset": "cone", "at": lane.standing(here - back, left_m + side)}
        for back, side in ((4.5, 0.9), (7.0, 0.3), (9.5, -0.3))
    ]
    return [{"do": "insert", "asset": asset, "at": lane.standing(here, left_m, 8.0)}, *cones]


def construction(
    lane: EgoLane,
    ahead_m: float = 8.0,
    length_m: float = 24.0,
    from_left: bool = False,
    is_next_lane: bool = False,
) -> Edits:
    """Return road works that close half of the lane, or all of the next one: cones along a taper,
    barriers behind it, and a sign.

    Cones of the taper are 2 m apart and cover the first half of the zone.
    """
    side = 1.0 if from_left else -1.0
    first = float(lane.ego_m(np.array([lane.duration_s]))[0]) + ahead_m
    widths = (1.5, 0.5) if is_next_lane else (0.75, 0.25)
    outer, inner = (width * lane.width_m for width in widths)
    taper_m = length_m / 2
    edits: Edits = [
        {"do": "insert", "asset": "sign", "at": lane.standing(first - 3.0, side * outer, 180.0)}
    ]
    for along in np.arange(0.0, taper_m, 2.0).tolist():
        across = side * (outer + (inner - outer) * along / taper_m)
        edits.append({"do": "insert", "asset": "cone", "at": lane.standing(first + along, across)})
    for along in np.arange(taper_m + 2.0, length_m, 3.2).tolist():
        at = lane.standing(first + along, side * (inner + 0.4))
        edits.append({"do": "insert", "asset": "barrier", "at": at})
    return edits


def replaced(
    lane: EgoLane,
    tracks: Sequence[ActorTrack],
    assets: tuple[str, ...],
    actor_ids: tuple[str, ...] = (),
    count: int = 3,
) -> Edits:
    """Replace vehicles of the log by assets, in turn.

    Args:
        tracks: actors of the log.
        actor_ids: actors to replace; empty: the `count` moving vehicles with the least distance
            from the ego.

    Raises:
        InputError: there is no asset, an actor is unknown, or no actor can be replaced.
    """
    if not assets:
        raise InputError("no asset is given", got=assets, expected="one asset or more")
    by_id = {track.actor_id: track for track in tracks if _during(lane, track).any()}
    unknown = [name for name in actor_ids if name not in by_id]
    if unknown:
        raise InputError(
            "there is no such actor",
            got=", ".join(unknown),
            expected="actors of the log",
            remedy="lightsim actors WORK lists them.",
        )
    chosen = [by_id[name] for name in actor_ids] or nearest_movers(lane, tracks)[:count]
    if not chosen:
        raise InputError("no actor can be replaced", expected="a moving vehicle, or ids of actors")
    edits: Edits = [{"do": "remove", "actor": track.actor_id} for track in chosen]
    for k, track in enumerate(chosen):
        edits.append({"do": "insert", "asset": assets[k % len(assets)], **_as_driven(lane, track)})
    return edits


def nearest_movers(lane: EgoLane, tracks: Sequence[ActorTrack]) -> list[ActorTrack]:
    """Return the vehicles that move between the first and the last picture, sorted by their least
    distance from the ego vehicle."""
    moving = [t for t in tracks if t.is_moving and t.kind.is_vehicle and _during(lane, t).any()]
    return sorted(moving, key=lambda track: _nearest_m(lane, track))


def _during(lane: EgoLane, track: ActorTrack) -> Bool[np.ndarray, " n"]:
    """Return the poses of a track between the first and the last picture, the limits of edits."""
    times_ns = track.trajectory.times_ns
    return (times_ns >= lane.start_ns) & (times_ns <= lane.end_ns)


def _nearest_m(lane: EgoLane, track: ActorTrack) -> float:
    ego = lane.path.held_at(track.trajectory.times_ns)[:, :2, 3]
    away = track.trajectory.positions_m[:, :2] - ego
    return float(np.linalg.norm(away, axis=1)[_during(lane, track)].min())


def _as_driven(lane: EgoLane, track: ActorTrack) -> dict[str, Any]:
    """Return the entry 'trajectory' of an insertion that follows a track; 'at' if it stands."""
    poses = track.trajectory.matrices[_during(lane, track)]
    times_s = (track.trajectory.times_ns[_during(lane, track)] - lane.start_ns) / 1e9
    yaw_deg = np.degrees(np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0])))
    keys = ("time_s", "x_m", "y_m", "yaw_deg")
    rows = np.column_stack([times_s, poses[:, :2, 3], yaw_deg])
    path = [dict(zip(keys, np.round(row, 4).tolist(), strict=True)) for row in rows]
    if track.is_moving and len(path) > 1:
        return {"trajectory": path}
    return {"at": {key: path[0][key] for key in keys[1:]}}


def parked_row(
    lane: EgoLane,
    assets: tuple[str, ...],
    count: int = 5,
    left_m: float = -4.0,
    spacing_m: float = 6.5,
    ahead_m: float = 6.0,
) -> Edits:
    """Return a row of vehicles parked along the road, in turn of the assets.

    Raises:
        InputError: there is no asset, or nothing to park.
    """
    if not assets or count < 1:
        raise InputError(
            "the parked row would be empty", got=count, expected="assets, and a count of 1 or more"
        )
    first = float(lane.ego_m(np.zeros(1))[0]) + ahead_m
    return [
        {
            "do": "insert",
            "asset": assets[k % len(assets)],
            "at": lane.standing(first + k * spacing_m, left_m),
        }
        for k in range(count)
    ]
