"""Colours of unobserved vertices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.sparse import csr_matrix, diags

from lightsim.core.adjacency import adjacency
from lightsim.core.mesh import TriMesh

# Exponent on the cosine between the normals of two neighbours. Across an edge of 90 degrees the
# averaged vertex normals differ by 45 degrees, where the weight is 0.004. Chosen by inspection.
_FACING_POWER = 16.0
# Minimum weight between neighbours, relative to two vertices with equal normals, so that surface
# enclosed by sharp edges receives a colour. Chosen by inspection; sensitivity not measured.
_AROUND_CORNERS = 1e-3
# Weight of the nearest known colour: makes the system regular on components without a known vertex
# and is negligible elsewhere.
_ANCHOR = 1e-6
# Most iterations of the conjugate gradient solver; an unconverged result is still usable.
_MAX_ITERATIONS = 1000


def colour_of_nearest(mesh: TriMesh, coloured: TriMesh) -> TriMesh:
    """Return a mesh that no image shows with the colours of the nearest vertices of another."""
    from scipy.spatial import KDTree

    if len(mesh.vertices) == 0 or len(coloured.vertices) == 0:
        return mesh
    _, index = KDTree(coloured.vertices).query(mesh.vertices)
    return replace(mesh, base_colour=coloured.base_colour[index])


def fill_unseen(
    mesh: TriMesh,
    colour: Float[np.ndarray, "n 3"],
    is_known: Bool[np.ndarray, " n"],
    default_colour: Float[np.ndarray, "3"],
) -> Float64[np.ndarray, "n 3"]:
    """Return linear RGB of every vertex, interpolated harmonically along the surface.

    Known colours are unchanged. The edge weights are small around corners, where the material often
    changes.

    Args:
        default_colour: colour of all vertices if the mesh has no known vertex.
    """
    from scipy.sparse.linalg import cg
    from scipy.spatial import KDTree

    if not is_known.any():
        return np.tile(default_colour.astype(np.float64), (len(colour), 1))
    result = colour.astype(np.float64)
    unknown, known = np.flatnonzero(~is_known), np.flatnonzero(is_known)
    if len(unknown) == 0:
        return result
    # Components without a known vertex converge to the nearest known colour through `_ANCHOR`.
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
            rtol=1e-4,
            maxiter=_MAX_ITERATIONS,
            M=inverse,
        )
        # A harmonic function is bounded by its known values; unconverged iterates may exceed them.
        ends = result[known, channel].min(), result[known, channel].max()
        result[unknown, channel] = np.clip(smooth, *ends)
    return result


def _smoothness(mesh: TriMesh) -> csr_matrix:
    """Edge weights: a power of the cosine between the end normals, over the length of the edge."""
    pairs = adjacency(mesh.faces, len(mesh.vertices)).tocoo()
    i, j = pairs.row, pairs.col
    normals = mesh.vertex_normals().astype(np.float64)
    facing = np.clip(np.einsum("ec,ec->e", normals[i], normals[j]), 0.0, 1.0)
    length_m = np.linalg.norm(mesh.vertices[i] - mesh.vertices[j], axis=1)
    weight = (facing**_FACING_POWER + _AROUND_CORNERS) / np.maximum(length_m, 1e-3)
    return csr_matrix((weight, (i, j)), shape=pairs.shape)
