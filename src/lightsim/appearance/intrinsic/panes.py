"""Base colours of panes: dark, because most of their radiance is reflected."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse.csgraph import connected_components

from lightsim.core.adjacency import adjacency
from lightsim.core.mesh import MIRROR_ROUGHNESS, TriMesh

# Percentile of the colours observed on a pane that is its base colour: the darkest observations
# contain the least reflection. Chosen by inspection; sensitivity not measured.
PANE_PERCENTILE = 20


def pane_vertices(mesh: TriMesh) -> Bool[np.ndarray, " n"]:
    """Return the mask of vertices whose faces are all panes."""
    is_pane = np.zeros(len(mesh.vertices), dtype=bool)
    is_glass = mesh.face_roughness() < MIRROR_ROUGHNESS
    is_pane[mesh.faces[is_glass]] = True
    is_pane[mesh.faces[~is_glass]] = False
    return is_pane


def pane_colours(
    mesh: TriMesh,
    colour: Float64[np.ndarray, "n 3"],
    is_pane: Bool[np.ndarray, " n"],
    is_seen: Bool[np.ndarray, " n"],
) -> Float64[np.ndarray, "n 3"]:
    """Return colours in which each pane has one dark colour.

    The colour is `PANE_PERCENTILE` of the pane's observed vertices, or of all panes' if it has
    none. Other vertices retain their colour.

    Args:
        is_pane: mask of vertices (`pane_vertices`).
        is_seen: mask of observed vertices.
    """
    fill = colour.copy()
    seen = np.flatnonzero(is_pane & is_seen)
    if len(seen) == 0:
        return fill
    fill[is_pane] = np.percentile(colour[seen], PANE_PERCENTILE, axis=0)
    inside = mesh.faces[is_pane[mesh.faces].all(axis=1)]
    _, number = connected_components(adjacency(inside, len(fill)), directed=False)
    seen = seen[np.argsort(number[seen], kind="stable")]
    for rows in np.split(seen, np.flatnonzero(np.diff(number[seen])) + 1):
        own = np.percentile(colour[rows], PANE_PERCENTILE, axis=0)
        fill[is_pane & (number == number[rows[0]])] = own
    return fill
