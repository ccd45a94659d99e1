"""Planes of walls in a mesh, and the surface and returns near them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Float64

from lightsim.core.buildings import Wall
from lightsim.core.casting import RayCaster
from lightsim.core.mesh import TriMesh
from lightsim.geometry.completion.planes import Pieces, walls_among

# Edge of a wall's cells and of the faces that are added to walls, in metres: each face has its own
# patch of texture.
WALL_CELL_M = 0.25
# Upward direction of frame world.
UP = np.array([0.0, 0.0, 1.0])
# Greatest vertical component of the normal of a wall's face. Chosen on log 002; sensitivity not
# measured.
_MAX_NORMAL_Z = 0.25


def find_walls(mesh: TriMesh) -> list[Wall]:
    """Find upright planes with much measured surface, greatest first.

    Args:
        mesh: static surface, frame world.
    """
    normals, area = mesh.face_normals(), mesh.face_areas_m2()
    is_upright = (np.abs(normals[:, 2]) < _MAX_NORMAL_Z) & (area > 0)
    flat = normals[is_upright, :2]
    flat = flat / np.linalg.norm(flat, axis=1, keepdims=True)
    corners = mesh.vertices[mesh.faces[is_upright]].astype(np.float64)
    return list(walls_among(Pieces(corners, flat, area[is_upright])))


def lie_on(
    walls: Sequence[Wall], points: Float64[np.ndarray, "n 3"], near_m: float
) -> Bool[np.ndarray, " n"]:
    """Return whether points lie near the plane of a wall, within its length."""
    is_on = np.zeros(len(points), dtype=bool)
    for wall in walls:
        s, out = wall.place(points)
        is_on |= (np.abs(out) < near_m) & (s > wall.span_m[0]) & (s < wall.span_m[1])
    return is_on


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
