"""A wall that LiDAR and camera look at, and a small neural field to learn it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from lightsim.core.fields import BLOCK, GroundMap, SceneFields, TsdfGrid
from lightsim.reconstruct.field import config as neural_config
from lightsim.reconstruct.field.hash_grid.spec import HashGridSpec
from lightsim.reconstruct.field.ray_pool import RayPool
from lightsim.reconstruct.field.sdf_field import SceneField
from lightsim.reconstruct.field.tsdf_prior import TsdfPrior

WALL_M = 5.0


def wall_grid(voxel_m: float, offset_m: float, weight: float = 4.0) -> TsdfGrid:
    """A wall at x = WALL_M + offset that faces -x, known in a slab around it."""
    coords = np.argwhere(np.ones((8, 8, 4), dtype=bool)).astype(np.int32)
    steps = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), axis=-1)
    origin = np.array([1.0, -3.2, -1.6])
    x = origin[0] + voxel_m * (BLOCK * coords[:, None, None, None] + steps)[..., 0]
    sdf = np.clip(WALL_M + offset_m - x, -3 * voxel_m, 3 * voxel_m).astype(np.float32)
    weights = np.where(sdf > -3 * voxel_m, weight, 0.0).astype(np.float32)
    return TsdfGrid("world", origin, voxel_m, 3 * voxel_m, coords, sdf, weights)


def wall_fields(offset_m: float, weight: float = 4.0) -> SceneFields:
    flat = np.full((4, 4), -1.6, dtype=np.float32)
    ground = GroundMap(np.zeros(2), 1.0, flat, np.ones((4, 4), dtype=bool))
    return SceneFields(
        (wall_grid(0.1, offset_m, weight),), (50.0,), {}, ground, np.zeros((2, 3)), ("fused",)
    )


def wall_pool(count: int, is_lidar: bool, room_m: float | None = None) -> RayPool:
    """Rays from the origin at the wall, which is red on one side and green on the other.

    Args:
        room_m: nothing tells where the wall is but that this much space around it is occupied.
    """
    rng = np.random.default_rng(3)
    target = np.stack(
        [np.full(count, WALL_M), rng.uniform(-2.5, 2.5, count), rng.uniform(-1.2, 1.2, count)],
        axis=1,
    )
    distance = np.linalg.norm(target, axis=1)
    colour = np.where(target[:, 1:2] > 0, [[0.8, 0.2, 0.2]], [[0.2, 0.7, 0.2]])
    occupied = np.zeros((count, 0, 2), dtype=np.float32)
    if room_m is not None:
        along = (distance / WALL_M)[:, None, None] * np.array([WALL_M - room_m, WALL_M + room_m])
        occupied = along.astype(np.float32)
    f32, far = np.float32, np.full((count, 2, 2), np.inf, np.float32)
    return RayPool(
        np.zeros((count, 3), f32),
        (target / distance[:, None]).astype(f32),
        np.full((count, 2), -1, np.int32),
        far,
        np.zeros((count, 2, 3), f32),
        np.zeros((count, 2, 3), f32),
        distance.astype(f32) if room_m is None else np.full(count, np.inf, f32),
        occupied,
        colour.astype(f32) * (0.0 if is_lidar else 1.0),
        np.full(count, -1 if is_lidar else 0, np.int32),
        np.zeros(count, f32),
        distance.astype(f32) if is_lidar else np.full(count, np.inf, f32),
        np.full(count, 0 if is_lidar else -1, np.int32),
    )


def small_config(**changes: object) -> neural_config.NeuralConfig:
    small = HashGridSpec(levels=6, log2_entries=14, coarsest_m=2.0, finest_m=0.1)
    base = replace(
        neural_config.standard(),
        background_grid=small,
        actor_grid=small,
        camera_batch=256,
        lidar_batch=256,
    )
    return replace(base, **changes)  # pyright: ignore[reportArgumentType]


def small_field(config: neural_config.NeuralConfig, fields: SceneFields | None) -> SceneField:
    prior = TsdfPrior.of(fields) if fields is not None else None
    return SceneField(config, (), ("front",), prior, torch.Generator().manual_seed(1))
