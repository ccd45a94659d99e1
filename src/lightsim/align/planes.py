"""Local planes of a point map, and the distances of returns from them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree

# Sensitivity of the alignment to these constants is not measured.

# Nearest returns that are searched; those of other sweeps define a plane.
_NEIGHBOURS = 24
# Fewest neighbours of other sweeps for a plane.
_LEAST_NEIGHBOURS = 8
# Largest distance of a neighbour: three voxels of the map.
_RADIUS_M = 0.6
# Least standard deviation of the neighbours along the plane's narrower axis; excludes lines.
_LEAST_WIDTH_M = 0.1
# Largest distance of a return from its plane; a farther return is on another surface.
_LARGEST_RESIDUAL_M = 0.4
# Returns that are processed at once: 12 MB for each array of their neighbours, for any log.
BATCH = 20_000


@dataclass(frozen=True, eq=False)
class Cloud:
    """Thinned returns of many sweeps.

    Args:
        points_world: positions in metres; in frame `actor` for returns of a moving actor.
        times_ns: time of each measurement.
        sweep: index of each return's sweep.
    """

    points_world: Float64[np.ndarray, "n 3"]
    times_ns: Int64[np.ndarray, " n"]
    sweep: Int64[np.ndarray, " n"]

    def rows(self, which: np.ndarray) -> Cloud:
        """Return the returns that `which` selects, an index array or a mask."""
        return Cloud(self.points_world[which], self.times_ns[which], self.sweep[which])


@dataclass(frozen=True, eq=False)
class Matches:
    """Returns and the planes through their neighbours of other sweeps.

    Args:
        rows: rows of the returns in the compared cloud.
        neighbours: rows of the map, padded with -1.
        normals: unit normals of the planes.
        residuals_m: signed distance of each return from its plane.
    """

    rows: Int64[np.ndarray, " m"]
    neighbours: Int64[np.ndarray, "m k"]
    normals: Float64[np.ndarray, "m 3"]
    residuals_m: Float64[np.ndarray, " m"]


def match_planes(cloud: Cloud, reference: Cloud, tree: KDTree, flat_m: float) -> Matches:
    """Return planes of `reference` (with search tree `tree`) at the points of `cloud`.

    A plane is the fit to neighbours of other sweeps, if their standard deviation across it is below
    `flat_m` and they do not form a line.
    """
    parts = [
        _match_some(cloud, slice(start, start + BATCH), reference, tree, flat_m)
        for start in range(0, max(len(cloud.sweep), 1), BATCH)
    ]
    return Matches(*[np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Matches)])


def _match_some(
    cloud: Cloud, part: slice, reference: Cloud, tree: KDTree, flat_m: float
) -> Matches:
    points, sweep = cloud.points_world[part], cloud.sweep[part]
    distance, near = tree.query(points, k=_NEIGHBOURS, distance_upper_bound=_RADIUS_M, workers=2)
    is_found = np.isfinite(distance)
    near = np.where(is_found, near, 0)
    is_found &= reference.sweep[near] != sweep[:, None]
    rows = np.flatnonzero(is_found.sum(axis=1) >= _LEAST_NEIGHBOURS)
    near, is_found = near[rows], is_found[rows]
    weights = is_found / is_found.sum(axis=1, keepdims=True)
    mean = (weights[..., None] * reference.points_world[near]).sum(axis=1)
    local = reference.points_world[near] - mean[:, None]
    covariance = np.einsum("nk,nki,nkj->nij", weights, local, local)
    # Eigenvalues ascend: the first eigenvector is the normal.
    values, vectors = np.linalg.eigh(covariance)
    deviation = np.sqrt(np.maximum(values, 0.0))
    normals = vectors[:, :, 0]
    residuals = np.einsum("ni,ni->n", normals, points[rows] - mean)
    is_good = (deviation[:, 0] < flat_m) & (deviation[:, 1] > _LEAST_WIDTH_M)
    is_good &= (deviation[:, 1] > 3.0 * deviation[:, 0]) & (np.abs(residuals) < _LARGEST_RESIDUAL_M)
    return Matches(
        part.start + rows[is_good],
        np.where(is_found, near, -1)[is_good].astype(np.int64),
        normals[is_good],
        residuals[is_good],
    )


def first_of_voxels(points: Float64[np.ndarray, "n 3"], voxel_m: float) -> Int64[np.ndarray, " m"]:
    """Return the row of the first point in each occupied voxel, in ascending order."""
    cells = np.floor(points / voxel_m).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    size = cells.max(axis=0, initial=0) + 1
    key = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    return np.sort(np.unique(key, return_index=True)[1]).astype(np.int64)


def robust_weights(
    residuals_m: Float64[np.ndarray, " n"], scale_m: float
) -> Float64[np.ndarray, " n"]:
    """Return weights of iteratively reweighted least squares for Cauchy's loss.

    The loss is scale^2 / 2 log(1 + (r / scale)^2); the weight is its derivative divided by r.
    """
    return 1.0 / (1.0 + np.square(residuals_m / scale_m))


def is_sampled(
    sweep: Int64[np.ndarray, " n"], count: int, rng: np.random.Generator
) -> Bool[np.ndarray, " n"]:
    """Select at most `count` random rows of every sweep."""
    chosen = np.zeros(len(sweep), dtype=bool)
    for index in np.unique(sweep):
        members = np.flatnonzero(sweep == index)
        chosen[rng.permutation(members)[:count]] = True
    return chosen
