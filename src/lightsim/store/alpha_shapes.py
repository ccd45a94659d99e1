"""Conversion of transparent surfaces to opaque ones: holes where alpha is low, dark glass between.

The renderers support opaque surfaces only. A masked surface is cut along its contour, so that light
and shadow rays pass through its holes. A pane becomes dark glass like the built-in cars' windows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from lightsim.core.mesh import CAR_GLASS_COLOUR
from lightsim.store.subdivide import Choice, edges_of

# Least alpha of a blended surface that becomes opaque: it hides at least three quarters of the
# background, so its own colour approximates it better than dark glass does. Chosen; sensitivity not
# measured.
OPAQUE_ALPHA = 0.75
# Largest alpha of a blended surface that is omitted: it changes a pixel by at most 5 of 255 codes.
INVISIBLE_ALPHA = 0.02
# Alpha of the contour along which blended surfaces with holes, such as foliage, are cut. It is the
# middle of the range, and the default cutoff of masks in glTF 2.0 (section 3.9.4).
BLEND_CUTOFF = 0.5
# Least alpha of a pane of glass; lower values occur at the soft edges of cut-outs. Chosen;
# sensitivity not measured.
_PANE_ALPHA = 0.1
# Largest difference of alpha within a face of a pane; at the edge of a cut-out it is larger.
# Chosen; sensitivity not measured.
_PANE_RANGE = 0.15
# Least fraction of a surface's visible area that panes must have; the soft edges of a cut-out have
# less. Chosen; sensitivity not measured.
_PANE_FRACTION = 0.05
# Positions along an edge, as fractions of its length, at which alpha is compared with the cutoff.
# Holes as wide as an eighth of an edge are found.
_EDGE_SAMPLES = np.linspace(0.0, 1.0, 9)
# Number of edges whose alpha is sampled in one array operation; it bounds memory to some 100 MB.
_CHUNK = 1 << 17
# Barycentric coordinates of the centres of the 16 equal triangles that a triangle divides into.
_INNER = (
    np.array(
        [(3 * i + 1, 3 * j + 1, 10 - 3 * i - 3 * j) for i in range(4) for j in range(4 - i)]
        + [(3 * i + 2, 3 * j + 2, 8 - 3 * i - 3 * j) for i in range(3) for j in range(3 - i)]
    )
    / 12.0
)
# Function that returns the alpha of vertices, given their values.
Alpha = Callable[[Float64[np.ndarray, "k c"]], Float64[np.ndarray, " k"]]


@dataclass(frozen=True, eq=False)
class Patch:
    """Triangles with interpolated values; the first three columns are positions."""

    values: Float64[np.ndarray, "n c"]
    faces: Int32[np.ndarray, "m 3"]


def near_contour(alpha: Alpha, cutoff: float, coarse: float, fine: float) -> Choice:
    """Return a function that selects the edges to split: all edges longer than `coarse`, and edges
    longer than `fine` in faces that the alpha contour crosses.

    A contour crosses a face if alpha passes the cutoff along an edge, or if the face's centre and a
    corner lie on different sides of it.
    """

    def is_split(
        ends: Float64[np.ndarray, "k 2 c"], edges: Int64[np.ndarray, "m 3"]
    ) -> Bool[np.ndarray, " k"]:
        length = np.linalg.norm(ends[:, 0, :3] - ends[:, 1, :3], axis=1)
        is_crossed = np.zeros(len(ends), bool)
        long_edges = np.flatnonzero(length > fine)
        for start in range(0, len(long_edges), _CHUNK):
            part = long_edges[start : start + _CHUNK]
            along = ends[part, :1] + _EDGE_SAMPLES[:, None] * (ends[part, 1:] - ends[part, :1])
            values = alpha(along.reshape(-1, ends.shape[2])).reshape(-1, len(_EDGE_SAMPLES))
            is_crossed[part] = (values.min(axis=1) < cutoff) & (values.max(axis=1) >= cutoff)
        long_faces = edges[(length[edges] > fine).any(axis=1)]
        # A hole may lie within a face without touching its edges: compare its centre with a corner.
        is_apart = ~is_crossed[long_faces].any(axis=1)
        apart = long_faces[is_apart]
        middles = ends.mean(axis=1)[apart].mean(axis=1)
        is_hole = (alpha(middles) >= cutoff) != (alpha(ends[apart[:, 0], 0]) >= cutoff)
        # Select all edges of a face: splitting only some of them again and again makes slivers.
        is_near = np.zeros(len(ends), bool)
        is_near[long_faces[~is_apart]] = True
        is_near[apart[is_hole]] = True
        return (length > coarse) | (is_near & (length > fine))

    return is_split


def cut(patch: Patch, alpha: Float64[np.ndarray, " n"], cutoff: float) -> Patch:
    """Return the part of a patch whose alpha is at least the cutoff.

    Triangles that the contour crosses are cut along it; alpha is linear within a triangle.
    Triangles with a common edge are cut at the same point of this edge. Faces without area are
    removed.
    """
    is_in = alpha[patch.faces] >= cutoff
    count = is_in.sum(axis=1)
    keys, edge_of_corner = edges_of(patch.faces, len(patch.values))
    a, b = alpha[keys[:, 0]], alpha[keys[:, 1]]
    is_crossed = (a >= cutoff) != (b >= cutoff)
    # Vertex number of the cut point of each crossed edge; the numbers of other edges are unused.
    point = len(patch.values) + np.cumsum(is_crossed) - 1
    part = ((cutoff - a) / np.where(is_crossed, b - a, 1.0))[is_crossed, None]
    low, high = patch.values[keys[is_crossed, 0]], patch.values[keys[is_crossed, 1]]
    values = np.concatenate([patch.values, low + np.clip(part, 0.0, 1.0) * (high - low)])
    on_edge = point[edge_of_corner].reshape(-1, 3).astype(np.int32)
    faces = [patch.faces[count == 3]]
    # Rotate the corners so that the one on the other side of the contour comes first.
    odd = np.where(count == 1, is_in.argmax(axis=1), (~is_in).argmax(axis=1))
    order = (np.arange(3)[None, :] + odd[:, None]) % 3
    v0, v1, v2 = np.take_along_axis(patch.faces, order, axis=1).T
    e01, _, e20 = np.take_along_axis(on_edge, order, axis=1).T
    one, two = count == 1, count == 2
    faces.append(np.stack([v0, e01, e20], axis=1)[one])
    faces.append(np.stack([e01, v1, v2], axis=1)[two])
    faces.append(np.stack([e01, v2, e20], axis=1)[two])
    whole = Patch(values, np.concatenate(faces).astype(np.int32))
    # A vertex exactly on the contour is its own cut point, which makes triangles without area.
    return chosen(whole, areas(whole) > 0)


def shrink_unresolved(
    patch: Patch, alpha: Alpha, cutoff: float, fine: float
) -> tuple[Patch, Patch]:
    """Return the faces that resolve the contour, and the other faces, shrunk to their visible area.

    It approximates surfaces whose contour would need more faces than the limit: a shrunk face
    retains its centre and lets as much light through as its holes do. Its other values are equal to
    the values at one visible point, so that its colour is a visible colour.

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
    fraction = is_visible.mean(axis=1)
    is_even = (is_in.all(axis=1) & (fraction == 1)) | (~is_in.any(axis=1) & (fraction == 0))
    is_shrunk = is_long & ~is_even
    visible = is_shrunk & (fraction > 0)
    values = patch.values[patch.faces[visible]]
    middle = values[:, :, :3].mean(axis=1, keepdims=True)
    # Area grows with the square of the edges.
    scale = np.sqrt(fraction[visible])[:, None, None]
    first = _INNER[is_visible[visible].argmax(axis=1)]
    shrunk = np.repeat(np.einsum("mc,mcv->mv", first, values)[:, None], 3, axis=1)
    shrunk[:, :, :3] = middle + scale * (values[:, :, :3] - middle)
    faces = np.arange(3 * len(shrunk), dtype=np.int32).reshape(-1, 3)
    return chosen(patch, ~is_shrunk), Patch(shrunk.reshape(-1, patch.values.shape[1]), faces)


