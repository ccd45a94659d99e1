"""Checks of axes: a wrong order of quaternions, an inverted pose or axes of another convention give
valid transforms, which only the motion and the attitude of vehicle, cameras and boxes contradict.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Bool, Float64

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.errors import InputError

# Least cosine of the angle between the vehicle's or a box's z axis and world z: 45 degrees.
_UPRIGHT = 0.7
# Time between two positions that give a direction of motion, in nanoseconds.
_STEP_NS = 200_000_000
# Speed from which a vehicle moves along its x axis, in m/s: vehicles reverse more slowly.
_FAST_M_S = 5.0
# Largest fraction of the fast steps that may lead elsewhere. A log that is played to and fro has a
# half.
_MOST_ELSEWHERE = 0.6
# Largest elevation of an optical axis, as its sine: no camera on a vehicle looks at the zenith.
_STEEP = 0.7
# Least cosine of the angle between the down axis of a camera and the vehicle's: 60 degrees.
_LEVEL = 0.5
# Speed from which the direction of an actor's motion is compared with its box, in m/s.
_MOVING_M_S = 2.0
# Fraction of the actors from which a note is written: labels of single actors are wrong anyhow.
_MANY = 0.25
# Kinds that are longer than wide and move along their length.
_LONG = (
    ActorKind.CAR, ActorKind.PICKUP, ActorKind.TRUCK, ActorKind.BUS, ActorKind.MOTORCYCLE,
    ActorKind.BICYCLE,
)  # fmt: skip
_EXPECTED = "x forward, y left, z up, as world_from_ego; quaternions in the order w, x, y, z"


def check_ego_axes(where: object, ego: Trajectory) -> None:
    """Check that the ego's z axis points up and that it moves along its x axis.

    Raises:
        InputError: it does not.
    """
    cosine = float(np.median(ego.matrices[:, 2, 2]))
    if cosine < _UPRIGHT:
        raise InputError(
            "the vehicle is not upright",
            where=where,
            got=f"its z axis at a cosine of {cosine:.2f} to world z",
            expected=_EXPECTED,
        )
    times_ns = np.arange(ego.start_ns, ego.end_ns, _STEP_NS)
    if len(times_ns) < 2:
        return
    steps_m = np.diff(ego.held_positions_m(times_ns), axis=0)
    rotations = ego.held_at(times_ns[:-1])[:, :3, :3]
    along_m = np.einsum("nij,ni->nj", rotations, steps_m)
    lengths_m = np.linalg.norm(along_m, axis=1)
    is_fast = lengths_m > _FAST_M_S * _STEP_NS * 1e-9
    cosines = along_m[is_fast] / lengths_m[is_fast, None]
    if len(cosines) and (cosines[:, 0] < _UPRIGHT).mean() > _MOST_ELSEWHERE:
        x, y, z = np.median(cosines, axis=0)
        raise InputError(
            "the vehicle does not move along its x axis",
            where=where,
            got=f"a motion along {x:.2f}, {y:.2f}, {z:.2f} in frame ego",
            expected=_EXPECTED,
        )


def camera_axis_notes(ego_from_camera: Mapping[str, RigidTransform]) -> tuple[str, ...]:
    """Return a note on cameras that look upwards or are rolled."""
    odd: list[str] = []
    for name, pose in ego_from_camera.items():
        down, forward = pose.rotation[:, 1], pose.rotation[:, 2]
        # Cameras that look down have any roll.
        is_rolled = abs(forward[2]) < _STEEP and -down[2] < _LEVEL
        if forward[2] > _STEEP or is_rolled:
            odd.append(name)
    if not odd:
        return ()
    return (f"{', '.join(odd)}: the camera looks upwards or is rolled by more than 60 degrees;"
            " its pose may be inverted or have other axes than x right, y down, z forward",
            )  # fmt: skip


def box_axis_notes(tracks: Iterable[ActorTrack]) -> tuple[str, ...]:
    """Return notes on boxes that are tilted, wider than long, or move sideways."""
    tracks = list(tracks)
    long = [track for track in tracks if track.kind in _LONG]
    sideways = [found for track in long if (found := _moves_sideways(track)) is not None]
    cases = (
        ([float(np.median(t.trajectory.matrices[:, 2, 2])) < _UPRIGHT for t in tracks],
         "actors are tilted", "the order of quaternions is w, x, y, z"),
        ([bool(t.size_lwh_m[1] > t.size_lwh_m[0]) for t in long],
         "vehicles are wider than long", "length and width may be swapped"),
        (sideways, "moving vehicles move sideways",
         "headings may be in degrees, of another axis or of another frame"),
    )  # fmt: skip
    return tuple(
        f"{sum(flags)} of {len(flags)} {what}: {why}"
        for flags, what, why in cases
        if sum(flags) > _MANY * len(flags)
    )


def _moves_sideways(track: ActorTrack) -> bool | None:
    """Return whether an actor moves across its length; None if it hardly moves."""
    positions = track.trajectory.positions_m
    steps_m = np.diff(positions, axis=0)
    lengths_m = np.linalg.norm(steps_m, axis=1)
    seconds = np.diff(track.trajectory.times_ns) * 1e-9
    is_fast: Bool[np.ndarray, " n"] = lengths_m > _MOVING_M_S * seconds
    # Jitter of labels is fast, too, but leads nowhere.
    reach_m = float(np.linalg.norm(positions[-1] - positions[0]))
    if not is_fast.any() or reach_m < _MOVING_M_S:
        return None
    forward: Float64[np.ndarray, "n 3"] = track.trajectory.matrices[:-1, :3, 0]
    cosines = (forward * steps_m).sum(axis=1)[is_fast] / lengths_m[is_fast]
    return bool(np.median(np.abs(cosines)) < _UPRIGHT)
