"""Colours of vertices that no image saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.sparse import diags

from lightsim.core.adjacency import adjacency
from lightsim.core.mesh import TriMesh

_NEIGHBOURS = 6
_SPREAD_ROUNDS = 30


def colour_of_nearest(mesh: TriMesh, coloured: TriMesh) -> TriMesh:
    """A mesh that no image shows, with the colours of the nearest vertices of another."""
    from scipy.spatial import KDTree

    if len(mesh.vertices) == 0 or len(coloured.vertices) == 0:
        return mesh
    _, index = KDTree(coloured.vertices).query(mesh.vertices)
    return replace(mesh, base_colour=coloured.base_colour[index])


def fill_unseen(
    mesh: TriMesh,
    colour: Float32[np.ndarray, "n 3"],
    is_known: Bool[np.ndarray, " n"],
    usual: Float32[np.ndarray, "3"],
) -> Float32[np.ndarray, "n 3"]:
    """Colours diffused along the surface; `usual` where a mesh has no known vertex at all."""
    from scipy.spatial import KDTree

    if is_known.all():
        return colour
    if not is_known.any():
        return np.broadcast_to(usual, colour.shape).copy()
    result = colour.astype(np.float64)
    unknown = np.flatnonzero(~is_known)
    known = np.flatnonzero(is_known)
    k = min(_NEIGHBOURS, len(known))
    distance, index = KDTree(mesh.vertices[known]).query(mesh.vertices[unknown], k=k)
    distance, index = distance.reshape(len(unknown), k), index.reshape(len(unknown), k)
    fraction = 1.0 / np.maximum(distance, 1e-3) ** 2
    fraction /= fraction.sum(axis=1, keepdims=True)
    result[unknown] = (fraction[:, :, None] * result[known][index]).sum(axis=1)
    return _relax(mesh, result, unknown).astype(np.float32)


def _relax(
    mesh: TriMesh, colour: Float64[np.ndarray, "n 3"], free: np.ndarray
) -> Float64[np.ndarray, "n 3"]:
    neighbours = adjacency(mesh.faces, len(mesh.vertices))[free]
    degree = np.asarray(neighbours.sum(axis=1)).ravel()
    mean = diags(1.0 / np.maximum(degree, 1.0)) @ neighbours
    has_neighbours = degree > 0
    for _ in range(_SPREAD_ROUNDS):
        spread = mean @ colour
        colour[free[has_neighbours]] = spread[has_neighbours]
    return colour
