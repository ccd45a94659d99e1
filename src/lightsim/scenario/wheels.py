"""Detection of the wheels of CAD vehicles by shape, since names of parts differ between files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

from lightsim.core.mesh import TriMesh
from lightsim.core.twin import ActorAsset, Wheel

# Thresholds without a reason beside them were chosen; their sensitivity was not measured.

# Vertices closer than this are merged, in metres: files split vertices along creases.
_SAME_M = 1e-4
# Largest deviation of a wheel's silhouette from a circle, as a fraction of its diameter: tyres of
# CAD files have at least 16 corners, and cos(pi / 16) = 0.98.
_ROUND = 0.04
# Largest distance of a wheel from the ground, as a fraction of its diameter.
_ON_GROUND = 0.1
# Rotation by 45 degrees about the y axis.
_TURN = np.array([[1, 0, 1], [0, np.sqrt(2), 0], [-1, 0, 1]]) / np.sqrt(2)
# Smallest and largest diameter, as fractions of the vehicle's height: trucks, and low cars.
_SIZES = (0.12, 0.6)
# Largest difference in place and size within a pair, as a fraction of the diameter.
_PAIRED = 0.15
# Largest number of round parts that are compared in pairs; trucks with all nuts have some hundreds.
_MAX_ROUND = 1000


def with_wheels(asset: ActorAsset) -> ActorAsset:
    """Return the asset with the wheels that are separate parts of its mesh.

    A wheel is a round part that touches the ground, with another one on the vehicle's other side;
    parts inside it (rims, nuts) turn with it. A mesh of fewer than two pairs has no wheels.
    """
    return replace(asset, wheels=find_wheels(asset.mesh))


def find_wheels(mesh: TriMesh) -> tuple[Wheel, ...]:
    """Return the wheels of a vehicle's mesh in frame `actor`; none without two pairs."""
    vertices = mesh.vertices.astype(np.float64)
    return wheels_among(vertices, part_of_vertex(vertices, mesh.faces))


def wheels_among(
    vertices: Float64[np.ndarray, "n 3"], part: Int64[np.ndarray, " n"]
) -> tuple[Wheel, ...]:
    """Return the wheels of a vehicle whose length is along x and whose height is along z.

    Args:
        vertices: corners of the vehicle, in any unit; its middle is at y = 0.
        part: connected part of each vertex, as `part_of_vertex` returns it.
    """
    low, high = _bounds(vertices, part)
    centre, size = (low + high) / 2, high - low
    turned = np.subtract(*reversed(_bounds(vertices @ _TURN.T, part)))
    widths = np.concatenate([size[:, [0, 2]], turned[:, [0, 2]]], axis=1)
    diameter = widths.max(axis=1)
    ground, height = vertices[:, 2].min(), np.ptp(vertices[:, 2])
    is_wheel = np.ptp(widths, axis=1) <= _ROUND * diameter
    is_wheel &= low[:, 2] - ground <= _ON_GROUND * diameter
    is_wheel &= (diameter >= _SIZES[0] * height) & (diameter <= _SIZES[1] * height)
    is_wheel &= size[:, 1] <= diameter
    chosen = np.flatnonzero(is_wheel)
    chosen = np.sort(chosen[np.argsort(-diameter[chosen], kind="stable")[:_MAX_ROUND]])
    chosen = chosen[_has_partner(centre[chosen], diameter[chosen])]
    wheels: list[Wheel] = []
    is_taken = np.zeros(len(vertices), bool)
    # The largest first: parts inside a wheel turn with it and are no wheels of their own.
    for n in chosen[np.argsort(-diameter[chosen], kind="stable")]:
        wheel = _wheel(vertices, part, centre[n], size[n])
        if not is_taken[wheel.vertices].any():
            wheels.append(wheel)
            is_taken[wheel.vertices] = True
    return tuple(wheels) if len(wheels) >= 4 else ()


def _bounds(
    vertices: Float64[np.ndarray, "n 3"], part: Int64[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, "p 3"], Float64[np.ndarray, "p 3"]]:
    """Return the lowest and highest coordinates of each part."""
    low, high = (np.full((int(part.max()) + 1, 3), end) for end in (np.inf, -np.inf))
    np.minimum.at(low, part, vertices)
    np.maximum.at(high, part, vertices)
    return low, high


def part_of_vertex(
    vertices: Float64[np.ndarray, "n 3"], faces: Int32[np.ndarray, "m 3"]
) -> Int64[np.ndarray, " n"]:
    """Return the number of the connected part of each vertex; vertices are in metres."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    cells = np.round(vertices / _SAME_M).astype(np.int64)
    same = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    corners = same[faces]
    start, end = corners[:, :2].ravel(), corners[:, 1:].ravel()
    size = int(same.max()) + 1
    graph = coo_array((np.ones(len(start), bool), (start, end)), shape=(size, size))
    return connected_components(graph, directed=False)[1][same].astype(np.int64)


def _has_partner(
    centre: Float64[np.ndarray, "k 3"], diameter: Float64[np.ndarray, " k"]
) -> Bool[np.ndarray, " k"]:
    """Return the wheels with a counterpart of the same size on the other side of the vehicle."""
    across = centre * [1, -1, 1]
    apart = np.abs(centre[:, None] - across).max(axis=2)
    differs = np.abs(diameter[:, None] - diameter)
    is_like = np.maximum(apart, differs) <= _PAIRED * diameter
    np.fill_diagonal(is_like, False)
    return np.any(is_like, axis=1)


def _wheel(
    vertices: Float64[np.ndarray, "n 3"],
    part: Int64[np.ndarray, " n"],
    centre: Float64[np.ndarray, "3"],
    size: Float64[np.ndarray, "3"],
) -> Wheel:
    """Return a wheel with all parts in its cylinder; hubs may protrude by half of its width."""
    radius_m = float(max(size[0], size[2]) / 2)
    x, y, z = (vertices - centre).T
    is_outside = (np.hypot(x, z) > radius_m * (1 + _ROUND)) | (np.abs(y) > size[1])
    outside = np.bincount(part, is_outside) > 0
    return Wheel(np.flatnonzero(~outside[part]), centre, radius_m)
