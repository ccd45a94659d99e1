"""Colours of vertices that no image saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.sparse import csr_matrix, diags

from lightsim.core.adjacency import adjacency
from lightsim.core.mesh import TriMesh

_FACING_POWER = 16.0
"""At an edge of 90 degrees the vertices on it are turned by half of that."""
_AROUND_CORNERS = 1e-3
"""Of what passes between two vertices that face the same way."""
_ANCHOR = 1e-6
_TOLERANCE, _ROUNDS = 1e-4, 1000


def colour_of_nearest(mesh: TriMesh, coloured: TriMesh) -> TriMesh:
    """A mesh that no image shows, with the colours of the nearest vertices of another."""
    from scipy.spatial import KDTree

    if len(mesh.vertices) == 0 or len(coloured.vertices) == 0:
        return mesh
    _, index = KDTree(coloured.vertices).query(mesh.vertices)
    return replace(mesh, base_colour=coloured.base_colour[index])


def fill_unseen(
    mesh: TriMesh,
    colour: Float[np.ndarray, "n 3"],
    is_known: Bool[np.ndarray, " n"],
    usual: Float[np.ndarray, "3"],
) -> Float64[np.ndarray, "n 3"]:
    """The smoothest colours along the surface that agree with the known ones (discrete harmonic);
    hardly any passes around corners, where another material begins.

    Args:
        usual: colour where the mesh has no known vertex at all.
    """
    from scipy.sparse.linalg import cg
    from scipy.spatial import KDTree

    if not is_known.any():
        return np.tile(usual.astype(np.float64), (len(colour), 1))
    result = colour.astype(np.float64)
    unknown, known = np.flatnonzero(~is_known), np.flatnonzero(is_known)
    if len(unknown) == 0:
        return result
    # What is connected to nothing known takes the colour of the nearest that is.
    _, nearest = KDTree(mesh.vertices[known]).query(mesh.vertices[unknown])
    near = result[known[nearest]]
    smoothness = _smoothness(mesh)[unknown]
    degree = np.asarray(smoothness.sum(axis=1)).ravel() + _ANCHOR
    system = diags(degree) - smoothness[:, unknown]
    wanted = smoothness[:, known] @ result[known] + _ANCHOR * near
    inverse = diags(1.0 / degree)
    for channel in range(3):
        smooth, _ = cg(
            system,
            wanted[:, channel],
            x0=near[:, channel],
            rtol=_TOLERANCE,
            maxiter=_ROUNDS,
            M=inverse,
        )
        # A harmonic keeps between its known values; iterates need not.
        ends = result[known, channel].min(), result[known, channel].max()
        result[unknown, channel] = np.clip(smooth, *ends)
    return result


def _smoothness(mesh: TriMesh) -> csr_matrix:
    """How alike the colours of vertices are that share an edge: by its length, and by how alike
    the surface faces at both ends."""
    pairs = adjacency(mesh.faces, len(mesh.vertices)).tocoo()
    i, j = pairs.row, pairs.col
    normals = mesh.vertex_normals().astype(np.float64)
    facing = np.clip(np.einsum("ec,ec->e", normals[i], normals[j]), 0.0, 1.0)
    length_m = np.linalg.norm(mesh.vertices[i] - mesh.vertices[j], axis=1)
    weight = (facing**_FACING_POWER + _AROUND_CORNERS) / np.maximum(length_m, 1e-3)
    return csr_matrix((weight, (i, j)), shape=pairs.shape)
