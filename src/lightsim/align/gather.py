"""One pass over the sweeps that collects the input of every correction."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.align.edges import depth_edges, is_in_box
from lightsim.align.planes import Cloud, first_of_voxels
from lightsim.core.actors import ActorTrack
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import SWEEP_HOLD_S, LidarSweep
from lightsim.progress import Progress

# Edge of the voxels to which each sweep is thinned: less than `AlignConfig.plane_voxel_m`, by which
# all sweeps together are thinned.
_VOXEL_M = 0.15
# Largest distance of static returns; farther ones are too sparse for local planes.
_RANGE_M = 80.0
# Margin around labelled boxes, which fit loosely. Sensitivity not measured.
_MARGIN_M = 0.25


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
            inside = rows_near_box(cloud, actor, sweep.time_ns)
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
    times_ns = sweep.time_ns + (sweep.time_offset_s.astype(np.float64) * 1e9).astype(np.int64)
    number = np.full(len(times_ns), index, dtype=np.int64)
    return Cloud(sweep.points_world.astype(np.float64), times_ns, number)


def rows_near_box(cloud: Cloud, actor: ActorTrack, time_ns: int) -> Int64[np.ndarray, " n"]:
    """Return the rows of one sweep inside the grown box of an actor when it was scanned."""
    if not actor.is_present(time_ns, SWEEP_HOLD_S):
        return np.empty(0, dtype=np.int64)
    centre = actor.world_from_actor(time_ns, SWEEP_HOLD_S).translation_m
    # Within a sweep an actor moves: 3 m in 0.1 s is 108 km/h.
    reach = float(np.linalg.norm(actor.size_lwh_m)) / 2 + 3.0
    near = np.flatnonzero((np.abs(cloud.points_world[:, :2] - centre[:2]) < reach).all(axis=1))
    if len(near) == 0:
        return near
    scanned_ns = int(np.median(cloud.times_ns[near]))
    if not actor.is_present(scanned_ns, SWEEP_HOLD_S):
        scanned_ns = time_ns
    return near[is_in_box(actor, cloud.points_world[near], scanned_ns, _MARGIN_M)]
