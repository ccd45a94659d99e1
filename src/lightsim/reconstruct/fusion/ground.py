"""Height of the ground from the lowest returns."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from lightsim.core.fields import GroundMap
from lightsim.core.laplace import fill_smoothly, nearest_known
from lightsim.errors import InputError

# The values below were chosen by inspection; their sensitivity was not measured.

# Greatest slope of the ground between neighbouring cells.
_MAX_SLOPE = 0.25
# Width of the largest object that the morphological filter removes, in metres.
_OPENING_M = 6.0
# Greatest step of the ground, such as a kerb, in metres.
_STEP_M = 0.2
# Height range of the returns of one cell, in metres, above which the cell has an upright object.
_UPRIGHT_M = 0.5
# Greatest height of the foot of an upright object above the ground beside it, in metres.
_FOOT_M = 0.1
# Greatest distance over which such a foot is connected to ground, in metres: it may be occluded.
_BESIDE_M = 2.0
# Greatest slope of the ground across a gap.
_GAP_SLOPE = 0.1
# Widths of bridged gaps in metres, in the order of bridging: short gaps are more reliable.
_GAPS_M = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
# Candidate distances from the path, in metres, of the ground that the ego vehicle drives on; the
# first with `_LEAST_CELLS` is used.
_OWN_M = (3.0, 6.0, 12.0, 24.0)
# Least number of cells of this ground.
_LEAST_CELLS = 10


class GroundBuilder:
    """Ground map from the lowest return of every cell in each sweep.

    The median of the sweeps' minima ignores single specular reflections below the road.

    Args:
        path_m: positions of the ego vehicle, metres, frame world.
        radius_m: margin of the map around the path.
        cell_m: size of a cell.
    """

    def __init__(self, path_m: Float[np.ndarray, "n 3"], radius_m: float, cell_m: float) -> None:
        low = np.floor((path_m[:, :2].min(axis=0) - radius_m) / cell_m) * cell_m
        high = path_m[:, :2].max(axis=0) + radius_m
        self.origin_m = low
        self.cell_m = cell_m
        self.shape = tuple(int(n) for n in np.ceil((high - low) / cell_m) + 1)
        self._path_m = path_m
        self._minima: list[Float32[np.ndarray, "nx ny"]] = []
        self._highest = np.full(self.shape, -np.inf, dtype=np.float32)

    def add(self, points_world: Float[np.ndarray, "n 3"]) -> None:
        """Add the static returns of one sweep."""
        cell = np.rint((points_world[:, :2] - self.origin_m) / self.cell_m).astype(np.int64)
        is_in = ((cell >= 0) & (cell < self.shape)).all(axis=1)
        lowest = np.full(self.shape, np.inf, dtype=np.float32)
        z = points_world[is_in, 2].astype(np.float32)
        np.minimum.at(lowest, (cell[is_in, 0], cell[is_in, 1]), z)
        np.maximum.at(self._highest, (cell[is_in, 0], cell[is_in, 1]), z)
        self._minima.append(lowest)

    def build(self) -> GroundMap:
        """Return the ground map; cells without ground are interpolated smoothly.

        Raises:
            InputError: no return lies in the area.
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
        is_upright = self._highest > middle + _UPRIGHT_M
        own = self._own_ground(is_ground)
        is_ground = _connected_ground(middle, is_ground, is_upright, own, self.cell_m)
        filled = fill_smoothly(np.where(is_ground, middle, 0.0).astype(np.float64), is_ground)
        return GroundMap(
            self.origin_m.astype(np.float64), self.cell_m, filled.astype(np.float32), is_ground
        )

    def _own_ground(self, is_ground: Bool[np.ndarray, "nx ny"]) -> Bool[np.ndarray, "nx ny"]:
        """Mask of ground cells beside the path."""
        cell = np.rint((self._path_m[:, :2] - self.origin_m) / self.cell_m).astype(np.int64)
        is_path = np.zeros(self.shape, dtype=bool)
        is_path[tuple(np.clip(cell, 0, np.array(self.shape) - 1).T)] = True
        away_m = np.asarray(ndimage.distance_transform_edt(~is_path)) * self.cell_m
        for reach_m in _OWN_M:
            own = is_ground & (away_m <= reach_m)
            if own.sum() >= _LEAST_CELLS:
                return own
        return is_ground


