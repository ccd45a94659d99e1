"""LiDAR returns from static surfaces."""

from __future__ import annotations

import numpy as np

from lightsim.core.lidar_returns import LidarReturns, is_on_actors, is_static
from lightsim.core.log import DrivingLog


def static_returns(log: DrivingLog, count: int, rng: np.random.Generator) -> LidarReturns:
    """Draw at most about `count` LiDAR returns, without those on moving actors, in frame
    `world`."""
    # Each return is drawn with one probability, so that sweeps need not be in memory at once.
    # Returns of moving actors are drawn first and then dropped: the result may be smaller than
    # `count`.
    fraction = count / max(1, sum(len(s.load().intensity) for s in log.sweeps))
    resting = [actor for actor in log.actors if not actor.is_moving]
    points, origins, is_on_actor = [], [], []
    for lazy in log.sweeps:
        sweep = lazy.load()
        keep = rng.random(len(sweep.intensity)) < fraction
        keep &= is_static(sweep, log.actors)
        points.append(sweep.points_world[keep])
        origins.append(sweep.origins_world[keep])
        is_on_actor.append(is_on_actors(sweep, resting)[keep])
    empty = np.zeros((0, 3), np.float32)
    return LidarReturns(
        np.concatenate([empty, *points]),
        np.concatenate([empty, *origins]),
        np.concatenate([np.zeros(0, dtype=bool), *is_on_actor]),
    )
