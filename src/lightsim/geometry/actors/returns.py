"""LiDAR returns of each actor, gathered over the log in frame `actor`."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from jaxtyping import Float32

from lightsim.core.actors import ActorTrack
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import SWEEP_HOLD_S, LidarSweep

# Margin around labelled boxes, which fit loosely. Sensitivity not measured.
_MARGIN_M = 0.1
# Height above the box's underside below which returns may be of the ground.
_FLOOR_M = 0.12
# Most sweeps that are read, evenly distributed over the log; bounds the time.
_MOST_SWEEPS = 40
# Most returns of one actor, drawn at random; bounds the time of the fit.
_MOST_RETURNS = 4000


def returns_of_actors(log: DrivingLog) -> dict[str, Float32[np.ndarray, "_ 3"]]:
    """Return the returns of vehicles by actor id, frame `actor`; absent for actors without any."""
    found: dict[str, list[Float32[np.ndarray, "_ 3"]]] = defaultdict(list)
    for lazy in log.sweeps[:: max(1, len(log.sweeps) // _MOST_SWEEPS)]:
        sweep = lazy.load()
        for track in log.actors:
            if track.kind.is_vehicle and track.is_present(sweep.time_ns, SWEEP_HOLD_S):
                points = _within(track, sweep)
                if len(points):
                    found[track.actor_id].append(points)
    rng = np.random.default_rng(0)
    gathered = {actor_id: np.concatenate(parts) for actor_id, parts in found.items()}
    return {
        actor_id: points[np.sort(rng.choice(len(points), _MOST_RETURNS, replace=False))]
        if len(points) > _MOST_RETURNS
        else points
        for actor_id, points in gathered.items()
    }


def _within(track: ActorTrack, sweep: LidarSweep) -> Float32[np.ndarray, "_ 3"]:
    """Return a sweep's returns inside an actor's box, posed at the time of each return."""
    _, points = track.returns_beside(sweep)
    half = track.size_lwh_m / 2
    is_inside = (np.abs(points) <= half + _MARGIN_M).all(axis=1)
    is_inside &= points[:, 2] > _FLOOR_M - half[2]
    return points[is_inside].astype(np.float32)
