"""LiDAR returns of each actor, gathered over the log in frame `actor`."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from jaxtyping import Float32

from lightsim.core.log import DrivingLog

# Maximum number of sweeps read, evenly distributed over the log; limits the time.
_MAX_SWEEPS = 40
# Maximum number of returns of one actor, drawn at random; limits the time of the fit.
_MAX_RETURNS = 4000


def returns_of_actors(log: DrivingLog) -> dict[str, Float32[np.ndarray, "_ 3"]]:
    """Return the returns of vehicles by actor id, frame `actor`; absent for actors without any."""
    found: dict[str, list[Float32[np.ndarray, "_ 3"]]] = defaultdict(list)
    for lazy in log.sweeps[:: max(1, len(log.sweeps) // _MAX_SWEEPS)]:
        sweep = lazy.load()
        times_ns = sweep.times_ns
        for track in log.actors:
            if track.kind.is_vehicle:
                _, points = track.returns_inside(sweep.points_world, times_ns)
                points = points[track.is_above_ground(points)].astype(np.float32)
                if len(points):
                    found[track.actor_id].append(points)
    rng = np.random.default_rng(0)
    gathered = {actor_id: np.concatenate(parts) for actor_id, parts in found.items()}
    return {
        actor_id: points[np.sort(rng.choice(len(points), _MAX_RETURNS, replace=False))]
        if len(points) > _MAX_RETURNS
        else points
        for actor_id, points in gathered.items()
    }
