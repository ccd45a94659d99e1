"""The voxel grid of inferred structures and what the views say about its voxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Int16, UInt8, UInt16

from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError

_MAX_VOXELS = 400_000_000


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """A box of cubes aligned with frame world; `low_m` is its lowest corner."""

    low_m: Float[np.ndarray, "3"]
    voxel_m: float
    shape: tuple[int, int, int]

    @staticmethod
    def around(mesh: TriMesh, voxel_m: float, height_m: float) -> VoxelGrid:
        """A grid over the mesh, without its outermost 0.2 %, and `height_m` high.

        Raises:
            InputError: the grid would need more than 400 million voxels.
        """
        low = np.percentile(mesh.vertices, 0.2, axis=0).astype(np.float64) - 2 * voxel_m
        high = np.percentile(mesh.vertices, 99.8, axis=0).astype(np.float64) + 2 * voxel_m
        high[2] = low[2] + height_m
        counts = np.maximum(np.ceil((high - low) / voxel_m), 1).astype(np.int64)
        if int(np.prod(counts)) > _MAX_VOXELS:
            raise InputError(
                "the scene is too large for the voxel grid of inferred structures",
                got=f"{' x '.join(str(c) for c in counts)} voxels of {voxel_m} m",
                remedy="Use a larger voxel_m, or fewer frames.",
            )
        return VoxelGrid(low, voxel_m, (int(counts[0]), int(counts[1]), int(counts[2])))

    def cells(self, points_world: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n 3"]:
        """Voxel index of each point; may lie outside the grid."""
        return np.floor((points_world - self.low_m) / self.voxel_m).astype(np.int64)

    def contains(self, cells: Int[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which voxel indices, as `cells` gives them, lie within the grid."""
        return np.all((cells >= 0) & (cells < np.array(self.shape)), axis=1)


@dataclass(eq=False)
class VoxelEvidence:
    """Filled view by view.

    Args:
        grid: where the voxels are.
        is_free: 1 where a ray passed on to sky or to a farther surface.
        votes: number of views that show unexplained matter on the voxel's ray.
        last_view: the last view that voted, so that it votes once.
        view_count: views so far.
    """

    grid: VoxelGrid
    is_free: UInt8[np.ndarray, "x y z"]
    votes: UInt16[np.ndarray, "x y z"]
    last_view: Int16[np.ndarray, "x y z"]
    view_count: int = 0

    @staticmethod
    def empty(grid: VoxelGrid) -> VoxelEvidence:
        """Before the first view: nothing is free, nothing has votes."""
        return VoxelEvidence(
            grid,
            np.zeros(grid.shape, np.uint8),
            np.zeros(grid.shape, np.uint16),
            np.zeros(grid.shape, np.int16),
        )
