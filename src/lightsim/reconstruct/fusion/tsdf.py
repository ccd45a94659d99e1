"""LiDAR fusion: sweeps into signed-distance grids of the static scene and of every actor.

Range-image fusion after Curless & Levoy 1996 (doi:10.1145/237170.237269), with point-to-plane
distances and interpolation between neighbouring beams of one surface. The paper trains a neural
field instead (Sec. 3.1); these grids are its initialisation, and usable geometry without it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int32

from lightsim.core.actors import ActorTrack
from lightsim.core.ahead import mapped_ahead
from lightsim.core.cores import worker_count
from lightsim.core.fields import BLOCK, GroundMap, SceneFields, TsdfGrid
from lightsim.core.lidar_returns import actor_labels
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import SWEEP_HOLD_S, LazySweep
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.reconstruct.fusion.config import FuseConfig
from lightsim.reconstruct.fusion.ground import GroundBuilder
from lightsim.reconstruct.fusion.range_image import RangeImage, make_range_image
from lightsim.reconstruct.fusion.sweep_views import centre_line, views_of_sweep
from lightsim.reconstruct.fusion.tsdf_kernels import integrate_view, mark_blocks

__all__ = ["FuseConfig", "fuse_log"]

# The values below were chosen on log 002 and synthetic street 0. Only their joint effect is
# measured (docs/benchmarks/reconstruction.md, test street 1).

# Truncation of signed distances, in sample distances.
TRUNCATION_VOXELS = 3.0
# Greatest height above the path, in metres.
MAX_HEIGHT_M = 40.0
# Overlap of two background levels, in metres, so that their meshes meet.
_LEVEL_OVERLAP_M = 1.0
# Margin of an actor's grid around its box, in metres.
_ACTOR_PADDING_M = 0.2
# Least number of pixels of an actor in a range image.
_MIN_VIEW_PIXELS = 12
# Least number of returns of an actor over the whole log; others have no grid.
_ACTOR_MIN_POINTS = 60
# Number of returns of an actor below which the sample distance is doubled.
_ACTOR_FINE_POINTS = 4000
# Size of a cell of the ground map, in metres.
_GROUND_CELL_M = 0.5


def fuse_log(log: DrivingLog, config: FuseConfig, *, progress: Progress) -> SceneFields:
    """Fuse a log's sweeps into grids of the background (frame `world`) and actors (frame `actor`).

    All labelled actors, parked or moving, are excluded from the background. Free space along any
    ray counts against surfaces of other views.

    Raises:
        InputError: the log has no sweep, or no return near the path.
    """
    if not log.sweeps:
        raise InputError(
            "the log has no LiDAR sweep",
            where=log.name,
            remedy="Geometry requires LiDAR: add the sweeps, or choose other frames.",
        )
    path = centre_line(log.ego.positions_m)
    sweeps = log.sweeps[:: config.every_nth_sweep]
    ground, counts = find_ground(log, path, config.radius_m[-1], progress)
    levels = tuple(_Level(i, path, ground, config) for i in range(len(config.voxel_m)))
    actors = {
        i: _ActorFusion(log.actors[i], config, int(counts[i + 1]))
        for i in np.flatnonzero(counts[1:] >= _ACTOR_MIN_POINTS).tolist()
    }

    def seen_by(lazy: LazySweep) -> list[RangeImage]:
        views = views_of_sweep(log, lazy.load())
        return [make_range_image(view, ground, config) for view in views]

    # Range images need no parallel loop of numba, of which only one may run at a time.
    images = mapped_ahead(seen_by, sweeps, worker_count())
    for sweep_images in progress.track(images, "fuse sweeps", len(sweeps)):
        for image in sweep_images:
            points, labels = image.surface_points()
            for level in levels:
                level.add(image, points[labels == 0])
            seen = np.bincount(image.labels[image.labels > 0], minlength=1)
            for label in np.flatnonzero(seen >= _MIN_VIEW_PIXELS).tolist():
                if label - 1 in actors:
                    actors[label - 1].add(image, label)
    grids = {log.actors[i].actor_id: fusion.grid() for i, fusion in actors.items()}
    note = f"{len(grids)} of {len(log.actors)} actors have LiDAR geometry"
    return SceneFields(
        tuple(level.grid() for level in levels), config.radius_m, grids, ground, path, (note,)
    )


def find_ground(
    log: DrivingLog, path: Float64[np.ndarray, "n 3"], reach_m: float, progress: Progress
) -> tuple[GroundMap, Float64[np.ndarray, " a"]]:
    """Return the ground map up to `reach_m` from the path, and the number of returns by label."""
    builder = GroundBuilder(path, reach_m, _GROUND_CELL_M)
    counts = np.zeros(len(log.actors) + 1)
    for lazy in progress.track(log.sweeps, "find the ground", len(log.sweeps)):
        sweep = lazy.load()
        labels = actor_labels(sweep, log.actors)
        counts += np.bincount(labels, minlength=len(counts))
        builder.add(sweep.points_world[labels == 0])
    return builder.build(), counts


class _Blocks:
    """Growing set of blocks of a grid, with the running means of their samples."""

    def __init__(
        self, frame: str, origin_m: Float64[np.ndarray, "3"], voxel_m: float, truncation_m: float
    ) -> None:
        self.frame = frame
        self.origin_m = origin_m
        self.voxel_m = voxel_m
        self.truncation_m = truncation_m
        self.coords = np.zeros((0, 3), dtype=np.int32)
        self.sdf = np.zeros((0, BLOCK, BLOCK, BLOCK), dtype=np.float32)
        self.weight = np.zeros((0, BLOCK, BLOCK, BLOCK), dtype=np.float32)

    def grow(self, coords: Int32[np.ndarray, "b 3"]) -> None:
        """Append unobserved blocks."""
        fresh = np.zeros((len(coords), BLOCK, BLOCK, BLOCK), dtype=np.float32)
        self.coords = np.concatenate([self.coords, coords])
        self.sdf = np.concatenate([self.sdf, fresh])
        self.weight = np.concatenate([self.weight, fresh])

    def integrate(
        self,
        image: RangeImage,
        target: int,
        world_from_grid: Float64[np.ndarray, "4 4"],
        furthest_m: float,
    ) -> None:
        """Average a view's truncated signed distances to label `target` into all blocks."""
        grid = (*self.origin_m.tolist(), self.voxel_m, self.truncation_m, furthest_m)
        integrate_view(
            self.coords,
            self.sdf,
            self.weight,
            grid,
            np.ascontiguousarray(world_from_grid[:3, :3]),
            world_from_grid[:3, 3] - image.origin_world,
            image.pixel,
            image.image,
            image.labels,
            target,
        )

    def grid(self) -> TsdfGrid:
        """Return the blocks so far, in the order of their coordinates."""
        order = np.lexsort(self.coords.T[::-1])
        return TsdfGrid(
            self.frame,
            self.origin_m,
            self.voxel_m,
            self.truncation_m,
            self.coords[order],
            self.sdf[order],
            self.weight[order],
        )


