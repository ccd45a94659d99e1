"""Meshes of the inferred surface above measured columns of space.

On walls it is a sheet in the wall's plane, elsewhere boxes: boxes on a plane that is oblique to the
grid would form steps that shade the wall.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.ndimage import uniform_filter1d

from lightsim.core.buildings import Wall
from lightsim.core.mesh import Material, Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.surface import grid_mesh, quad_mesh

# Edge of a column of space and of its cells, in metres.
CELL_M = 0.25
MATERIAL = Material(0.8, 0.0, "upright")  # Roughness as of plaster; not metallic.
# Distance from a wall's plane within which a column belongs to the wall, in metres. Chosen on log
# 002, as all values below; sensitivity not measured.
_ON_WALL_M = 0.3
# Least number of adjacent columns that form a sheet; fewer are posts.
_LEAST_IN_ROW = 4
# Number of columns over which a sheet's offset from the plane is averaged.
_OUT_OVER = 9
# Depth of a sheet's lower border below the top of the measured surface, in metres, against gaps.
_BELOW_M = 0.15
# Depth of a sheet behind the measured surface, in metres, against flicker.
_BEHIND_M = 0.03


@dataclass(frozen=True, eq=False)
class Risen:
    """Columns of space with inferred surface on top, frame world.

    Args:
        cell: index in x and y, unique.
        place_m: x and y of the uppermost measured surface, and its top z.
        count: number of cells above it, at least one.
    """

    cell: Int64[np.ndarray, "n 2"]
    place_m: Float64[np.ndarray, "n 3"]
    count: Int64[np.ndarray, " n"]

    def some(self, chosen: Bool[np.ndarray, " n"]) -> Risen:
        """Return the selected columns."""
        return Risen(self.cell[chosen], self.place_m[chosen], self.count[chosen])


def upright_mesh(risen: Risen, walls: Sequence[Wall]) -> TriMesh:
    """Return the surface of columns; inferred, black."""
    sheets: list[TriMesh] = []
    for wall in walls:
        is_drawn = np.zeros(len(risen.count), dtype=bool)
        for row in _rows(wall, risen):
            is_drawn[row] = True
            sheets.append(_sheet(wall, risen.place_m[row], risen.count[row]))
        risen = risen.some(~is_drawn)
    return concatenate_meshes([*sheets, _boxes(risen)]).with_provenance(Provenance.INFERRED)


def _rows(wall: Wall, risen: Risen) -> Iterator[Int64[np.ndarray, " k"]]:
    """Yield groups of adjacent columns on a wall, in their order along it."""
    s, out = wall.place(risen.place_m)
    is_on = (np.abs(out) < _ON_WALL_M) & (s > wall.span_m[0]) & (s < wall.span_m[1])
    own = np.flatnonzero(is_on)
    own = own[np.argsort(s[own], kind="stable")]
    gaps = np.flatnonzero(np.diff(s[own]) > np.sqrt(2.0) * CELL_M) + 1
    return (row for row in np.split(own, gaps) if len(row) >= _LEAST_IN_ROW)


def _sheet(
    wall: Wall, place_m: Float64[np.ndarray, "k 3"], count: Int64[np.ndarray, " k"]
) -> TriMesh:
    """Return a surface in a wall's plane from measured surface up to the columns' tops."""
    s, out = wall.place(place_m)
    first = int(np.floor(s[0] / CELL_M))
    index = np.floor(s / CELL_M).astype(np.int64) - first
    columns = int(index[-1]) + 1
    own = np.bincount(index, minlength=columns)
    known = np.flatnonzero(own)

    def corners(values: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, " c"]:
        """Return the mean of values at the borders between columns."""
        mean = np.bincount(index, values, columns)[known] / own[known]
        each = np.interp(np.arange(columns), known, mean)
        return 0.5 * (np.r_[each[:1], each] + np.r_[each, each[-1:]])

    low = corners(place_m[:, 2]) - _BELOW_M
    high = corners(place_m[:, 2] + CELL_M * count)
    out = uniform_filter1d(corners(out), _OUT_OVER, mode="nearest") - _BEHIND_M
    levels = max(1, int(np.ceil((high - low).max() / CELL_M)))
    part = np.linspace(0.0, 1.0, levels + 1)
    z = low[:, None] + part * (high - low)[:, None]
    along = (first + np.arange(columns + 1)) * CELL_M
    points = wall.at(np.broadcast_to(along[:, None], z.shape), z)
    return grid_mesh(points + out[:, None, None] * wall.normal, MATERIAL)


def _boxes(risen: Risen) -> TriMesh:
    """Return the open sides of cells, as quads with common corners."""
    first = np.floor(risen.place_m[:, 2] / CELL_M).astype(np.int64)
    # One cell reaches down into the measured surface.
    filled = risen.count + 1
    column = np.repeat(np.arange(len(filled)), filled)
    level = np.arange(len(column)) - np.repeat(np.cumsum(filled) - filled, filled)
    cells = np.concatenate([risen.cell[column], (first[column] + level)[:, None]], axis=1)
    if not len(cells):
        return quad_mesh(np.zeros((0, 3)), np.zeros((0, 4), dtype=np.int64), MATERIAL)
    low = cells.min(axis=0) - 1
    shape = tuple((cells.max(axis=0) - low + 2).tolist())
    is_in = np.zeros(shape, dtype=bool)
    is_in[tuple((cells - low).T)] = True
    quads = [
        _open_sides(is_in, axis, is_upper=is_upper) for axis in range(3) for is_upper in (0, 1)
    ]
    corners, index = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    return quad_mesh((corners + low) * CELL_M, index.reshape(-1, 4), MATERIAL)


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
