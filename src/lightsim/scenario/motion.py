"""Poses from waypoints: smooth paths, headings along them, wheels on the ground."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64

from lightsim.core.actors import ActorKind
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.errors import InputError
from lightsim.scenario.edits import Path3, Waypoint
from lightsim.scenario.ground import StandingGround

# Time between poses, in seconds: a car at 30 m/s turns by less than a degree.
_STEP_S = 0.05
# Distance of the axles from the centre of the box, as a fraction of its length.
_WHEELBASE = 0.3
# Distance of the wheels from the centre of the box, as a fraction of its width.
_TRACK = 0.4
# Times in files are rounded to the millisecond.
_ROUNDED_S = 1e-3
# Speed below which the path does not determine the heading, in m/s: waypoints jitter.
_STANDING_M_S = 0.05


def moved_along(
    waypoints: Path3,
    span_ns: tuple[int, int],
    body: tuple[ActorKind, Float[np.ndarray, "3"]],
    ground: StandingGround,
    where: str,
) -> Trajectory:
    """Return poses world_from_actor along waypoints; a single one is the pose for the whole log.

    Between waypoints positions are monotone cubic (Fritsch & Butland 1984,
    doi:10.1137/0905021): smooth, through every waypoint, without overshoot.

    Args:
        span_ns: first and last picture of the log; time_s counts from the first.
        body: kind and size_lwh_m of the box.
        where: the edit, for errors.

    Raises:
        InputError: a time lies outside the log.
    """
    times_ns, xy, yaw_rad, bottom_m = _sampled(waypoints, span_ns, where)
    if bottom_m is None:
        poses = standing_poses(xy, yaw_rad, body, ground)
    else:
        centre = np.column_stack([xy, bottom_m + body[1][2] / 2])
        level = np.repeat([[0.0, 0.0, 1.0]], len(xy), axis=0)
        poses = _oriented(centre, yaw_rad, level)
    return Trajectory("world", "actor", times_ns, poses)


def shifted(trajectory: Trajectory, offset_m: tuple[float, float, float]) -> Trajectory:
    """Return the trajectory with every pose shifted in its own axes: ahead, left, up."""
    step = RigidTransform.from_rotation(
        trajectory.src, trajectory.src, np.eye(3), np.array(offset_m)
    )
    return Trajectory(
        trajectory.dst, trajectory.src, trajectory.times_ns, trajectory.matrices @ step.matrix
    )


def set_on_ground(
    trajectory: Trajectory, body: tuple[ActorKind, Float[np.ndarray, "3"]], ground: StandingGround
) -> Trajectory:
    """Return the trajectory with the same path and headings on the ground."""
    forward = trajectory.matrices[:, :3, 0]
    yaw_rad = np.arctan2(forward[:, 1], forward[:, 0])
    poses = standing_poses(trajectory.positions_m[:, :2], yaw_rad, body, ground)
    return Trajectory(trajectory.dst, trajectory.src, trajectory.times_ns, poses)


def standing_poses(
    xy_world: Float[np.ndarray, "n 2"],
    yaw_rad: Float[np.ndarray, " n"],
    body: tuple[ActorKind, Float[np.ndarray, "3"]],
    ground: StandingGround,
) -> Float64[np.ndarray, "n 4 4"]:
    """Return world_from_actor of boxes on the ground. Pitch and roll follow the least-squares plane
    through the ground at the four wheels; persons are upright."""
    kind, size = body
    half = np.array([_WHEELBASE * size[0], _TRACK * size[1]])
    corners = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) * half
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
    wheels = xy_world[:, None] + corners @ np.swapaxes(turn, 1, 2)
    height = ground.height_m(wheels.reshape(-1, 2)).reshape(-1, 4)
    # The four wheels are symmetric about the centre, so that the least-squares slopes are signed
    # means of their heights.
    rise = height @ np.sign(corners) / (4 * half)
    uphill = np.einsum("nij,nj->ni", turn, rise)
    normal = np.column_stack([-uphill, np.ones(len(xy_world))])
    if kind.is_person:
        normal = np.repeat([[0.0, 0.0, 1.0]], len(xy_world), axis=0)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    contact = np.column_stack([xy_world, height.mean(axis=1)])
    return _oriented(contact + normal * size[2] / 2, yaw_rad, normal)


def _oriented(
    centre: Float[np.ndarray, "n 3"],
    yaw_rad: Float[np.ndarray, " n"],
    up: Float[np.ndarray, "n 3"],
) -> Float64[np.ndarray, "n 4 4"]:
    """Return poses with the given z axis, whose x axis projects onto the heading."""
    heading = np.column_stack([np.cos(yaw_rad), np.sin(yaw_rad)])
    rise = -np.einsum("nc,nc->n", heading, up[:, :2]) / up[:, 2]
    ahead = np.column_stack([heading, rise])
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(centre), 1, 1))
    poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2] = ahead, np.cross(up, ahead), up
    poses[:, :3, 3] = centre
    return poses


def _sampled(
    waypoints: Path3, span_ns: tuple[int, int], where: str
) -> tuple[
    np.ndarray,
    Float64[np.ndarray, "n 2"],
    Float64[np.ndarray, " n"],
    Float64[np.ndarray, " n"] | None,
]:
    """Return places, headings and undersides at a dense sequence of times."""
    from scipy.interpolate import PchipInterpolator

    start_ns, end_ns = span_ns
    if len(waypoints) == 1:
        times_ns = np.unique(np.array([start_ns, end_ns], dtype=np.int64))
        return times_ns, *_standing(waypoints[0], len(times_ns))
    keys_s = np.array([w.time_s for w in waypoints])
    last_s = (end_ns - start_ns) / 1e9
    if keys_s[0] < 0 or keys_s[-1] > last_s + _ROUNDED_S:
        raise InputError(
            "the trajectory leaves the log's time",
            where=where,
            got=f"{keys_s[0]:g} to {keys_s[-1]:g} s",
            expected=f"0 to {last_s:.3f} s, counted from the first picture",
            remedy="Cut it, or let it end where the log does.",
        )
    count = max(2, int(np.ceil((keys_s[-1] - keys_s[0]) / _STEP_S)) + 1)
    times_s = np.linspace(keys_s[0], keys_s[-1], count)
    times_ns = start_ns + np.rint(times_s * 1e9).astype(np.int64)
    path = PchipInterpolator(keys_s, np.array([[w.x_m, w.y_m] for w in waypoints]))
    xy = np.asarray(path(times_s))
    yaw_deg = [w.yaw_deg for w in waypoints if w.yaw_deg is not None]
    if yaw_deg:
        # Unwrapped: a turn from 179 to -179 degrees is one of 2 degrees.
        yaw_rad = np.interp(times_s, keys_s, np.unwrap(np.radians(yaw_deg)))
    else:
        yaw_rad = _along(np.asarray(path.derivative()(times_s)))
    z_m = [w.z_m for w in waypoints if w.z_m is not None]
    return times_ns, xy, yaw_rad, np.interp(times_s, keys_s, z_m) if z_m else None


def _standing(
    place: Waypoint, count: int
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"] | None]:
    xy = np.repeat([[place.x_m, place.y_m]], count, axis=0)
    yaw_rad = np.full(count, np.radians(place.yaw_deg or 0.0))
    return xy, yaw_rad, None if place.z_m is None else np.full(count, place.z_m)


def _along(velocity_m_s: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, " n"]:
    """Return headings of motion; while standing the last one, before the start the first one."""
    speed = np.linalg.norm(velocity_m_s, axis=1)
    moving = np.flatnonzero(speed > min(_STANDING_M_S, 0.5 * float(speed.max())))
    last = np.clip(np.searchsorted(moving, np.arange(len(speed)), side="right") - 1, 0, None)
    heading = velocity_m_s[moving[last]]
    return np.arctan2(heading[:, 1], heading[:, 0])
