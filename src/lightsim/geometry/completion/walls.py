"""Upright planes in a mesh, on which the missing parts of facades are completed."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Float64

from lightsim.core.buildings import Wall
from lightsim.core.casting import RayCaster
from lightsim.core.mesh import TriMesh

# Edge of a wall's cells and of the faces that are added to walls, in metres: each face has its own
# patch of texture.
WALL_CELL_M = 0.25
# Upward direction of frame world.
UP = np.array([0.0, 0.0, 1.0])

# The values below were chosen on log 002 and street 0; only their joint effect was measured
# (docs/benchmarks/reconstruction.md).


class _Limits:
    """RANSAC search for planes, and limits of the walls on them."""

    seeds = 120  # Hypotheses of each round.
    max_planes = 120  # Greatest number of planes.
    # Least cosine between the normals of a face and its plane.
    min_cosine = float(np.cos(np.radians(15.0)))
    max_normal_z = 0.25  # Greatest vertical component of a face's normal.
    thickness_m = 0.2  # Greatest distance of faces from their plane.
    min_area_m2 = 6.0  # Least measured area.
    min_width_m = 2.0  # Least width; poles and trunks are narrower.
    min_height_m = 1.8  # Least height; sides of vehicles and garden walls are lower.
    max_gap_m = 3.0  # Gap along the plane above which two walls are separate.
    min_density = 0.25  # Least measured fraction of the area that columns span; foliage has less.
    column_m = 1.0  # Width of these columns.


def find_walls(mesh: TriMesh) -> list[Wall]:
    """Find upright planes with much measured surface, greatest first.

    RANSAC with one face as hypothesis (Fischler and Bolles 1981, doi:10.1145/358669.358692):
    position and normal of a face determine an upright plane.

    Args:
        mesh: static surface, frame world.
    """
    normals = mesh.face_normals()
    is_upright = (np.abs(normals[:, 2]) < _Limits.max_normal_z) & (np.abs(normals).sum(axis=1) > 0)
    corners = mesh.vertices[mesh.faces[is_upright]].astype(np.float64)
    area = mesh.face_areas_m2()[is_upright]
    flat = normals[is_upright, :2]
    flat = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)
    centres = np.ascontiguousarray(corners[..., :2].mean(axis=1))
    rng = np.random.default_rng(0)
    is_free = area > 0
    walls: list[Wall] = []
    for _ in range(_Limits.max_planes):
        rows = np.flatnonzero(is_free)
        if len(rows) == 0 or area[rows].sum() < _Limits.min_area_m2:
            break
        best = _best_plane(centres[rows], flat[rows], area[rows], rng)
        chosen = rows[best]
        found = _pieces(centres[chosen], flat[chosen], area[chosen], corners[chosen])
        if area[chosen].sum() < _Limits.min_area_m2:
            break
        walls.extend(found)
        is_free[chosen] = False
    return walls


def surface_offset_m(
    wall: Wall,
    s: Float64[np.ndarray, "*n"],
    z: Float64[np.ndarray, "*n"],
    caster: RayCaster,
    near_m: tuple[float, float],
) -> Float64[np.ndarray, "*n"]:
    """Return the surface's offset in front of a wall's plane at (s, z), in metres, or NaN.

    It is measured along rays perpendicular to the plane.

    Args:
        wall: the plane.
        s: place along the wall, in metres.
        z: height, in metres.
        caster: over the surface.
        near_m: distances before and behind the plane within which surface belongs to the wall.
    """
    start = wall.at(s, z, near_m[0]).reshape(-1, 3)
    hits = caster.intersect(start, np.broadcast_to(-wall.normal, start.shape).copy())
    is_near = hits.is_hit & (hits.distance_m < sum(near_m))
    out = near_m[0] - hits.distance_m.astype(np.float64)
    return np.where(is_near, out, np.nan).reshape(s.shape)


def returns_near(
    wall: Wall, returns_world: Float32[np.ndarray, "n 3"], near_m: tuple[float, float]
) -> Float64[np.ndarray, "m 3"]:
    """Return the points up to `near_m` before and behind a wall's plane."""
    out = returns_world @ wall.normal.astype(np.float32) - np.float32(wall.origin_m @ wall.normal)
    return returns_world[(out > -near_m[1]) & (out < near_m[0])].astype(np.float64)


