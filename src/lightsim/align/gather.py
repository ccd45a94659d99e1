"""One pass over the sweeps that collects the input of every correction."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from lightsim.align.edges import depth_edges
from lightsim.align.planes import Cloud, first_of_voxels
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import LidarSweep
from lightsim.progress import Progress

# Edge of the voxels to which each sweep is thinned: less than `AlignConfig.plane_voxel_m`, by which
# all sweeps together are thinned.
_VOXEL_M = 0.15
# Largest distance of static returns; farther ones are too sparse for local planes.
_RANGE_M = 80.0


@dataclass(frozen=True, eq=False)
class Gathered:
    """Returns and depth edges of all sweeps, frame `world`.

    Args:
        static: thinned returns outside every box.
        moving: returns inside the boxes of moving actors, by actor id.
        edges_by_stem: depth edges of the requested sweeps.
    """

    static: Cloud
    moving: Mapping[str, Cloud]
    edges_by_stem: Mapping[str, Float64[np.ndarray, "_ 3"]]


def gather(
    log: DrivingLog,
    edge_stems: Collection[str],
    *,
    rng: np.random.Generator,
    progress: Progress,
) -> Gathered:
    """Read every sweep once; depth edges only for the sweeps with a stem in `edge_stems`."""
    static: list[Cloud] = []
    moving: dict[str, list[Cloud]] = {}
    edges: dict[str, Float64[np.ndarray, "_ 3"]] = {}
    for index, lazy in enumerate(progress.track(log.sweeps, "reading sweeps", len(log.sweeps))):
        sweep = lazy.load()
        if sweep.stem in edge_stems:
            edges[sweep.stem] = depth_edges(sweep, log.actors, rng)
        cloud = _cloud(sweep, index)
        is_static = np.linalg.norm(cloud.points_world - sweep.origins_world, axis=1) < _RANGE_M
        for actor in log.actors:
            inside, _ = actor.returns_inside(cloud.points_world, cloud.times_ns)
            is_static[inside] = False
            if actor.is_moving and len(inside):
                moving.setdefault(actor.actor_id, []).append(cloud.rows(inside))
        remaining = cloud.rows(is_static)
        static.append(remaining.rows(first_of_voxels(remaining.points_world, _VOXEL_M)))
    joined = {actor_id: _joined(clouds) for actor_id, clouds in moving.items()}
    return Gathered(_joined(static), joined, edges)


def _joined(clouds: list[Cloud]) -> Cloud:
    return Cloud(
        np.concatenate([c.points_world for c in clouds]),
        np.concatenate([c.times_ns for c in clouds]),
        np.concatenate([c.sweep for c in clouds]),
    )


def _cloud(sweep: LidarSweep, index: int) -> Cloud:
    number = np.full(len(sweep.points_world), index, dtype=np.int64)
    return Cloud(sweep.points_world.astype(np.float64), sweep.times_ns, number)
