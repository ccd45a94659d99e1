"""Paths of actors: sampled from tracks, moved rigidly, and changed one waypoint at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from lightsim.core.actors import ActorTrack
from lightsim.errors import InputError
from lightsim.scenario.edits import Path3, Waypoint

# Largest time between the waypoints of a sampled path, in seconds: labels of recordings are 0.1 to
# 0.5 s apart.
_MAX_STEP_S = 0.5
# Smallest time between two waypoints, in seconds: above the rounding of written times.
_MIN_STEP_S = 0.01
# Distance of the second waypoint from the first, in metres: about the length of a car.
_AHEAD_M = 5.0
# Distance below which neighbouring waypoints do not determine a heading, in metres: labels of
# standing actors jitter by less.
_NO_MOTION_M = 0.3
# Extent below which a path counts as without motion, in metres: rounding of written numbers.
_SAME_M = 1e-3


def place_of(track: ActorTrack, time_ns: int) -> Waypoint:
    """Return the pose of a track at a time (beyond an end, that of the end) as a waypoint with the
    height of the underside."""
    pose = track.trajectory.held(time_ns)
    x_m, y_m, z_m = (float(metres) for metres in pose.translation_m)
    yaw_deg = float(np.degrees(pose.yaw_rad))
    return Waypoint(x_m=x_m, y_m=y_m, z_m=z_m - float(track.size_lwh_m[2]) / 2, yaw_deg=yaw_deg)


def sampled_path(track: ActorTrack, span_ns: tuple[int, int]) -> Path3:
    """Return waypoints of a track with headings and heights: both ends, and at most 0.5 s between.

    Parts before the first or after the last picture are cut off. A track without motion, or with
    less than 0.01 s in the log, gives one waypoint.

    Args:
        span_ns: times of the first and the last picture of the log.
    """
    start_ns = max(track.trajectory.start_ns, span_ns[0])
    end_ns = min(track.trajectory.end_ns, span_ns[1])
    length_s = (end_ns - start_ns) / 1e9
    if not track.is_moving or length_s < _MIN_STEP_S:
        return (place_of(track, (start_ns + end_ns) // 2),)
    count = int(np.ceil(length_s / _MAX_STEP_S)) + 1
    times_ns = start_ns + np.rint(np.linspace(0.0, length_s, count) * 1e9).astype(np.int64)
    return tuple(
        replace(place_of(track, time_ns), time_s=(time_ns - span_ns[0]) / 1e9)
        for time_ns in times_ns.tolist()
    )


def with_heights(path: Path3, track: ActorTrack, start_ns: int) -> Path3:
    """Return a path with the heights of the track's underside at the times of its waypoints.

    Args:
        start_ns: time of the first picture of the log.
    """
    times_ns = (start_ns + round(waypoint.time_s * 1e9) for waypoint in path)
    heights_m = (place_of(track, time_ns).z_m for time_ns in times_ns)
    return tuple(replace(w, z_m=z_m) for w, z_m in zip(path, heights_m, strict=True))


def moved_rigidly(path: Path3, old_pose: Waypoint, new_pose: Waypoint) -> Path3:
    """Return a path after the rigid motion that maps one pose to another.

    Args:
        old_pose: the first pose, with heading and height.
        new_pose: the second pose, with heading; without `z_m` the path follows the ground.
    """
    assert old_pose.yaw_deg is not None
    assert new_pose.yaw_deg is not None
    turn_deg = new_pose.yaw_deg - old_pose.yaw_deg
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))

    def moved(waypoint: Waypoint) -> Waypoint:
        x_m, y_m = waypoint.x_m - old_pose.x_m, waypoint.y_m - old_pose.y_m
        z_m = None
        if new_pose.z_m is not None and waypoint.z_m is not None:
            z_m = waypoint.z_m + new_pose.z_m - (old_pose.z_m or 0.0)
        return Waypoint(
            time_s=waypoint.time_s,
            x_m=float(new_pose.x_m + c * x_m - s * y_m),
            y_m=float(new_pose.y_m + s * x_m + c * y_m),
            z_m=z_m,
            yaw_deg=None if waypoint.yaw_deg is None else wrapped_deg(waypoint.yaw_deg + turn_deg),
        )

    return tuple(moved(waypoint) for waypoint in path)


def drag_waypoint(path: Path3, number: int, x_m: float, y_m: float) -> Path3:
    """Return a path with one waypoint at another position.

    Given headings turn by as much as the direction of motion there, so that a car that drives
    backwards continues to do so.
    """
    dragged = _replaced(path, number, replace(path[number], x_m=x_m, y_m=y_m))
    turn_deg = np.nan_to_num(_directions_deg(dragged) - _directions_deg(path))
    turned = tuple(
        w if w.yaw_deg is None else replace(w, yaw_deg=wrapped_deg(w.yaw_deg + turn))
        for w, turn in zip(dragged, turn_deg.tolist(), strict=True)
    )
    return _with_direction(turned, headings_deg(path))


def turn_waypoint(path: Path3, number: int, yaw_deg: float) -> Path3:
    """Return a path with another heading at one waypoint. If headings followed the path before,
    the other waypoints retain their headings."""
    if path[number].yaw_deg is None:
        path = _with_headings(path, headings_deg(path))
    return _replaced(path, number, replace(path[number], yaw_deg=wrapped_deg(yaw_deg)))


def time_waypoint(path: Path3, number: int, time_s: float, last_s: float) -> Path3:
    """Return a path that reaches one waypoint at another time, limited by its neighbours and the
    log.

    Args:
        time_s: seconds from the first picture of the log.
        last_s: time of the last picture.
    """
    low = path[number - 1].time_s + _MIN_STEP_S if number > 0 else 0.0
    high = path[number + 1].time_s - _MIN_STEP_S if number + 1 < len(path) else last_s
    time_s = path[number].time_s if low > high else min(max(time_s, low), high)
    return _replaced(path, number, replace(path[number], time_s=time_s))


def add_waypoint(path: Path3, after: int, last_s: float) -> Path3:
    """Return a path with a new waypoint, number `after` + 1.

    Between two waypoints it lies on the path, half-way in time. After the last one it continues
    the motion for as long as the last part took. A standing actor gets a second waypoint 5 m ahead
    at the end of the log, and its heading follows the path.

    Args:
        last_s: time of the last picture of the log, in seconds from the first one.

    Raises:
        InputError: there is no time left for it.
    """
    if len(path) == 1:
        path, new = _start_of_motion(path[0], last_s)
    elif after + 1 == len(path):
        new = _continued(path[after - 1], path[after], last_s)
    else:
        new = _interpolated(path, (path[after].time_s + path[after + 1].time_s) / 2)
    if new.time_s - path[after].time_s < _MIN_STEP_S:
        raise InputError(
            "there is no time for another waypoint",
            where=f"waypoint {after + 1} of {len(path)}",
            got=f"{path[after].time_s:.3f} s, and the log ends at {last_s:.3f} s",
            expected=f"at least {_MIN_STEP_S:g} s between waypoints",
            remedy="Give this waypoint an earlier time, or add one between two others.",
        )
    return (*path[: after + 1], new, *path[after + 1 :])


def delete_waypoint(path: Path3, number: int) -> Path3:
    """Return a path without one waypoint. If one remains, it is the pose for the whole log.

    Raises:
        InputError: it is the only one.
    """
    if len(path) == 1:
        raise InputError(
            "the only waypoint of a path cannot be deleted",
            got="1 waypoint",
            expected="two waypoints or more",
            remedy="Remove the actor instead.",
        )
    left_deg = np.delete(headings_deg(path), number)
    return _with_direction((*path[:number], *path[number + 1 :]), left_deg)


def wrapped_deg(angle_deg: float) -> float:
    """Return an angle in (-180, 180] degrees."""
    return float(180.0 - (180.0 - angle_deg) % 360.0)


def _replaced(path: Path3, number: int, waypoint: Waypoint) -> Path3:
    return (*path[:number], waypoint, *path[number + 1 :])


def _start_of_motion(place: Waypoint, last_s: float) -> tuple[Path3, Waypoint]:
    """Return the start of a path, and its end straight ahead, of an actor that stood."""
    yaw_rad = np.radians(place.yaw_deg or 0.0)
    x_m = float(place.x_m + _AHEAD_M * np.cos(yaw_rad))
    y_m = float(place.y_m + _AHEAD_M * np.sin(yaw_rad))
    start = replace(place, time_s=0.0, yaw_deg=None)
    return (start,), replace(start, time_s=last_s, x_m=x_m, y_m=y_m)


def _continued(before: Waypoint, last: Waypoint, last_s: float) -> Waypoint:
    """Return the place after the last waypoint, at the velocity of the last part."""
    step_s = last.time_s - before.time_s
    time_s = min(last.time_s + step_s, last_s)
    fraction = (time_s - last.time_s) / step_s
    x_m = last.x_m + fraction * (last.x_m - before.x_m)
    y_m = last.y_m + fraction * (last.y_m - before.y_m)
    return replace(last, time_s=time_s, x_m=x_m, y_m=y_m)


def _interpolated(path: Path3, time_s: float) -> Waypoint:
    """Return the place on a path at a time, interpolated as `scenario.motion.moved_along` does."""
    from scipy.interpolate import PchipInterpolator

    times_s = [w.time_s for w in path]
    x_m, y_m = PchipInterpolator(times_s, np.array([[w.x_m, w.y_m] for w in path]))(time_s)
    z_m = [w.z_m for w in path if w.z_m is not None]
    yaw_rad = np.unwrap(np.radians([w.yaw_deg for w in path if w.yaw_deg is not None]))
    return Waypoint(
        time_s=time_s,
        x_m=float(x_m),
        y_m=float(y_m),
        z_m=float(np.interp(time_s, times_s, z_m)) if z_m else None,
        yaw_deg=wrapped_deg(np.degrees(np.interp(time_s, times_s, yaw_rad)))
        if len(yaw_rad)
        else None,
    )


def _directions_deg(path: Path3) -> Float64[np.ndarray, " n"]:
    """Return the direction of motion at each waypoint, from its neighbours; NaN without motion."""
    xy = np.array([[w.x_m, w.y_m] for w in path])
    numbers = np.arange(len(path))
    chord = xy[np.minimum(numbers + 1, len(path) - 1)] - xy[np.maximum(numbers - 1, 0)]
    is_motion = np.linalg.norm(chord, axis=1) > _NO_MOTION_M
    return np.where(is_motion, np.degrees(np.arctan2(chord[:, 1], chord[:, 0])), np.nan)


def headings_deg(path: Path3) -> Float64[np.ndarray, " n"]:
    """Return the given heading at each waypoint. Without headings, return the direction of motion,
    taken from the nearest moving waypoint where there is no motion."""
    given = [w.yaw_deg for w in path if w.yaw_deg is not None]
    if given:
        return np.array(given)
    directions = _directions_deg(path)
    moving = np.flatnonzero(~np.isnan(directions))
    if not len(moving):
        return np.zeros(len(path))
    nearest = np.abs(np.arange(len(path))[:, None] - moving).argmin(axis=1)
    return directions[moving[nearest]]


def _with_headings(path: Path3, headings_deg: Float64[np.ndarray, " n"]) -> Path3:
    pairs = zip(path, headings_deg.tolist(), strict=True)
    return tuple(replace(waypoint, yaw_deg=yaw_deg) for waypoint, yaw_deg in pairs)


def _with_direction(path: Path3, headings_deg: Float64[np.ndarray, " n"]) -> Path3:
    """Return a path with the given headings if neither it nor its motion determines any."""
    extent = np.ptp(np.array([[w.x_m, w.y_m] for w in path]), axis=0).max()
    is_given = path[0].yaw_deg is not None
    return path if is_given or extent > _SAME_M else _with_headings(path, headings_deg)
