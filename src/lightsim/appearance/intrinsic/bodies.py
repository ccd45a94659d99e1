"""Colours of a vehicle where no camera saw it: its other half's, part by part."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from lightsim.core.mesh import TriMesh

_NEIGHBOURS = 6
_REACH_M = 0.5
"""Further from all that was seen, a part has one colour: the median of what was seen of it."""


def colours_of_unseen(
    mesh: TriMesh, colour: Float64[np.ndarray, "n 3"], is_seen: Bool[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3"]:
    """Base colours of a body that is its own mirror image about y = 0, frame `actor`.

    Vertices that were not seen take the colour of what was seen nearest on the same part (paint,
    panes, tyres), or on its mirror image; a part of which nothing was seen keeps its colour.
    """
    from scipy.spatial import KDTree

    result = colour.copy()
    part = _part_of_vertices(mesh)
    for number in np.unique(part):
        seen = np.flatnonzero((part == number) & is_seen)
        unseen = np.flatnonzero((part == number) & ~is_seen)
        if len(seen) == 0 or len(unseen) == 0:
            continue
        points = mesh.vertices[seen].astype(np.float64)
        both = np.concatenate([points, points * np.array([1.0, -1.0, 1.0])])
        found = np.concatenate([colour[seen], colour[seen]])
        k = min(_NEIGHBOURS, len(both))
        distance, index = KDTree(both).query(mesh.vertices[unseen], k=k)
        distance, index = distance.reshape(len(unseen), k), index.reshape(len(unseen), k)
        fraction = 1.0 / np.maximum(distance, 0.02) ** 2
        near = (fraction[..., None] * found[index]).sum(axis=1) / fraction.sum(axis=1)[:, None]
        trust = np.exp(-np.square(distance[:, :1] / _REACH_M))
        result[unseen] = trust * near + (1 - trust) * np.median(colour[seen], axis=0)
    return result


def _part_of_vertices(mesh: TriMesh) -> UInt8[np.ndarray, " n"]:
    """Of each vertex, the highest material index among its faces."""
    part = np.zeros(len(mesh.vertices), dtype=np.uint8)
    if mesh.face_material is not None:
        for corner in mesh.faces.T:
            np.maximum.at(part, corner, mesh.face_material)
    return part
