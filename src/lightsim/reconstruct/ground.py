"""Height of the ground from the lowest returns."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import cg

from lightsim.core.fields import GroundMap
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
    surface = _nearest_known(height, is_seen)
    is_ground = is_seen.copy()
    size = 3
    while size * cell_m <= _OPENING_M:
        opened = ndimage.grey_opening(surface, size=(size, size))
        is_ground &= surface - opened <= _STEP_M + _MAX_SLOPE * size * cell_m / 2
        surface = np.minimum(surface, opened + _STEP_M)
        size = 2 * size + 1
    return is_ground


def _nearest_known(
    values: Float[np.ndarray, "nx ny"], is_known: Bool[np.ndarray, "nx ny"]
) -> Float[np.ndarray, "nx ny"]:
    nearest = np.asarray(
        ndimage.distance_transform_edt(~is_known, return_distances=False, return_indices=True)
    )
    return values[nearest[0], nearest[1]]


def fill_smoothly(
    values: Float64[np.ndarray, "nx ny"], is_known: Bool[np.ndarray, "nx ny"]
) -> Float64[np.ndarray, "nx ny"]:
    """Solve Laplace's equation where values are unknown, with mirrored borders."""
    unknown = np.flatnonzero(~is_known)
    if len(unknown) == 0 or not is_known.any():
        return values
    start = _nearest_known(values, is_known)
    number = np.full(values.size, -1, dtype=np.int64)
    number[unknown] = np.arange(len(unknown))
    index = np.arange(values.size).reshape(values.shape)
    rows, columns, right, degree = [], [], np.zeros(len(unknown)), np.zeros(len(unknown))
    for here, there in (
        (index[:-1], index[1:]),
        (index[1:], index[:-1]),
        (index[:, :-1], index[:, 1:]),
        (index[:, 1:], index[:, :-1]),
    ):
        a, b = here.ravel(), there.ravel()
        a, b = a[number[a] >= 0], b[number[a] >= 0]
        np.add.at(degree, number[a], 1.0)
        is_free = number[b] >= 0
        rows.append(number[a[is_free]])
        columns.append(number[b[is_free]])
        np.add.at(right, number[a[~is_free]], values.ravel()[b[~is_free]])
    i = np.concatenate([*rows, np.arange(len(unknown))])
    j = np.concatenate([*columns, np.arange(len(unknown))])
    off_diagonal = -np.ones(len(i) - len(unknown))
    matrix = csr_matrix((np.concatenate([off_diagonal, degree]), (i, j)))
    solution, _ = cg(matrix, right, x0=start.ravel()[unknown], rtol=1e-5, maxiter=500)
    result = values.copy().ravel()
    result[unknown] = solution
    return result.reshape(values.shape)
