"""Boxes on top of measured columns of space."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lightsim.core.mesh import Material, Provenance, TriMesh
from lightsim.geometry.surface import quad_mesh

# Edge of a column of space and of its cells, in metres.
CELL_M = 0.25
MATERIAL = Material(0.8, 0.0, "upright")  # Roughness as of plaster; not metallic.


def upright_mesh(
    cell: Int64[np.ndarray, "n 2"], top_m: Float64[np.ndarray, " n"], count: Int64[np.ndarray, " n"]
) -> TriMesh:
    """Return the open sides of cells above columns, as quads with common corners; inferred, black.

    Args:
        cell: index of each column in x and y, unique.
        top_m: z of the top of the measured surface.
        count: number of cells above it, at least one.
    """
    # One cell reaches down into the measured surface.
    filled = count + 1
    column = np.repeat(np.arange(len(filled)), filled)
    level = np.arange(len(column)) - np.repeat(np.cumsum(filled) - filled, filled)
    z = np.floor(top_m / CELL_M).astype(np.int64)[column] + level
    cells = np.concatenate([cell[column], z[:, None]], axis=1)
    if not len(cells):
        return quad_mesh(np.zeros((0, 3)), np.zeros((0, 4), dtype=np.int64), MATERIAL)
    low = cells.min(axis=0) - 1
    is_in = np.zeros(tuple((cells.max(axis=0) - low + 2).tolist()), dtype=bool)
    is_in[tuple((cells - low).T)] = True
    quads = [
        _open_sides(is_in, axis, is_upper=is_upper) for axis in range(3) for is_upper in (0, 1)
    ]
    corners, index = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    mesh = quad_mesh((corners + low) * CELL_M, index.reshape(-1, 4), MATERIAL)
    return mesh.with_provenance(Provenance.INFERRED)


def _open_sides(
    is_in: Bool[np.ndarray, "x y z"], axis: int, *, is_upper: int
) -> Int64[np.ndarray, "q 4 3"]:
    """Return corners of sides towards empty cells, counter-clockwise from outside."""
    neighbour = np.roll(is_in, -1 if is_upper else 1, axis=axis)
    cell = np.argwhere(is_in & ~neighbour)
    u, v = [(1, 2), (2, 0), (0, 1)][axis]
    steps = np.zeros((4, 3), dtype=np.int64)
    steps[:, axis] = is_upper
    order = [(0, 0), (1, 0), (1, 1), (0, 1)] if is_upper else [(0, 0), (0, 1), (1, 1), (1, 0)]
    steps[:, [u, v]] = order
    return cell[:, None] + steps
