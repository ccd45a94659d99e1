"""Base colours of unobserved parts of a vehicle, from its mirror image; and of its panes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from lightsim.appearance.intrinsic.panes import PANE_PERCENTILE
from lightsim.core.mesh import MIRROR_ROUGHNESS, TriMesh

# Distance in metres at which the weight of the nearest observed vertex falls to 1/e; beyond, the
# median colour of the part prevails. Chosen by inspection.
_REACH_M = 0.5


def body_colours(
    mesh: TriMesh, colour: Float64[np.ndarray, "n 3"], is_seen: Bool[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Return the base colours of a body that is symmetric about y = 0, frame `actor`.

    Unobserved vertices receive the colour of the nearest observed vertices of the same part (paint,
    panes, tyres) or of its mirror image. A part without an observed vertex retains its colour. All
    panes have one dark colour, because images of them show reflections and the interior.

    Returns:
        Linear RGB of each vertex, and the mask of vertices with a replaced colour.
    """
    from scipy.spatial import KDTree

    result, is_filled = colour.copy(), np.zeros(len(colour), dtype=bool)
    part = _part_of_vertices(mesh)
    for number in np.unique(part):
        members = part == number
        seen, unseen = np.flatnonzero(members & is_seen), np.flatnonzero(members & ~is_seen)
        if len(seen) == 0:
            continue
        if mesh.materials and mesh.materials[number].roughness < MIRROR_ROUGHNESS:
            result[members] = np.percentile(colour[seen], PANE_PERCENTILE, axis=0)
            is_filled |= members
            continue
        if len(unseen) == 0:
            continue
        points = mesh.vertices[seen].astype(np.float64)
        both = np.concatenate([points, points * np.array([1.0, -1.0, 1.0])])
        found = np.concatenate([colour[seen], colour[seen]])
        k = min(6, len(both))
        distance, index = KDTree(both).query(mesh.vertices[unseen], k=k)
        distance, index = distance.reshape(len(unseen), k), index.reshape(len(unseen), k)
        fraction = 1.0 / np.maximum(distance, 0.02) ** 2
        near = (fraction[..., None] * found[index]).sum(axis=1) / fraction.sum(axis=1)[:, None]
        near_weight = np.exp(-np.square(distance[:, :1] / _REACH_M))
        result[unseen] = near_weight * near + (1 - near_weight) * np.median(colour[seen], axis=0)
        is_filled[unseen] = True
    return result, is_filled


def _part_of_vertices(mesh: TriMesh) -> UInt8[np.ndarray, " n"]:
    """Return the lowest material index among the faces of each vertex, so that the dark colour of a
    pane is not interpolated over the large faces of paint around it."""
    if mesh.face_material is None:
        return np.zeros(len(mesh.vertices), dtype=np.uint8)
    part = np.full(len(mesh.vertices), mesh.face_material.max(initial=0), dtype=np.uint8)
    for corner in mesh.faces.T:
        np.minimum.at(part, corner, mesh.face_material)
    return part
