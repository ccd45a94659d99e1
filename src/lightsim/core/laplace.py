"""Holes in regular grids closed smoothly."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import cg


def nearest_known(
    values: Float[np.ndarray, "nx ny"], is_known: Bool[np.ndarray, "nx ny"]
) -> Float[np.ndarray, "nx ny"]:
    """Each cell's value, or that of the nearest cell that has one."""
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
    start = nearest_known(values, is_known)
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
