"""Grids at whose samples the paper's field is evaluated, without LiDAR fusion."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from jaxtyping import Bool, Float64, Int32
from scipy.spatial import KDTree

from lightsim.core.actors import ActorTrack
from lightsim.core.fields import BLOCK, SceneFields, TsdfGrid
from lightsim.core.log import DrivingLog
from lightsim.progress import Progress
from lightsim.reconstruct.field.occupancy import VOXEL_M, Occupancy
from lightsim.reconstruct.field.ray_pool import BOX_MARGIN_M
from lightsim.reconstruct.fusion.config import OccupiedConfig
from lightsim.reconstruct.fusion.sweep_views import centre_line
from lightsim.reconstruct.fusion.tsdf import TRUNCATION_VOXELS, find_ground

# Blocks tested together, to limit memory.
_BATCH_BLOCKS = 4096


def occupied_fields(log: DrivingLog, config: OccupiedConfig, *, progress: Progress) -> SceneFields:
    """Make grids of all levels with samples in occupied space, one grid per actor, and the ground.

    Samples have weight 1 and a free distance until the field is evaluated. Edits place actors on
    the ground map.

    Raises:
        InputError: the log has no return near the path.
    """
    path = centre_line(log.ego.positions_m)
    ground, _ = find_ground(log, path, config.radius_m[-1], progress)
    occupancy = Occupancy.of_returns(log, path, config.radius_m[-1], progress)
    corners = occupancy.origin_m + VOXEL_M * np.argwhere(occupancy.is_occupied)
    distance_m, _ = KDTree(path[:, :2]).query(corners[:, :2] + VOXEL_M / 2)
    levels, inner = [], 0.0
    for voxel_m, outer in zip(config.voxel_m, config.radius_m, strict=True):
        # One more voxel on either side, so that the meshes of neighbouring levels meet.
        is_own = (distance_m > inner - 2 * VOXEL_M) & (distance_m < outer + VOXEL_M)
        levels.append(_level(occupancy, corners[is_own], voxel_m))
        inner = outer
    actors = {track.actor_id: _box(track, config.actor_voxel_m) for track in log.actors}
    note = "no LiDAR fusion: the field is evaluated near returns and in the boxes of actors"
    return SceneFields(tuple(levels), config.radius_m, actors, ground, path, (note,))


def _level(occupancy: Occupancy, corners: Float64[np.ndarray, "v 3"], voxel_m: float) -> TsdfGrid:
    """Grid over the occupied voxels of the given lowest corners."""
    block_m = voxel_m * BLOCK
    first, last = (
        np.floor((corners + offset - occupancy.origin_m) / block_m).astype(np.int32)
        for offset in (0.0, VOXEL_M)
    )
    ends = [
        np.where(np.array(upper, dtype=bool), last, first) for upper in product((0, 1), repeat=3)
    ]
    coords = np.unique(np.concatenate(ends), axis=0)

    def holds() -> Iterator[Bool[np.ndarray, "b 8 8 8"]]:
        steps = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), axis=-1)
        for start in range(0, len(coords), _BATCH_BLOCKS):
            part = BLOCK * coords[start : start + _BATCH_BLOCKS].astype(np.float64)
            yield occupancy.holds(
                occupancy.origin_m + voxel_m * (part[:, None, None, None] + steps)
            )

    weight = np.concatenate([np.zeros((0, BLOCK, BLOCK, BLOCK), dtype=bool), *holds()])
    return _unevaluated("world", occupancy.origin_m, voxel_m, coords, weight)


def _box(track: ActorTrack, voxel_m: float) -> TsdfGrid:
    """Grid over an actor's box, in its frame."""
    half = track.size_lwh_m / 2 + BOX_MARGIN_M
    shape = np.ceil(2 * half / (voxel_m * BLOCK)).astype(np.int64)
    coords = np.argwhere(np.ones(tuple(shape.tolist()), dtype=bool)).astype(np.int32)
    origin = -voxel_m * (BLOCK * shape - 1) / 2
    steps = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), axis=-1)
    points = origin + voxel_m * (BLOCK * coords[:, None, None, None].astype(np.float64) + steps)
    is_inside = np.asarray((np.abs(points) <= half).all(axis=-1))
    return _unevaluated("actor", origin, voxel_m, coords, is_inside)


def _unevaluated(
    frame: str,
    origin_m: Float64[np.ndarray, "3"],
    voxel_m: float,
    coords: Int32[np.ndarray, "b 3"],
    is_open: Bool[np.ndarray, "b 8 8 8"],
) -> TsdfGrid:
    truncation_m = TRUNCATION_VOXELS * voxel_m
    free = np.full(is_open.shape, truncation_m, dtype=np.float32)
    return TsdfGrid(
        frame, origin_m, voxel_m, truncation_m, coords, free, is_open.astype(np.float32)
    )
