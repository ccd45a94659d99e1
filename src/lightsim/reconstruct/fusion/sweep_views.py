"""Division of sweeps into views: returns from nearly one point, labelled by actor."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64

from lightsim.core.frames import Trajectory
from lightsim.core.lidar_returns import actor_labels
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import LidarSweep

# The values below were chosen on log 002 and synthetic street 0. Only their joint effect is
# measured (docs/benchmarks/reconstruction.md, test street 1).

# Radius of the returns' origins, relative to the ego vehicle, that belong to one sensor.
_SENSOR_TOLERANCE_M = 0.4
# Greatest motion of the sensor during one view, in metres.
_SLICE_MOTION_M = 0.3
# Overlap of views in time, as a fraction of the sweep: triangles close the gap between them.
_SLICE_OVERLAP = 0.02
# Least number of returns of a view.
_MIN_VIEW_POINTS = 50


@dataclass(frozen=True, eq=False)
class View:
    """Returns of one sensor during a short time.

    Args:
        time_ns: mean time.
        origin_world: mean position of the sensor, metres.
        points_world: returns, metres.
        labels: 0 static scene, i + 1 for the log's actor i.
    """

    time_ns: int
    origin_world: Float64[np.ndarray, "3"]
    points_world: Float64[np.ndarray, "n 3"]
    labels: Int64[np.ndarray, " n"]


def views_of_sweep(log: DrivingLog, sweep: LidarSweep) -> Iterator[View]:
    """Divide a sweep by sensor and by time, so that each view has nearly one centre."""
    labels = actor_labels(sweep, log.actors)
    sensor = sensor_index(log.ego, sweep)
    for index in range(int(sensor.max(initial=-1)) + 1):
        members = np.flatnonzero(sensor == index)
        for part in _time_slices(sweep, members):
            if len(part) >= _MIN_VIEW_POINTS:
                offset_ns = int(float(sweep.time_offset_s[part].mean()) * 1e9)
                yield View(
                    sweep.time_ns + offset_ns,
                    sweep.origins_world[part].mean(axis=0, dtype=np.float64),
                    sweep.points_world[part].astype(np.float64),
                    labels[part],
                )


def sensor_index(ego: Trajectory, sweep: LidarSweep) -> Int64[np.ndarray, " n"]:
    """Return the index of the sensor that measured each return.

    Sensors are distinguished by their position on the ego vehicle: a sweep may combine several (as
    in PandaSet), and each requires its own range image.
    """
    seconds = (ego.times_ns - sweep.time_ns) * 1e-9
    position = np.stack(
        [np.interp(sweep.time_offset_s, seconds, ego.positions_m[:, k]) for k in range(3)], axis=1
    )
    offset = sweep.origins_world - position
    sensor = np.full(len(offset), -1, dtype=np.int64)
    while (sensor < 0).any():
        seed = offset[np.argmax(sensor < 0)]
        is_near = np.linalg.norm(offset - seed, axis=1) < _SENSOR_TOLERANCE_M
        sensor[is_near & (sensor < 0)] = sensor.max() + 1
    return sensor


def _time_slices(
    sweep: LidarSweep, members: Int64[np.ndarray, " n"]
) -> Iterator[Int64[np.ndarray, " _m"]]:
    origins = sweep.origins_world[members]
    motion_m = float(np.linalg.norm(np.ptp(origins, axis=0)))
    count = max(1, int(np.ceil(motion_m / _SLICE_MOTION_M)))
    times = sweep.time_offset_s[members]
    start, end = float(times.min()), float(times.max())
    overlap = _SLICE_OVERLAP * (end - start)
    edges = np.linspace(start, end, count + 1)
    for low, high in itertools.pairwise(edges):
        yield members[(times >= low - overlap) & (times <= high + overlap)]


def centre_line(path_m: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "m 3"]:
    """Thin the path to about one point a metre."""
    sparse = [path_m[0]]
    for point in path_m[1:]:
        if np.linalg.norm(point - sparse[-1]) >= 1.0:
            sparse.append(point)
    return np.array(sparse, dtype=np.float64)
