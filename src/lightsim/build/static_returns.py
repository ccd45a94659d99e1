"""LiDAR returns from static surfaces."""

from __future__ import annotations

import numpy as np

from lightsim.core.lidar_returns import LidarReturns
from lightsim.core.log import DrivingLog


def static_returns(log: DrivingLog, count: int, rng: np.random.Generator) -> LidarReturns:
    """Draw about `count` LiDAR returns from static surfaces, in frame `world`."""
    fraction = count / max(1, sum(len(s.load().intensity) for s in log.sweeps))
    points, origins, intensity = [], [], []
    for lazy in log.sweeps:
        sweep = lazy.load()
        keep = rng.random(len(sweep.intensity)) < fraction
        for actor in log.actors_at(sweep.time_ns):
            if actor.is_moving:
                keep &= ~actor.contains(sweep.points_world.astype(np.float64), sweep.time_ns, 0.3)
        points.append(sweep.points_world[keep])
        origins.append(sweep.origins_world[keep])
        intensity.append(sweep.intensity[keep])
    empty = np.zeros((0, 3), np.float32)
    return LidarReturns(
        np.concatenate([empty, *points]),
        np.concatenate([empty, *origins]),
        np.concatenate([empty[:, 0], *intensity]),
    )