def panes(patch: Patch, alpha: Float64[np.ndarray, " n"]) -> Bool[np.ndarray, " m"]:
    """Return which faces of a blended surface are panes of glass.

    The alpha of a pane is between invisible and opaque and nearly constant, unlike at the edge of a
    cut-out. All are False if only a small part of the surface has such an alpha.
    """
    corners = alpha[patch.faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    is_pane = (low >= _PANE_ALPHA) & (high < OPAQUE_ALPHA) & (high - low <= _PANE_RANGE)
    area = areas(patch)
    visible = area[high >= _PANE_ALPHA].sum()
    return is_pane & bool(area[is_pane].sum() > _PANE_FRACTION * visible)


def areas(patch: Patch) -> Float64[np.ndarray, " m"]:
    """Return the area of each face."""
    a, b, c = (patch.values[patch.faces[:, i], :3] for i in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def chosen(patch: Patch, is_chosen: Bool[np.ndarray, " m"]) -> Patch:
    """Return the chosen faces of a patch with the vertices that they use."""
    return _compact(Patch(patch.values, patch.faces[is_chosen]))


def glass_colour(
    colour: Float32[np.ndarray, "n 3"], alpha: Float64[np.ndarray, " n"] | float
) -> Float32[np.ndarray, "n 3"]:
    """Return the colour of panes: dark glass, tinted where the surface's own colour is not grey.

    The weight of the own colour is its saturation times alpha: a clear or grey pane becomes dark
    glass, a tail lamp of red glass remains red.
    """
    dark = np.array(CAR_GLASS_COLOUR)
    high = colour.max(axis=1, keepdims=True)
    saturation = (high - colour.min(axis=1, keepdims=True)) / np.maximum(high, 1e-6)
    weight = saturation * np.broadcast_to(alpha, len(colour))[:, None]
    return (dark + weight * (colour - dark)).astype(np.float32)


def _compact(patch: Patch) -> Patch:
    """Remove the vertices that no face uses."""
    used, faces = np.unique(patch.faces, return_inverse=True)
    return Patch(patch.values[used], faces.reshape(-1, 3).astype(np.int32))
