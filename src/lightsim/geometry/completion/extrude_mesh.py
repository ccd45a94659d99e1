"""Box faces of voxel columns as a light triangle mesh."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from lightsim.core.mesh import Provenance, TriMesh
from lightsim.geometry.completion.extrude_columns import Column
from lightsim.geometry.completion.extrude_grid import VoxelGrid

_SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))
Quad = tuple[tuple[int, int, int], tuple[int, int, int], tuple[int, int, int], tuple[int, int, int]]


def mesh_columns(columns: Sequence[Column], grid: VoxelGrid) -> TriMesh:
    """Outer faces of the columns, frame world, outward faces counter-clockwise."""
    by_cell = {(column.x, column.y): column for column in columns}
    quads: list[Quad] = []
    colours: list[tuple[float, float, float]] = []
    for column in columns:
        own = _caps(column)
        for dx, dy in _SIDES:
            key = (column.x + dx, column.y + dy)
            for low, high in _uncovered(column, by_cell.get(key)):
                own.append(_side(column, (dx, dy), low, high))
        quads.extend(own)
        colours.extend([column.colour] * len(own))
    corners = np.array(quads, dtype=np.float64).reshape(-1, 3)
    return _triangles(corners * grid.voxel_m + grid.low_m, colours)


def _caps(column: Column) -> list[Quad]:
    """Top and bottom."""
    x, y, low, high = column.x, column.y, column.low, column.high + 1
    ring = ((x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1))
    a, b, c, d = ((*xy, high) for xy in ring)
    e, f, g, h = ((*xy, low) for xy in ring)
    return [(a, b, c, d), (h, g, f, e)]


def _uncovered(column: Column, neighbour: Column | None) -> list[tuple[int, int]]:
    """Intervals [low, high) of the column's side that the neighbour leaves open."""
    low, high = column.low, column.high + 1
    if neighbour is None:
        return [(low, high)]
    below = (low, min(high, neighbour.low))
    above = (max(low, neighbour.high + 1), high)
    if neighbour.low >= high or neighbour.high + 1 <= low:
        return [(low, high)]
    return [part for part in (below, above) if part[1] > part[0]]


def _side(column: Column, outward: tuple[int, int], low: int, high: int) -> Quad:
    x, y = column.x, column.y
    # From right to left seen from outside, so that the face is counter-clockwise outside.
    first, second = {
        (1, 0): ((x + 1, y), (x + 1, y + 1)),
        (-1, 0): ((x, y + 1), (x, y)),
        (0, 1): ((x + 1, y + 1), (x, y + 1)),
        (0, -1): ((x, y), (x + 1, y)),
    }[outward]
    return ((*first, low), (*second, low), (*second, high), (*first, high))


def _triangles(
    corners_world: Float[np.ndarray, "n 3"], colours: Sequence[tuple[float, float, float]]
) -> TriMesh:
    """Two triangles for every four corners."""
    start = 4 * np.arange(len(corners_world) // 4)[:, None]
    faces = np.concatenate([start + np.array([[0, 1, 2]]), start + np.array([[0, 2, 3]])])
    colour = np.repeat(np.array(colours, dtype=np.float32).reshape(-1, 3), 4, axis=0)
    mesh = TriMesh("world", corners_world.astype(np.float32), faces.astype(np.int32), colour)
    return mesh.with_provenance(Provenance.INFERRED)
