"""Filling of holes in regular grids."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import laplacian
from scipy.sparse.linalg import spsolve


def nearest_known(
    values: Float[np.ndarray, "nx ny *c"], is_known: Bool[np.ndarray, "nx ny"]
) -> Float[np.ndarray, "nx ny *c"]:
    """Fill unknown cells with the value of the nearest known cell."""
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
    # The Laplacian of the graph of neighbours: cells at the border have no neighbour beyond it,
    # which is the condition of a zero derivative there (mirrored borders).
    index = np.arange(values.size).reshape(values.shape)
    i = np.concatenate([index[:-1].ravel(), index[:, :-1].ravel()])
    j = np.concatenate([index[1:].ravel(), index[:, 1:].ravel()])
    grid = csr_matrix((np.ones(2 * len(i)), (np.append(i, j), np.append(j, i))))
    rows = csr_matrix(laplacian(grid))[unknown]
    result = values.copy().ravel()
    result[unknown] = 0.0
    # A direct solution is exact; conjugate gradients took 5 times as long on 400 x 400 cells and
    # left an error of 3.9 cm (docs/decisions/0007-libraries.md).
    result[unknown] = spsolve(rows[:, unknown].tocsc(), -(rows @ result))
    return result.reshape(values.shape)