def _best_plane(
    centres: Float64[np.ndarray, "n 2"],
    flat: Float64[np.ndarray, "n 2"],
    area: Float64[np.ndarray, " n"],
    rng: np.random.Generator,
) -> Bool[np.ndarray, " n"]:
    """Return the faces on the plane with most area among hypotheses, refined twice."""
    best, best_area = np.zeros(len(area), dtype=bool), -1.0
    # Hypotheses are drawn in proportion to area: large planes are found in few draws.
    for seed in rng.choice(len(area), size=min(_Limits.seeds, len(area)), p=area / area.sum()):
        inside = _near_plane(centres, flat, centres[seed], flat[seed])
        total = float(area[inside].sum())
        if total > best_area:
            best, best_area = inside, total
    for _ in range(2):
        centre, normal = _line(centres[best], flat[best], area[best])
        refined = _near_plane(centres, flat, centre, normal)
        if area[refined].sum() < best_area:
            break
        best, best_area = refined, float(area[refined].sum())
    return best


def _near_plane(
    centres: Float64[np.ndarray, "n 2"],
    flat: Float64[np.ndarray, "n 2"],
    place: Float64[np.ndarray, "2"],
    normal: Float64[np.ndarray, "2"],
) -> Bool[np.ndarray, " n"]:
    distance = np.abs(centres @ normal - place @ normal)
    return (distance < _Limits.thickness_m) & (flat @ normal > _Limits.min_cosine)


def _line(
    centres: Float64[np.ndarray, "n 2"],
    flat: Float64[np.ndarray, "n 2"],
    area: Float64[np.ndarray, " n"],
) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]:
    """Return a point and the normal, on the faces' side, of the least-squares line in plan."""
    centre = np.average(centres, axis=0, weights=area)
    offset = centres - centre
    _, vectors = np.linalg.eigh((offset * area[:, None]).T @ offset)
    return centre, vectors[:, 0] * np.sign((flat * area[:, None]).sum(axis=0) @ vectors[:, 0])


def _pieces(
    centres: Float64[np.ndarray, "n 2"],
    flat: Float64[np.ndarray, "n 2"],
    area: Float64[np.ndarray, " n"],
    corners: Float64[np.ndarray, "n 3 3"],
) -> list[Wall]:
    """Return the separate walls on one plane."""
    centre, normal = _line(centres, flat, area)
    along = np.array([-normal[1], normal[0]])
    origin = np.array([*centre, 0.0])
    s = (corners[..., :2] - centre) @ along
    low, high = s.min(axis=1), s.max(axis=1)
    order = np.argsort(low)
    reach = np.maximum.accumulate(high[order])
    starts = np.flatnonzero(np.r_[True, low[order][1:] > reach[:-1] + _Limits.max_gap_m])
    walls = []
    for piece in np.split(order, starts[1:]):
        span = (float(low[piece].min()), float(high[piece].max()))
        z = corners[piece, :, 2]
        height = (float(z.min()), float(z.max()))
        width, tall = span[1] - span[0], height[1] - height[0]
        measured = float(area[piece].sum())
        is_wall = width >= _Limits.min_width_m and tall >= _Limits.min_height_m
        is_wall &= measured >= max(
            _Limits.min_area_m2, _Limits.min_density * _spanned_m2(s[piece], z)
        )
        if is_wall:
            walls.append(
                Wall(origin, np.array([*normal, 0.0]), np.array([*along, 0.0]), span, height)
            )
    return walls


def _spanned_m2(s: Float64[np.ndarray, "n 3"], z: Float64[np.ndarray, "n 3"]) -> float:
    """Return the area from the lowest to the highest face of each column, in square metres.

    Distant walls may be measured near their top alone, so the wall's full rectangle would be too
    large.
    """
    column = np.floor((s.mean(axis=1) - s.min()) / _Limits.column_m).astype(np.int64)
    low = np.full(int(column.max()) + 1, np.inf)
    high = -low
    np.minimum.at(low, column, z.min(axis=1))
    np.maximum.at(high, column, z.max(axis=1))
    return float(np.maximum(high - low, 0.0).sum() * _Limits.column_m)
