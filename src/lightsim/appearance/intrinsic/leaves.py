"""Base colours of foliage, smoothed within each crown because pixels mix leaves and background."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from lightsim.core.adjacency import adjacency
from lightsim.core.foliage import foliage_faces
from lightsim.core.mesh import TriMesh

# Number of observed leaf vertices around a vertex whose median is its colour. Sensitivity not
# measured.
_NEIGHBOURS = 64
# Maximum distance of these vertices, in metres. Sensitivity not measured.
_MAX_DISTANCE_M = 2.0


def leaf_vertices(mesh: TriMesh) -> Bool[np.ndarray, " n"]:
    """Return the mask of vertices of leaf cards: pieces of foliage with at most four vertices.

    Other foliage surface is connected, and the background proxy has small pieces of other
    materials.
    """
    count, piece = connected_components(adjacency(mesh.faces, len(mesh.vertices)), directed=False)
    size = np.bincount(piece, minlength=int(count))[piece]
    is_leaf = np.zeros(len(mesh.vertices), dtype=bool)
    is_leaf[mesh.faces[foliage_faces(mesh)]] = True
    return is_leaf & (size <= 4)


def leaf_colours(
    mesh: TriMesh,
    colour: Float64[np.ndarray, "n 3"],
    is_leaf: Bool[np.ndarray, " n"],
    is_seen: Bool[np.ndarray, " n"],
) -> Float64[np.ndarray, "n 3"]:
    """Return colours in which each leaf has the median of the observed leaves around it.

    Leaves without observed leaves within reach have the median of all; other vertices retain their
    colour.

    Args:
        is_leaf: mask of vertices (`leaf_vertices`).
        is_seen: mask of observed vertices.
    """
    fill = colour.copy()
    seen = is_leaf & is_seen
    if not seen.any():
        return fill
    places, known = mesh.vertices[is_leaf], colour[seen]
    distance, index = KDTree(mesh.vertices[seen]).query(
        places, min(_NEIGHBOURS, len(known)), distance_upper_bound=_MAX_DISTANCE_M
    )
    distance, index = distance.reshape(len(places), -1), index.reshape(len(places), -1)
    is_near = np.isfinite(distance)[..., None]
    near = np.where(is_near, known[np.minimum(index, len(known) - 1)], np.nan)
    has_near = is_near.any(axis=(1, 2))
    fill[is_leaf] = np.median(known, axis=0)
    fill[np.flatnonzero(is_leaf)[has_near]] = np.nanmedian(near[has_near], axis=1)
    return fill
