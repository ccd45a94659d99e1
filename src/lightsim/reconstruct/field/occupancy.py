"""Where anything may be, as LiDAR returns alone tell: coarse voxels around them.

This is how the paper's field is sampled ("incorporates the LiDAR information to perform efficient
ray-marching", appendix; UniSim, doi:10.1109/CVPR52729.2023.00140): no surface is known beforehand,
only which space has returns in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from scipy import ndimage

from lightsim.core.log import DrivingLog
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.reconstruct.field.prior_kernels import march
from lightsim.reconstruct.fusion.sweep_views import label_points

# UniSim's. Its neighbours count as occupied, too, so that a return at a voxel's edge has room on
# both sides.
VOXEL_M = 0.5
# Of a ray; further ones lie behind so many surfaces that hardly any light comes from there.
STRETCHES = 6
# Half a voxel: none is jumped over but at its corners.
_STEP_M = 0.25
# Above the path: nothing higher is fused either.
_HEIGHT_M = 40.0


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Occupied voxels of `VOXEL_M`, frame `world`.

    Args:
        origin_m: lowest corner of voxel (0, 0, 0), a multiple of the voxel.
        is_occupied: a return of what does not move lies in the voxel or right beside it.
    """

    origin_m: Float64[np.ndarray, "3"]
    is_occupied: Bool[np.ndarray, "x y z"]

    @staticmethod
    def of_returns(
        log: DrivingLog, path_m: Float[np.ndarray, "k 3"], reach_m: float, progress: Progress
    ) -> Occupancy:
        """Around the returns up to `reach_m` beside the path, those of labelled actors left out.

        Raises:
            InputError: there is no return.
        """
        margin = np.array([reach_m, reach_m, _HEIGHT_M])
        low = VOXEL_M * np.floor((path_m.min(axis=0) - margin) / VOXEL_M)
        shape = np.ceil((path_m.max(axis=0) + margin - low) / VOXEL_M).astype(np.int64)
        holds = np.zeros(tuple(shape.tolist()), dtype=bool)
        for lazy in progress.track(log.sweeps, "mark occupied space", len(log.sweeps)):
            sweep = lazy.load()
            points = sweep.points_world[label_points(log.actors, sweep) == 0]
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
        """Whether points lie in occupied voxels."""
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
        """Distances at which rays enter and leave occupied space, nearest first; what is missing
        is empty, from 0 to 0.

        Args:
            boxes_m: distances at which each ray is in boxes of actors, which are not searched.
        """
        found = np.zeros((len(origin_world), STRETCHES, 2), dtype=np.float32)
        march(
            (self.is_occupied, self.origin_m, VOXEL_M, _STEP_M),
            np.ascontiguousarray(origin_world, dtype=np.float64),
            np.ascontiguousarray(direction_world, dtype=np.float64),
            boxes_m,
            found,
        )
        return found
