"""Conversion of a synthetic street to a camera-only log with a simulated photogrammetric point
cloud."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from lightsim.core.lidar_returns import is_on_actors
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.datasets.reader import read_log
from lightsim.export.lightsim.log import write_lightsim_log
from lightsim.progress import Progress
from lightsim_lab.synthetic.street import Street

# Standard deviation of the points along each axis, relative to their distance: dense stereo of
# neighbouring frames has errors of some pixels of disparity.
_RELATIVE_ERROR = 0.004
# Fraction of the LiDAR's returns that become points: photogrammetry fails on untextured surfaces.
_POINT_FRACTION = 0.6


def record_as_cameras(street: Street, log: Path, out: Path, progress: Progress) -> None:
    """Write OUT as a lightsim-log/1 without LiDAR and boxes, with points.ply.

    The points are static returns of the street's LiDAR, with the errors of
    photogrammetry: they are thinned and moved by 0.4 % of their distance.

    Args:
        log: folder of the street's log in PandaSet's layout.
    """
    if (out / "points.ply").exists():
        return
    recorded = read_log(LogReading(source=str(log)))
    rng = np.random.default_rng([street.plan.seed, 23])
    points = _points(recorded, rng)
    write_lightsim_log(_cameras_only(recorded), out, progress)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    )
    (out / "points.ply").write_bytes(header.encode() + points.astype("<f4").tobytes())
    described = json.loads((out / "log.json").read_text())
    described["lidars"] = {}
    (out / "log.json").write_text(json.dumps(described, indent=1))


def _cameras_only(log: DrivingLog) -> DrivingLog:
    return replace(log, sweeps=(), actors=(), semantic_names={})


def _points(log: DrivingLog, rng: np.random.Generator) -> np.ndarray:
    parts: list[np.ndarray] = []
    for lazy in log.sweeps:
        sweep = lazy.load()
        is_static = rng.random(len(sweep.points_world)) < _POINT_FRACTION
        is_static &= ~is_on_actors(sweep, log.actors)
        points = sweep.points_world[is_static].astype(np.float64)
        error = _RELATIVE_ERROR * sweep.distances_m[is_static][:, None]
        parts.append(points + error * rng.standard_normal(points.shape))
    return np.concatenate(parts)
