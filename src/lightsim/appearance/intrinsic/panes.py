"""Base colours of panes: mostly dark, since most of what is seen in them is reflected."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64
from scipy.sparse.csgraph import connected_components

from lightsim.core.adjacency import adjacency
from lightsim.core.mesh import MIRROR_ROUGHNESS, TriMesh

# Of what was seen in panes: little of it is light that others reflect.
PANE_PERCENTILE = 20


def pane_vertices(mesh: TriMesh) -> Bool[np.ndarray, " n"]:
    """Vertices whose faces are all panes."""
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
    """One dark colour for each pane: the percentile of what was seen in it, or in all panes where
    nothing was seen of it; the given colours elsewhere.

    Args:
        is_pane: vertices (`pane_vertices`).
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
