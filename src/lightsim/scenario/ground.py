"""Ground below inserted and moved actors: its height, and whether it was measured."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from lightsim.core.casting import RayCaster
from lightsim.core.fields import GroundMap

# Largest difference in height between the mesh of the road and the height map, in metres: hedges,
# walls and vehicles are higher. Chosen; sensitivity not measured.
_SAME_GROUND_M = 0.3
# Distance from observed ground within which ground counts as known, in metres: the width of parked
# cars and of the ego, which hide it.
_NEAR_M = 2.5


@dataclass(frozen=True, eq=False)
class StandingGround:
    """The reconstructed ground.

    Args:
        heights: height map.
        background: caster over the twin's static meshes, whose road rendered actors must touch;
            None: the map alone.
    """

    heights: GroundMap
    background: RayCaster | None = None

    def height_m(self, xy_world: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Return the height of the twin's road; that of the map where there is no mesh.

        Rays start just above the map, below bridges, trees and roofs.
        """
        height = self.heights.look_up(xy_world)
        if self.background is None or not len(xy_world):
            return height
        above = np.column_stack([xy_world, height + _SAME_GROUND_M])
        down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), above.shape)
        distance = self.background.intersect(above, down).distance_m
        is_road = distance < 2 * _SAME_GROUND_M
        return np.where(is_road, above[:, 2] - np.where(is_road, distance, 0.0), height)

    def is_known(self, xy_world: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Return whether ground was measured at each place or nearby."""
        cell = np.rint((xy_world - self.heights.origin_m) / self.heights.cell_m)
        shape = np.array(self.heights.height_m.shape)
        is_inside = ((cell >= 0) & (cell < shape)).all(axis=1)
        i, j = np.clip(cell, 0, shape - 1).astype(np.int64).T
        return is_inside & (self._distance_m[i, j] < _NEAR_M)

    @cached_property
    def _distance_m(self) -> Float[np.ndarray, "nx ny"]:
        from scipy.ndimage import distance_transform_edt

        cells = np.asarray(distance_transform_edt(~self.heights.is_observed))
        return cells * self.heights.cell_m