def _connected_ground(
    height: Float[np.ndarray, "nx ny"],
    is_ground: Bool[np.ndarray, "nx ny"],
    is_upright: Bool[np.ndarray, "nx ny"],
    is_own: Bool[np.ndarray, "nx ny"],
    cell_m: float,
) -> Bool[np.ndarray, "nx ny"]:
    """Mask of ground cells connected to the path without a step, or over gaps of little slope.

    Other cells are errors: behind parked cars the lowest returns are of a facade, metres above the
    ground, and reflections in windows and puddles are metres below it.
    """
    allowed = np.where(is_upright, _FOOT_M, _STEP_M + _MAX_SLOPE * cell_m)
    part = _connected(np.where(is_ground, height, np.inf), allowed)
    reached = np.isin(part, np.unique(part[is_own & ~is_upright])) & is_ground
    step, slope = np.where(is_upright, _FOOT_M, _STEP_M), np.where(is_upright, 0.0, _GAP_SLOPE)
    bridged_m = np.where(is_upright, _BESIDE_M, np.inf)
    for gap_m in _GAPS_M:
        while reached.any():
            nearest = np.zeros((2, *reached.shape), dtype=np.int32)
            away = np.asarray(
                ndimage.distance_transform_edt(~reached, return_indices=True, indices=nearest)
            )
            rise = height - height[tuple(nearest)]
            is_new = is_ground & ~reached & (away * cell_m <= np.minimum(gap_m, bridged_m))
            is_new &= np.abs(rise) <= step + slope * away * cell_m
            if not is_new.any():
                break
            reached |= is_ground & np.isin(part, np.unique(part[is_new]))
    return reached


def _connected(
    height: Float[np.ndarray, "nx ny"], allowed: Float[np.ndarray, "nx ny"]
) -> Int32[np.ndarray, "nx ny"]:
    """Component of each cell, where neighbours differ by no more than both cells allow."""
    index = np.arange(height.size).reshape(height.shape)
    pairs = []
    for a, b in (
        (np.s_[1:, :], np.s_[:-1, :]),
        (np.s_[:, 1:], np.s_[:, :-1]),
        (np.s_[1:, 1:], np.s_[:-1, :-1]),
        (np.s_[1:, :-1], np.s_[:-1, 1:]),
    ):
        is_both = np.isfinite(height[a]) & np.isfinite(height[b])
        step = np.where(is_both, height[a], 0.0) - np.where(is_both, height[b], 0.0)
        is_level = is_both & (np.abs(step) <= np.minimum(allowed[a], allowed[b]))
        pairs.append(np.stack([index[a][is_level], index[b][is_level]]))
    i, j = np.concatenate(pairs, axis=1)
    graph = csr_matrix((np.ones(len(i), dtype=bool), (i, j)), shape=(height.size,) * 2)
    return connected_components(graph, directed=False)[1].reshape(height.shape)


def _is_ground(
    height: Float[np.ndarray, "nx ny"], is_seen: Bool[np.ndarray, "nx ny"], cell_m: float
) -> Bool[np.ndarray, "nx ny"]:
    """Progressive morphological filter (Zhang et al. 2003, doi:10.1109/TGRS.2003.810682)."""
    surface = nearest_known(height, is_seen)
    is_ground = is_seen.copy()
    # The window doubles: small objects first, so that slopes remain below the threshold.
    size = 3
    while size * cell_m <= _OPENING_M:
        opened = ndimage.grey_opening(surface, size=(size, size))
        is_ground &= surface - opened <= _STEP_M + _MAX_SLOPE * size * cell_m / 2
        surface = np.minimum(surface, opened + _STEP_M)
        size = 2 * size + 1
    return is_ground
