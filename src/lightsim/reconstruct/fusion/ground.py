"""Height of the ground from the lowest returns."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy import ndimage

from lightsim.core.fields import GroundMap
from lightsim.core.laplace import fill_smoothly, nearest_known
from lightsim.errors import InputError

_MAX_SLOPE = 0.25
_OPENING_M = 6.0
_STEP_M = 0.2


class GroundBuilder:
    """Collects the lowest return of every cell, sweep by sweep.

    The median of the sweeps' minima ignores single reflections below the road.
    """

    def __init__(self, path_m: Float[np.ndarray, "n 3"], radius_m: float, cell_m: float) -> None:
        low = np.floor((path_m[:, :2].min(axis=0) - radius_m) / cell_m) * cell_m
        high = path_m[:, :2].max(axis=0) + radius_m
        self.origin_m = low
        self.cell_m = cell_m
        self.shape = tuple(int(n) for n in np.ceil((high - low) / cell_m) + 1)
        self._minima: list[Float32[np.ndarray, "nx ny"]] = []

    def add(self, points_world: Float[np.ndarray, "n 3"]) -> None:
        """Static returns of one sweep."""
        cell = np.rint((points_world[:, :2] - self.origin_m) / self.cell_m).astype(np.int64)
        is_in = ((cell >= 0) & (cell < self.shape)).all(axis=1)
        lowest = np.full(self.shape, np.inf, dtype=np.float32)
        z = points_world[is_in, 2].astype(np.float32)
        np.minimum.at(lowest, (cell[is_in, 0], cell[is_in, 1]), z)
        self._minima.append(lowest)

    def build(self) -> GroundMap:
        """The ground map; cells without ground are interpolated smoothly.

        Raises:
            InputError: no return fell into the area.
        """
        stack = np.stack(self._minima) if self._minima else np.full((1, *self.shape), np.inf)
        count = np.isfinite(stack).sum(axis=0)
        if not count.any():
            raise InputError(
                "no LiDAR return near the path", remedy="Check the sweeps and the ego poses."
            )
        ordered = np.sort(stack, axis=0)
        middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
        is_ground = _is_ground(middle, count > 0, self.cell_m)
        filled = fill_smoothly(np.where(is_ground, middle, 0.0).astype(np.float64), is_ground)
        return GroundMap(
            self.origin_m.astype(np.float64), self.cell_m, filled.astype(np.float32), is_ground
        )


def _is_ground(
    height: Float[np.ndarray, "nx ny"], is_seen: Bool[np.ndarray, "nx ny"], cell_m: float
) -> Bool[np.ndarray, "nx ny"]:
    """Progressive morphological filter (Zhang et al. 2003, doi:10.1109/TGRS.2003.810682)."""
    surface = nearest_known(height, is_seen)
    is_ground = is_seen.copy()
    size = 3
    while size * cell_m <= _OPENING_M:
        opened = ndimage.grey_opening(surface, size=(size, size))
        is_ground &= surface - opened <= _STEP_M + _MAX_SLOPE * size * cell_m / 2
        surface = np.minimum(surface, opened + _STEP_M)
        size = 2 * size + 1
    return is_ground
