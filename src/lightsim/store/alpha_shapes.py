"""Transparent surfaces as shapes: holes where alpha is low, dark glass where it is in between.

Renderers have opaque surfaces only. A masked surface is cut along its contour, so that light and
shadow rays pass through its holes. A pane becomes dark glass like those of the built-in cars.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from lightsim.core.mesh import CAR_GLASS_COLOUR
from lightsim.store.subdivide import Choice, edges_of

OPAQUE_ALPHA = 0.75
"""From this alpha on a blended surface hides more than three quarters of what is behind it: its
own colour is closer to its look than dark glass is. Chosen; sensitivity not measured."""
INVISIBLE_ALPHA = 0.02
"""Up to this alpha a blended surface is left out: it changes a pixel by at most 5 of 255 steps."""
BLEND_CUTOFF = 0.5
"""Contour of blended surfaces whose alpha has edges, such as foliage and hair."""
_PANE_ALPHA = 0.1
"""Least alpha of a pane within a picture: below it is the faded edge of a cut-out."""
_PANE_RANGE = 0.15
"""Largest difference of alpha within a face of a pane; within the edge of a cut-out it is more."""
_PANE_SHARE = 0.05
"""Least fraction of the visible area that panes have; a cut-out has less at its edges."""
_EDGE_SAMPLES = np.linspace(0.0, 1.0, 9)
"""Places along an edge at which alpha is compared with the cutoff: holes of an eighth of an edge
are found."""

_CHUNK = 1 << 17
"""Edges whose alpha is sampled at once, which bounds memory."""

_INNER = (
    np.array(
        [(3 * i + 1, 3 * j + 1, 10 - 3 * i - 3 * j) for i in range(4) for j in range(4 - i)]
        + [(3 * i + 2, 3 * j + 2, 8 - 3 * i - 3 * j) for i in range(3) for j in range(3 - i)]
    )
    / 12.0
)
"""Barycentric coordinates of the middles of the 16 equal triangles that make up a triangle."""

Alpha = Callable[[Float64[np.ndarray, "k c"]], Float64[np.ndarray, " k"]]
"""Returns the alpha of vertices, given their values."""


@dataclass(frozen=True, eq=False)
class Patch:
    """Triangles with interpolated values; the first three columns are positions."""

    values: Float64[np.ndarray, "n c"]
    faces: Int32[np.ndarray, "m 3"]


def near_contour(alpha: Alpha, cutoff: float, coarse: float, fine: float) -> Choice:
    """Return the choice of edges longer than `coarse`, and longer than `fine` in faces that the
    contour crosses: along one of their edges, or between their middle and a corner."""

    def is_split(
        ends: Float64[np.ndarray, "k 2 c"], edges: Int64[np.ndarray, "m 3"]
    ) -> Bool[np.ndarray, " k"]:
        length = np.linalg.norm(ends[:, 0, :3] - ends[:, 1, :3], axis=1)
        is_crossed = np.zeros(len(ends), bool)
        asked = np.flatnonzero(length > fine)
        for start in range(0, len(asked), _CHUNK):
            part = asked[start : start + _CHUNK]
            along = ends[part, :1] + _EDGE_SAMPLES[:, None] * (ends[part, 1:] - ends[part, :1])
            values = alpha(along.reshape(-1, ends.shape[2])).reshape(-1, len(_EDGE_SAMPLES))
            is_crossed[part] = (values.min(axis=1) < cutoff) & (values.max(axis=1) >= cutoff)
        long_faces = edges[(length[edges] > fine).any(axis=1)]
        is_apart = ~is_crossed[long_faces].any(axis=1)
        apart = long_faces[is_apart]
        middles = ends.mean(axis=1)[apart].mean(axis=1)
        is_hole = (alpha(middles) >= cutoff) != (alpha(ends[apart[:, 0], 0]) >= cutoff)
        # All edges of a face, or it would become a sliver.
        is_near = np.zeros(len(ends), bool)
        is_near[long_faces[~is_apart]] = True
        is_near[apart[is_hole]] = True
        return (length > coarse) | (is_near & (length > fine))

    return is_split


def cut(patch: Patch, alpha: Float64[np.ndarray, " n"], cutoff: float) -> Patch:
    """Return the part of a patch whose alpha is at least the cutoff.

    Triangles that the contour crosses are cut along it; alpha is linear within a triangle.
    Triangles with a common edge are cut at the same point of it. Faces without area are left out.
    """
    is_in = alpha[patch.faces] >= cutoff
    count = is_in.sum(axis=1)
    keys, edge_of_corner = edges_of(patch.faces, len(patch.values))
    a, b = alpha[keys[:, 0]], alpha[keys[:, 1]]
    is_crossed = (a >= cutoff) != (b >= cutoff)
    # Edges that are not crossed have no point; their number is never used.
    point = len(patch.values) + np.cumsum(is_crossed) - 1
    part = ((cutoff - a) / np.where(is_crossed, b - a, 1.0))[is_crossed, None]
    low, high = patch.values[keys[is_crossed, 0]], patch.values[keys[is_crossed, 1]]
    values = np.concatenate([patch.values, low + np.clip(part, 0.0, 1.0) * (high - low)])
    on_edge = point[edge_of_corner].reshape(-1, 3).astype(np.int32)
    faces = [patch.faces[count == 3]]
    # Turned so that the corner which differs from the others comes first.
    odd = np.where(count == 1, is_in.argmax(axis=1), (~is_in).argmax(axis=1))
    order = (np.arange(3)[None, :] + odd[:, None]) % 3
    v0, v1, v2 = np.take_along_axis(patch.faces, order, axis=1).T
    e01, _, e20 = np.take_along_axis(on_edge, order, axis=1).T
    one, two = count == 1, count == 2
    faces.append(np.stack([v0, e01, e20], axis=1)[one])
    faces.append(np.stack([e01, v1, v2], axis=1)[two])
    faces.append(np.stack([e01, v2, e20], axis=1)[two])
    whole = Patch(values, np.concatenate(faces).astype(np.int32))
    # Where a vertex lies on the contour, its point on an edge is the vertex itself.
    return chosen(whole, areas(whole) > 0)


def shrink_unresolved(
    patch: Patch, alpha: Alpha, cutoff: float, fine: float
) -> tuple[Patch, Patch]:
    """Return the faces whose contour the vertices show, and the others, shrunk to their visible
    area.

    For a surface that has more contours than faces may be: a shrunk face keeps its middle, and lets
    as much light through as its holes do. Its other values are those of a visible point, so that it
    has a visible colour.

    Args:
        fine: faces without a longer edge count as resolved.
    """
    is_in = alpha(patch.values)[patch.faces] >= cutoff
    corners = patch.values[patch.faces, :3]
    is_long = (np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2) > fine).any(axis=1)
    is_visible = np.empty((len(patch.faces), len(_INNER)), bool)
    for start in range(0, len(patch.faces), _CHUNK // len(_INNER)):
        part = slice(start, start + _CHUNK // len(_INNER))
        points = np.einsum("kc,mcv->mkv", _INNER, patch.values[patch.faces[part]])
        at_point = alpha(points.reshape(-1, patch.values.shape[1]))
        is_visible[part] = at_point.reshape(-1, len(_INNER)) >= cutoff
    share = is_visible.mean(axis=1)
    is_even = (is_in.all(axis=1) & (share == 1)) | (~is_in.any(axis=1) & (share == 0))
    is_shrunk = is_long & ~is_even
    seen = is_shrunk & (share > 0)
    values = patch.values[patch.faces[seen]]
    middle = values[:, :, :3].mean(axis=1, keepdims=True)
    scale = np.sqrt(share[seen])[:, None, None]
    first = _INNER[is_visible[seen].argmax(axis=1)]
    shrunk = np.repeat(np.einsum("mc,mcv->mv", first, values)[:, None], 3, axis=1)
    shrunk[:, :, :3] = middle + scale * (values[:, :, :3] - middle)
    faces = np.arange(3 * len(shrunk), dtype=np.int32).reshape(-1, 3)
    return chosen(patch, ~is_shrunk), Patch(shrunk.reshape(-1, patch.values.shape[1]), faces)


def panes(patch: Patch, alpha: Float64[np.ndarray, " n"]) -> Bool[np.ndarray, " m"]:
    """Return which faces of a blended surface are panes of glass.

    Their alpha is between invisible and opaque and nearly even, unlike at the edge of a cut-out.
    All are False where only a small part of the surface is so.
    """
    corners = alpha[patch.faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    is_pane = (low >= _PANE_ALPHA) & (high < OPAQUE_ALPHA) & (high - low <= _PANE_RANGE)
    area = areas(patch)
    visible = area[high >= _PANE_ALPHA].sum()
    return is_pane & bool(area[is_pane].sum() > _PANE_SHARE * visible)


def areas(patch: Patch) -> Float64[np.ndarray, " m"]:
    """Return the area of each face."""
    a, b, c = (patch.values[patch.faces[:, i], :3] for i in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def chosen(patch: Patch, is_chosen: Bool[np.ndarray, " m"]) -> Patch:
    """Return some faces of a patch, with their vertices."""
    return _compact(Patch(patch.values, patch.faces[is_chosen]))


def glass_colour(
    colour: Float32[np.ndarray, "n 3"], alpha: Float64[np.ndarray, " n"] | float
) -> Float32[np.ndarray, "n 3"]:
    """Return the colour of panes: dark glass, tinted where the surface's own colour is not grey.

    A clear or grey pane is dark glass. The more saturated a colour, the more of it stays, by its
    alpha: a tail lamp of red glass remains red.
    """
    dark = np.array(CAR_GLASS_COLOUR)
    high = colour.max(axis=1, keepdims=True)
    saturation = (high - colour.min(axis=1, keepdims=True)) / np.maximum(high, 1e-6)
    share = saturation * np.broadcast_to(alpha, len(colour))[:, None]
    return (dark + share * (colour - dark)).astype(np.float32)


def _compact(patch: Patch) -> Patch:
    """The same without vertices that no face has."""
    used, faces = np.unique(patch.faces, return_inverse=True)
    return Patch(patch.values[used], faces.reshape(-1, 3).astype(np.int32))
