"""Occupied space: coarse voxels around LiDAR returns.

The paper's field is sampled in occupied space ("incorporates the LiDAR information to perform
efficient ray-marching", appendix; UniSim, doi:10.1109/CVPR52729.2023.00140), without a prior
surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from scipy import ndimage

from lightsim.core.lidar_returns import actor_labels
from lightsim.core.log import DrivingLog
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.reconstruct.field.prior_kernels import march
from lightsim.reconstruct.fusion.tsdf import MAX_HEIGHT_M

# Size of a voxel in metres, as in UniSim. Neighbours of a voxel with returns are occupied, too, so
# that the space on both sides of a return is sampled.
VOXEL_M = 0.5
# Number of occupied intervals of a ray; later ones are behind several surfaces.
STRETCHES = 6


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Occupied voxels of `VOXEL_M`, frame `world`.

    Args:
        origin_m: lowest corner of voxel (0, 0, 0), a multiple of the voxel.
        is_occupied: mask of voxels with a return of the static scene, or with such a neighbour.
    """

    origin_m: Float64[np.ndarray, "3"]
    is_occupied: Bool[np.ndarray, "x y z"]

    @staticmethod
    def of_returns(
        log: DrivingLog, path_m: Float[np.ndarray, "k 3"], reach_m: float, progress: Progress
    ) -> Occupancy:
        """Mark the static returns within `reach_m` of the path; labelled actors are excluded.

        Raises:
            InputError: there is no return.
        """
        margin = np.array([reach_m, reach_m, MAX_HEIGHT_M])
        low = VOXEL_M * np.floor((path_m.min(axis=0) - margin) / VOXEL_M)
        shape = np.ceil((path_m.max(axis=0) + margin - low) / VOXEL_M).astype(np.int64)
        holds = np.zeros(tuple(shape.tolist()), dtype=bool)
        for lazy in progress.track(log.sweeps, "mark occupied space", len(log.sweeps)):
            sweep = lazy.load()
            points = sweep.points_world[actor_labels(sweep, log.actors) == 0]
            voxel = np.floor((points - low) / VOXEL_M).astype(np.int64)
            inside = ((voxel >= 0) & (voxel < shape)).all(axis=1)
            holds[tuple(voxel[inside].T)] = True
        if not holds.any():
            raise InputError(
                "no LiDAR return near the path",
                where=log.name,
                remedy="Check the sweeps and the ego poses.",
            )
        return Occupancy(low, ndimage.binary_dilation(holds, np.ones((3, 3, 3), dtype=bool)))

    def holds(self, points_world: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Return the mask of points in occupied voxels."""
        voxel = np.floor((points_world - self.origin_m) / VOXEL_M).astype(np.int64)
        shape = np.array(self.is_occupied.shape)
        inside = ((voxel >= 0) & (voxel < shape)).all(axis=-1)
        voxel = np.clip(voxel, 0, shape - 1)
        return inside & self.is_occupied[voxel[..., 0], voxel[..., 1], voxel[..., 2]]

    def stretches_m(
        self,
        origin_world: Float[np.ndarray, "n 3"],
        direction_world: Float[np.ndarray, "n 3"],
        boxes_m: Float32[np.ndarray, "n s 2"],
    ) -> Float32[np.ndarray, "n k 2"]:
        """Return the distances at which rays enter and leave occupied space, nearest first.

        Unused intervals are (0, 0).

        Args:
            origin_world: metres.
            direction_world: unit vectors.
            boxes_m: distances at which each ray enters and leaves actor boxes, which are excluded.
        """
        found = np.zeros((len(origin_world), STRETCHES, 2), dtype=np.float32)
        # Steps of half a voxel: only corners of voxels can be missed.
        march(
            (self.is_occupied, self.origin_m, VOXEL_M, VOXEL_M / 2),
            np.ascontiguousarray(origin_world, dtype=np.float64),
            np.ascontiguousarray(direction_world, dtype=np.float64),
            boxes_m,
            found,
        )
        return found