class _Level:
    """One resolution of the background: blocks near surfaces within a ring around the path."""

    def __init__(
        self, index: int, path: Float64[np.ndarray, "n 3"], ground: GroundMap, config: FuseConfig
    ) -> None:
        voxel, outer = config.voxel_m[index], config.radius_m[index]
        inner = config.radius_m[index - 1] - _LEVEL_OVERLAP_M if index else 0.0
        self._band = (max(inner, 0.0), outer)
        self._path = path
        # Surfaces inside the ring may be observed from 30 m further along the path.
        self._reach = outer + 30.0
        low = path.min(axis=0) - outer
        low[2] = float(ground.height_m.min()) - 2.0
        high = path.max(axis=0) + outer
        high[2] = float(path[:, 2].max()) + MAX_HEIGHT_M
        self._block_m = voxel * BLOCK
        low = np.floor(low / self._block_m) * self._block_m
        shape = np.ceil((high - low) / self._block_m).astype(np.int64)
        self._table: Bool[np.ndarray, "x y z"] = np.zeros(tuple(shape.tolist()), dtype=bool)
        self._blocks = _Blocks("world", low, voxel, voxel * TRUNCATION_VOXELS)

    def add(self, image: RangeImage, points_world: Float64[np.ndarray, "n 3"]) -> None:
        """Add blocks around the points, then integrate the view into all blocks."""
        blocks = self._blocks
        before = self._table.copy()
        mark_blocks(
            points_world,
            blocks.origin_m,
            self._block_m,
            blocks.truncation_m,
            self._band,
            self._path,
            self._table,
        )
        blocks.grow(np.argwhere(self._table & ~before).astype(np.int32))
        blocks.integrate(image, 0, np.eye(4), self._reach)

    def grid(self) -> TsdfGrid:
        """Return the level so far."""
        return self._blocks.grid()


class _ActorFusion:
    """Dense grid of one actor, in its box frame."""

    def __init__(self, actor: ActorTrack, config: FuseConfig, returns: int) -> None:
        self._actor = actor
        low = -actor.size_lwh_m / 2 - _ACTOR_PADDING_M
        extent = actor.size_lwh_m + 2 * _ACTOR_PADDING_M
        # Few returns indicate a distant actor, where finer samples would contain only noise.
        voxel = config.actor_voxel_m * (1.0 if returns >= _ACTOR_FINE_POINTS else 2.0)
        shape = np.ceil(extent / (voxel * BLOCK)).astype(np.int64)
        # Symmetric about y = 0, so that completion can mirror samples exactly.
        low[1] = -voxel * (BLOCK * shape[1] - 1) / 2
        self._blocks = _Blocks("actor", low.astype(np.float64), voxel, voxel * TRUNCATION_VOXELS)
        self._blocks.grow(np.argwhere(np.ones(tuple(shape.tolist()), dtype=bool)).astype(np.int32))

    def add(self, image: RangeImage, label: int) -> None:
        """Integrate the view's returns of `label` if the actor is present at its time."""
        if self._actor.is_present(image.time_ns, SWEEP_HOLD_S):
            pose = self._actor.world_from_actor(image.time_ns, SWEEP_HOLD_S).matrix
            self._blocks.integrate(image, label, pose, 120.0)

    def grid(self) -> TsdfGrid:
        """Return the actor's grid so far, in its box frame."""
        return self._blocks.grid()
