"""Vertex colours from samples: gains divided out, outliers left out, gaps filled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.sparse import diags

from lightsim.assets.colour_kernels import robust_means
from lightsim.assets.observe import Samples
from lightsim.assets.surface import adjacency
from lightsim.core.mesh import TriMesh

_NEIGHBOURS = 6
_SPREAD_ROUNDS = 30
_UNSEEN = 0.2


def mean_radiance(
    samples: Samples, gains: Float32[np.ndarray, "c 3"], outlier_ratio: float
) -> tuple[Float32[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Mean observed radiance of every vertex, and whether any image saw it."""
    means = np.zeros((len(samples.weights), 3))
    total = np.zeros(len(samples.weights))
    robust_means(
        samples.colours,
        samples.weights,
        samples.cameras,
        1.0 / gains.astype(np.float64),
        outlier_ratio,
        means,
        total,
    )
    return means.astype(np.float32), total > 0


def paint(
    meshes: Sequence[TriMesh],
    radiance: Float32[np.ndarray, "n 3"],
    is_seen: Bool[np.ndarray, " n"],
) -> list[TriMesh]:
    """The meshes with their share of the table as base colour; unseen vertices take the colour
    of their neighbours on the surface, then of the nearest seen vertices."""
    painted, first = [], 0
    usual = np.median(radiance[is_seen], axis=0) if is_seen.any() else np.full(3, _UNSEEN)
    for mesh in meshes:
        part = slice(first, first + len(mesh.vertices))
        first = part.stop
        colour = fill_unseen(mesh, radiance[part], is_seen[part], usual.astype(np.float32))
        painted.append(replace(mesh, base_colour=colour))
    return painted


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
    share = 1.0 / np.maximum(distance, 1e-3) ** 2
    share /= share.sum(axis=1, keepdims=True)
    result[unknown] = (share[:, :, None] * result[known][index]).sum(axis=1)
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
