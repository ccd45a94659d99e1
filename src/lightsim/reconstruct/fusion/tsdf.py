"""LiDAR fusion: sweeps into signed-distance grids of the static scene and of every actor.

Range-image fusion after Curless & Levoy 1996 (doi:10.1145/237170.237269), with point-to-plane
distances and neighbouring beams joined where the surface is continuous. The paper learns a neural
field here (Sec. 3.1); this is its initialisation and a usable geometry of its own.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int32

from lightsim.core.actors import ActorTrack
from lightsim.core.fields import BLOCK, GroundMap, SceneFields, TsdfGrid
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import SWEEP_HOLD_S
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.reconstruct.fusion.config import FuseConfig, draft, standard
from lightsim.reconstruct.fusion.ground import GroundBuilder
from lightsim.reconstruct.fusion.range_image import RangeImage, make_range_image
from lightsim.reconstruct.fusion.sweep_views import centre_line, label_points, views_of_sweep
from lightsim.reconstruct.fusion.tsdf_kernels import integrate_view, mark_blocks

__all__ = ["FuseConfig", "draft", "fuse_log", "standard"]

_LEVEL_OVERLAP_M = 1.0
_ACTOR_PADDING_M = 0.2
_MIN_VIEW_PIXELS = 12


# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/reconstruction.md, where the street of seed 1 is the fair test).

# Distances are clipped to this many samples on either side of a surface.
_TRUNCATION_VOXELS = 3.0
# Actors with fewer returns over the whole log get no grid.
_ACTOR_MIN_POINTS = 60
# Actors with fewer returns than this get samples of twice the distance.
_ACTOR_FINE_POINTS = 4000
# Cell of the ground map.
_GROUND_CELL_M = 0.5
# Nothing higher than this above the path is fused.
_MAX_HEIGHT_M = 40.0


def fuse_log(log: DrivingLog, config: FuseConfig, *, progress: Progress) -> SceneFields:
    """Signed-distance grids of the background (frame `world`) and of each actor (frame `actor`).

    Every labelled actor, parked or moving, is cut out of the background. Free space seen by any
    ray carves away what others left there.

    Raises:
        InputError: the log has no sweep, or no return near the path.
    """
    if not log.sweeps:
        raise InputError(
            "the log has no LiDAR sweep",
            where=log.name,
            remedy="Geometry needs LiDAR: add the sweeps, or choose other frames.",
        )
    path = centre_line(log.ego.positions_m)
    sweeps = log.sweeps[:: config.every_nth_sweep]
    ground, counts = find_ground(log, path, config.radius_m[-1], progress)
    levels = tuple(_Level(i, path, ground, config) for i in range(len(config.voxel_m)))
    actors = {
        i: _ActorFusion(log.actors[i], config, int(counts[i + 1]))
        for i in np.flatnonzero(counts[1:] >= _ACTOR_MIN_POINTS).tolist()
    }
    for lazy in progress.track(sweeps, "fuse sweeps", len(sweeps)):
        for view in views_of_sweep(log, lazy.load()):
            image = make_range_image(view, ground, config)
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
    """The ground map up to `reach_m` from the path, and how many returns each label received."""
    builder = GroundBuilder(path, reach_m, _GROUND_CELL_M)
    counts = np.zeros(len(log.actors) + 1)
    for lazy in progress.track(log.sweeps, "find the ground", len(log.sweeps)):
        sweep = lazy.load()
        labels = label_points(log.actors, sweep)
        counts += np.bincount(labels, minlength=len(counts))
        builder.add(sweep.points_world[labels == 0])
    return builder.build(), counts


class _Blocks:
    """A growing set of blocks over a fixed box of space."""

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
        """Appends unobserved blocks."""
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
        """Averages a view's truncated signed distances to `target` into all blocks."""
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
        """The blocks so far, in the order of their coordinates."""
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
    """One resolution of the background: a ring around the path, blocks where surfaces are."""

    def __init__(
        self,
        index: int,
        path: Float64[np.ndarray, "n 3"],
        ground: GroundMap,
        config: FuseConfig,
    ) -> None:
        voxel, outer = config.voxel_m[index], config.radius_m[index]
        inner = config.radius_m[index - 1] - _LEVEL_OVERLAP_M if index else 0.0
        self._band = (max(inner, 0.0), outer)
        self._path = path
        self._reach = outer + 30.0
        low = path.min(axis=0) - outer
        low[2] = float(ground.height_m.min()) - 2.0
        high = path.max(axis=0) + outer
        high[2] = float(path[:, 2].max()) + _MAX_HEIGHT_M
        self._block_m = voxel * BLOCK
        low = np.floor(low / self._block_m) * self._block_m
        shape = np.ceil((high - low) / self._block_m).astype(np.int64)
        self._table: Bool[np.ndarray, "x y z"] = np.zeros(tuple(shape.tolist()), dtype=bool)
        self._blocks = _Blocks("world", low, voxel, voxel * _TRUNCATION_VOXELS)

    def add(self, image: RangeImage, points_world: Float64[np.ndarray, "n 3"]) -> None:
        """Opens blocks around the points, then integrates the view into all of them."""
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
        """The level so far."""
        return self._blocks.grid()


class _ActorFusion:
    """The dense little grid of one actor, in its box frame."""

    def __init__(self, actor: ActorTrack, config: FuseConfig, returns: int) -> None:
        self._actor = actor
        low = -actor.size_lwh_m / 2 - _ACTOR_PADDING_M
        extent = actor.size_lwh_m + 2 * _ACTOR_PADDING_M
        # Few returns mean a distant actor: finer samples would hold nothing but noise.
        voxel = config.actor_voxel_m * (1.0 if returns >= _ACTOR_FINE_POINTS else 2.0)
        shape = np.ceil(extent / (voxel * BLOCK)).astype(np.int64)
        # Symmetric about y = 0, so that completion can mirror samples exactly.
        low[1] = -voxel * (BLOCK * shape[1] - 1) / 2
        self._blocks = _Blocks("actor", low.astype(np.float64), voxel, voxel * _TRUNCATION_VOXELS)
        self._blocks.grow(np.argwhere(np.ones(tuple(shape.tolist()), dtype=bool)).astype(np.int32))

    def add(self, image: RangeImage, label: int) -> None:
        """Integrates the view's returns of `label` where the actor is present at its time."""
        if self._actor.is_present(image.time_ns, SWEEP_HOLD_S):
            pose = self._actor.world_from_actor(image.time_ns, SWEEP_HOLD_S).matrix
            self._blocks.integrate(image, label, pose, 120.0)

    def grid(self) -> TsdfGrid:
        """The actor so far, in its box frame."""
        return self._blocks.grid()
