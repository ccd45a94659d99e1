"""LiDAR returns in frame `world`, each with the sensor's position at its own time."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.core.frames import Trajectory
from lightsim.core.sensors import LidarSweep
from lightsim.datasets.first_sweeps import check_returns
from lightsim.datasets.plausible import LIMITS
from lightsim.datasets.recorded import PointFrame, RawSweep, RecordedSweep
from lightsim.datasets.ticks import assigned
from lightsim.errors import InputError

_LOGGER = logging.getLogger(__name__)
# Largest difference between the times of a return and its sweep, in seconds: five sweeps.
_MAX_TIME_OFFSET_S = 0.5
# Poses are interpolated once for each of these steps, in nanoseconds: a vehicle at 40 m/s moves
# 4 mm in one.
_POSE_STEP_NS = 100_000


@dataclass(frozen=True)
class MergedSweep:
    """One sweep of the reference LiDAR, and those of other LiDARs nearest to it in time."""

    time_ns: int
    parts: tuple[RecordedSweep, ...]


def merged_sweeps(
    sweeps_by_lidar: Mapping[str, Sequence[RecordedSweep]],
) -> tuple[tuple[MergedSweep, ...], tuple[str, ...]]:
    """Return the sweeps of all LiDARs, merged by time, and notes on sweeps without a partner.

    The LiDAR with the most sweeps is the reference; every sweep of another LiDAR joins the nearest
    sweep of the reference.
    """
    by_lidar = {name: sweeps for name, sweeps in sweeps_by_lidar.items() if sweeps}
    if not by_lidar:
        return (), ()
    reference = max(by_lidar, key=lambda name: len(by_lidar[name]))
    ticks_ns = _times_ns(by_lidar[reference])
    parts = [[sweep] for sweep in by_lidar[reference]]
    notes: list[str] = []
    for name, sweeps in by_lidar.items():
        if name == reference:
            continue
        item_by_tick = assigned(ticks_ns, _times_ns(sweeps))
        for tick, item in item_by_tick.items():
            parts[tick].append(sweeps[item])
        left = len(sweeps) - len(item_by_tick)
        if left:
            notes.append(f"{name}: {left} of {len(sweeps)} sweeps have no sweep of {reference}"
                         " beside them and are not used")  # fmt: skip
    return tuple(MergedSweep(group[0].time_ns, tuple(group)) for group in parts), tuple(notes)


def load_sweep(
    sweep: MergedSweep, stem: str, ego: Trajectory, origin_m: Float64[np.ndarray, "3"]
) -> LidarSweep:
    """Load the returns of all LiDARs. Rows with non-finite values, or at zero range, are dropped
    and logged.

    Args:
        ego: `world_from_ego`.
        origin_m: origin of frame `world` in the recording's world.

    Raises:
        InputError: a file is damaged or empty, or its times or points are implausible.
    """
    parts = [_placed(part, sweep.time_ns, ego, origin_m) for part in sweep.parts]
    joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
    points, origins, intensity, offset_s, ring, classes = joined
    return LidarSweep(
        stem,
        sweep.time_ns,
        points.astype(np.float32),
        origins.astype(np.float32),
        np.clip(intensity, 0.0, 1.0).astype(np.float32),
        offset_s.astype(np.float32),
        ring.astype(np.int16),
        classes.astype(np.int16),
    )


def _placed(
    part: RecordedSweep, time_ns: int, ego: Trajectory, origin_m: Float64[np.ndarray, "3"]
) -> tuple[np.ndarray, ...]:
    """Return points and origins in frame `world`, and the other columns, of one LiDAR."""
    raw = _valid_rows(part.load(), part, origin_m)
    n = len(raw.points)
    own_s = np.zeros(n) if raw.time_offset_s is None else raw.time_offset_s.astype(np.float64)
    worst_s = float(np.abs(own_s).max(initial=0.0))
    if worst_s > _MAX_TIME_OFFSET_S:
        raise InputError(
            "the points' times are not those of the sweep",
            where=part.path,
            got=f"up to {worst_s:.3g} s from its time stamp",
            expected=f"at most {_MAX_TIME_OFFSET_S} s",
        )
    times_ns = part.time_ns + np.round(own_s * 1e9).astype(np.int64)
    poses, row = _poses_at(ego, times_ns)
    if raw.origins_world is None:
        origins_ego = np.broadcast_to(raw.origins_ego, (n, 3)).astype(np.float64)
        origins = _moved(poses, row, origins_ego)
    else:
        origins = raw.origins_world.astype(np.float64) - origin_m
    points = raw.points.astype(np.float64)
    if raw.frame is PointFrame.WORLD:
        points = points - origin_m
    elif raw.frame is PointFrame.SWEEP_TIME:
        points = ego.held(part.time_ns).apply(points)
    else:
        points = _moved(poses, row, points)
    range_m = float(np.median(np.linalg.norm(points - origins, axis=1)))
    LIMITS["range"].check(part.path, range_m, f"half of them more than {range_m:.4g} m away")
    return (
        points,
        origins,
        raw.intensity,
        own_s + (part.time_ns - time_ns) * 1e-9,
        np.full(n, -1) if raw.ring is None else raw.ring,
        np.full(n, -1) if raw.semantic_class is None else raw.semantic_class,
    )


def _valid_rows(raw: RawSweep, part: RecordedSweep, origin_m: Float64[np.ndarray, "3"]) -> RawSweep:
    """Return the rows with finite values and a range above zero."""
    check_returns(raw.intensity, part.path)
    most_m = LIMITS["coordinate"].most
    is_good = np.isfinite(raw.points).all(axis=1) & np.isfinite(raw.intensity)
    if raw.time_offset_s is not None:
        is_good &= np.isfinite(raw.time_offset_s)
    if raw.origins_world is not None:
        # NaN fails the comparison.
        is_good &= (np.abs(raw.origins_world - origin_m) < most_m).all(axis=1)
    if raw.frame is PointFrame.WORLD:
        is_good &= (np.abs(raw.points - origin_m) < most_m).all(axis=1)
    else:
        # Missing returns are stored at the sensor's own position in some data sets.
        is_good &= (np.abs(raw.points - raw.origins_ego) > 1e-3).any(axis=1)
        is_good &= (np.abs(raw.points) < most_m).all(axis=1)
    if not is_good.any():
        raise InputError(
            "the sweep has no valid point",
            where=part.path,
            got=f"{len(is_good)} rows",
            remedy="Remove the file: sweeps may be missing.",
        )
    if is_good.all():
        return raw
    _LOGGER.warning(
        "%s: dropped %d of %d points that are not finite, at zero range or out of range",
        part.path, int(len(is_good) - is_good.sum()), len(is_good),
    )  # fmt: skip
    origins = raw.origins_ego if raw.origins_ego.ndim == 1 else raw.origins_ego[is_good]
    return RawSweep(
        raw.points[is_good],
        raw.frame,
        origins,
        raw.intensity[is_good],
        *(
            None if column is None else column[is_good]
            for column in (raw.time_offset_s, raw.ring, raw.semantic_class, raw.origins_world)
        ),
        full_scale=raw.full_scale,
    )


def without_missing(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Return stored points with NaN in place of 0, 0, 0, as which exporters write missing
    returns."""
    return np.where((points == 0.0).all(axis=1, keepdims=True), np.nan, points)


def _poses_at(
    ego: Trajectory, times_ns: Int64[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, "k 4 4"], Int64[np.ndarray, " n"]]:
    """Return the ego poses at few times, and for each time the index of its pose."""
    steps, row = np.unique(times_ns // _POSE_STEP_NS, return_inverse=True)
    return ego.held_at(steps * _POSE_STEP_NS + _POSE_STEP_NS // 2), row


def _moved(
    poses: Float64[np.ndarray, "k 4 4"],
    row: Int64[np.ndarray, " n"],
    points: Float64[np.ndarray, "n 3"],
) -> Float64[np.ndarray, "n 3"]:
    return np.einsum("nij,nj->ni", poses[row, :3, :3], points) + poses[row, :3, 3]


def _times_ns(sweeps: Sequence[RecordedSweep]) -> Int64[np.ndarray, " n"]:
    return np.array([sweep.time_ns for sweep in sweeps], dtype=np.int64)
