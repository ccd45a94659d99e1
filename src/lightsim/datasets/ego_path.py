"""Ego path of a recording: checks, and its extension beyond the first and last poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.core.frames import Trajectory, rotation_from_vector, vector_from_rotation
from lightsim.datasets.axes import check_ego_axes
from lightsim.datasets.plausible import LIMITS, check_poses

# Time by which the ego path is extended at both ends, in seconds, at constant velocity: sweeps end
# slightly after the last pose.
_EGO_HOLD_S = 0.2
# Least gap between poses that deserves a note, in seconds, and as a multiple of the median time
# between poses: over 1 s, an acceleration of 3 m/s^2 shifts the middle by 0.4 m.
_GAP_S, _GAP_FACTOR = 1.0, 5.0
# Movement from the start to the end of such a gap, in metres.
_GAP_M = 1.0
# Least time between poses whose speed is checked, in nanoseconds.
_CHECK_NS = 50_000_000


def check_path(path: Path, ego: Trajectory) -> tuple[str, ...]:
    """Check poses that are some 50 ms apart, and return notes: over the milliseconds between poses
    of single sensors, rounding and noise look like impossible speeds."""
    steps = (ego.times_ns - ego.start_ns) // _CHECK_NS
    _, first = np.unique(steps, return_index=True)
    thinned = replace(ego, times_ns=ego.times_ns[first], matrices=ego.matrices[first])
    notes = check_poses(path, thinned)
    check_ego_axes(path, ego)
    # Each pose in between, against the first one that is 50 ms later.
    later = np.searchsorted(ego.times_ns, ego.times_ns + _CHECK_NS)
    rows = np.flatnonzero(later < len(ego))
    if len(rows):
        steps_m = ego.positions_m[later[rows]] - ego.positions_m[rows]
        seconds = (ego.times_ns[later[rows]] - ego.times_ns[rows]) * 1e-9
        speeds = np.linalg.norm(steps_m, axis=1) / seconds
        i = int(np.argmax(speeds))
        where = f"{path}, between {ego.times_ns[rows[i]]} and {ego.times_ns[later[rows[i]]]} ns"
        LIMITS["speed"].check(where, float(speeds[i]), f"{speeds[i]:.4g} m/s")
    return notes


def gap_notes(ego: Trajectory, times_ns: Int64[np.ndarray, " n"]) -> tuple[str, ...]:
    """Return a note on gaps of the path, in which poses of pictures are interpolated.

    Args:
        times_ns: of the pictures.
    """
    if len(ego) < 3:
        return ()
    seconds = np.diff(ego.times_ns) * 1e-9
    moved_m = np.linalg.norm(np.diff(ego.positions_m, axis=0), axis=1)
    least_s = max(_GAP_S, _GAP_FACTOR * float(np.median(seconds)))
    is_gap = (seconds > least_s) & (moved_m > _GAP_M)
    before = np.searchsorted(ego.times_ns, times_ns) - 1
    inside = is_gap[np.clip(before, 0, len(is_gap) - 1)]
    if not inside.any():
        return ()
    return (
        f"the ego path has gaps of up to {seconds[is_gap].max():.1f} s and "
        f"{moved_m[is_gap].max():.0f} m: poses of {int(inside.sum())} pictures are interpolated",
    )


def extended(ego: Trajectory) -> Trajectory:
    """Return the path with one more pose at both ends, at the velocity of the outermost poses; a
    single pose is held."""
    hold_ns = round(_EGO_HOLD_S * 1e9)
    if len(ego) < 2:
        before = after = ego.matrices[0]
    else:
        before, after = (_extrapolated(ego, end, hold_ns) for end in (0, -1))
    return Trajectory(
        ego.dst,
        ego.src,
        np.concatenate([[ego.start_ns - hold_ns], ego.times_ns, [ego.end_ns + hold_ns]]),
        np.concatenate([before[None], ego.matrices, after[None]]),
    )


def _extrapolated(ego: Trajectory, end: int, hold_ns: int) -> Float64[np.ndarray, "4 4"]:
    """Return the pose `hold_ns` beyond an end (0 or -1), by the mean motion of 0.1 s there."""
    at_ns = ego.start_ns if end == 0 else ego.end_ns
    inner_ns = min(at_ns + 100_000_000, ego.end_ns) if end == 0 else max(at_ns - 100_000_000,
                                                                         ego.start_ns)  # fmt: skip
    edge, inner = ego.held(at_ns), ego.held(inner_ns)
    ratio = hold_ns / abs(at_ns - inner_ns)
    turn = rotation_from_vector(ratio * vector_from_rotation(edge.rotation @ inner.rotation.T))
    matrix = np.eye(4)
    matrix[:3, :3] = turn @ edge.rotation
    matrix[:3, 3] = edge.translation_m + ratio * (edge.translation_m - inner.translation_m)
    return matrix
