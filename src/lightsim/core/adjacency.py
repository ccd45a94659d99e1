"""Adjacency of mesh vertices."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int32
from scipy.sparse import coo_matrix, csr_matrix


def adjacency(faces: Int32[np.ndarray, "m 3"], count: int) -> csr_matrix:
    """Return the symmetric matrix that is 1 for two vertices joined by an edge, else 0."""
    i = np.concatenate([faces[:, 0], faces[:, 1], faces[:, 2]])
    j = np.concatenate([faces[:, 1], faces[:, 2], faces[:, 0]])
    matrix = coo_matrix((np.ones(len(i), dtype=np.float32), (i, j)), shape=(count, count)).tocsr()
    # Inner edges occur in two faces, once in each direction, edges of a border once: entries sum
    # to 1 or 2 and are set to 1.
    matrix = matrix + matrix.T
    matrix.data[:] = 1.0
    return matrix
