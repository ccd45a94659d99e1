"""LiDAR returns from static surfaces."""

from __future__ import annotations

import numpy as np

from lightsim.core.lidar_returns import LidarReturns
from lightsim.core.log import DrivingLog


def static_returns(log: DrivingLog, count: int, rng: np.random.Generator) -> LidarReturns:
    """Draw at most about `count` LiDAR returns, without those in the boxes of moving actors, in
    frame `world`."""
    # Each return is drawn with one probability, so that sweeps need not be in memory at once.
    # Returns of moving actors are drawn first and then dropped: the result may be smaller than
    # `count`.
    fraction = count / max(1, sum(len(s.load().intensity) for s in log.sweeps))
    points, origins = [], []
    for lazy in log.sweeps:
        sweep = lazy.load()
        keep = rng.random(len(sweep.intensity)) < fraction
        for actor in log.actors_at(sweep.time_ns):
            # The margin of 0.3 m covers errors of the boxes. Chosen; sensitivity not measured.
            if actor.is_moving:
                keep &= ~actor.contains(sweep.points_world.astype(np.float64), sweep.time_ns, 0.3)
        points.append(sweep.points_world[keep])
        origins.append(sweep.origins_world[keep])
    empty = np.zeros((0, 3), np.float32)
    return LidarReturns(np.concatenate([empty, *points]), np.concatenate([empty, *origins]))
