"""Move the vertices of walls onto their returns, and remove bumps from beams through glass.

The field's coarse samples round off panes and ledges, which cast the small shadows of a facade;
returns are accurate to a centimetre. Over one or two metres a wall is smooth: deviations of a few
centimetres are noise, which casts long ragged shadows at grazing incidence of the sun.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64, Int64

from lightsim.core.buildings import Wall
from lightsim.core.laplace import nearest_known
from lightsim.core.mesh import TriMesh
from lightsim.geometry.completion.walls import find_walls

# The values below were chosen on log 002 and street 0; only their joint effect was measured
# (docs/benchmarks/reconstruction.md).


class _ToReturns:
    """Movement of vertices onto the median of returns."""

    count = 8  # Number of nearest returns.
    least = 4  # Least number of them within reach.
    reach_m = 0.15  # Reach along the wall.
    max_moved_m = 0.3  # Greatest movement.
    foot_m = 0.15  # Height of a wall's foot that is not moved: it belongs to the ground.


class _Smooth:
    """Smoothing of a wall as a height field over its plane, in layers."""

    cell_voxels = 2.0  # Edge of a cell, in samples of the level.
    reach_cells = (5, 2)  # Half width of the median, in cells: wall, other layers.
    # Deviation up to which vertices are moved onto the wall: for a smooth wall, for a rough one.
    bump_m = (0.03, 0.06)
    # Deviation from which vertices belong to another layer: smooth wall, rough wall.
    layer_m = (0.07, 0.14)
    # Mean of 1 - cosine between the normals of wall and surface that defines a smooth wall (with
    # windows and pilasters) and a rough one (noise); limits are interpolated between the two.
    roughness = (0.08, 0.2)
    max_distance_m = 0.35  # Greatest distance from the wall's plane.
    # Least cosine to the normal of the wall for a vertex to determine the surface; others move with
    # it unless they face away.
    min_cosine = 0.3


def flatten_walls(
    mesh: TriMesh, voxel_m: float, returns_world: Float[np.ndarray, "r 3"]
) -> TriMesh:
    """Move vertices near walls along the wall's normal onto the measured surface.

    Vertices are first moved onto the returns around them, where there are enough. Then each wall is
    a height field over its plane, smoothed by a running median (Tukey 1977), which follows bowed
    walls and removes bumps. Larger deviations (panes in their frames, ledges) form separate layers,
    which are smoothed over a smaller window.

    Args:
        mesh: one level of the background, frame world.
        voxel_m: distance between the level's samples.
        returns_world: LiDAR returns from static surfaces, in metres.
    """
    if len(mesh.faces) == 0:
        return mesh
    walls = find_walls(mesh)
    mesh = _onto_returns(mesh, walls, returns_world)
    points = mesh.vertices.astype(np.float64)
    normals = mesh.vertex_normals().astype(np.float64)
    for wall in walls:
        _flatten(points, normals, wall, voxel_m)
    return replace(mesh, vertices=points.astype(np.float32))


def _onto_returns(
    mesh: TriMesh, walls: Sequence[Wall], returns_world: Float[np.ndarray, "r 3"]
) -> TriMesh:
    """Move every vertex of a wall once to the median of the returns around it."""
    from scipy.spatial import KDTree

    points = mesh.vertices.astype(np.float64)
    normals = mesh.vertex_normals().astype(np.float64)
    is_done = np.zeros(len(points), dtype=bool)
    for wall in walls:
        near = _on_wall(wall, returns_world, _ToReturns.reach_m)
        if len(near.rows) < _ToReturns.count:
            continue
        own = _on_wall(wall, points, -_ToReturns.foot_m)
        chosen = ~is_done[own.rows] & (normals[own.rows] @ wall.normal > -_Smooth.min_cosine)
        rows = own.rows[chosen]
        tree = KDTree(near.place_m)
        index = np.asarray(
            tree.query(
                own.place_m[chosen], _ToReturns.count, distance_upper_bound=_ToReturns.reach_m
            )[1]
        )
        has_enough = (index < len(near.rows)).sum(axis=1) >= _ToReturns.least
        around = np.append(near.out_m, np.nan)[index[has_enough]]
        way = np.nanmedian(around, axis=1) - own.out_m[chosen][has_enough]
        is_near = np.abs(way) < _ToReturns.max_moved_m
        moved = rows[has_enough][is_near]
        points[moved] += way[is_near, None] * wall.normal
        is_done[moved] = True
    return replace(mesh, vertices=points.astype(np.float32))


@dataclass(frozen=True, eq=False)
class _OnWall:
    """Points near a wall's plane: rows, place along it and up, and offset from it."""

    rows: Int64[np.ndarray, " n"]
    place_m: Float64[np.ndarray, "n 2"]
    out_m: Float64[np.ndarray, " n"]


def _on_wall(wall: Wall, points: Float[np.ndarray, "n 3"], around_m: float) -> _OnWall:
    """Select the points near the wall's rectangle, extended by `around_m` at its foot and ends.

    A negative `around_m` cuts the foot and does not change the ends.
    """
    ends, z = max(around_m, 0.0), points[:, 2]
    # In the points' precision: conversion of millions of points to float64 would need much memory.
    out = points @ wall.normal.astype(points.dtype) - wall.origin_m @ wall.normal
    is_on = (np.abs(out) < _Smooth.max_distance_m) & (z <= wall.height_m[1] + ends)
    rows = np.flatnonzero(is_on & (z >= wall.height_m[0] - around_m))
    s, out = wall.place(points[rows].astype(np.float64))
    place = np.stack([s, points[rows, 2]], axis=1)
    is_between = (s >= wall.span_m[0] - ends) & (s <= wall.span_m[1] + ends)
    return _OnWall(rows[is_between], place[is_between], out[is_between])


def _flatten(
    points: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    wall: Wall,
    voxel_m: float,
) -> None:
    """Move the points of one wall onto its smooth surface, in place."""
    s, out = wall.place(points)
    z, cosine = points[:, 2], normals @ wall.normal
    is_near = (np.abs(out) < _Smooth.max_distance_m) & (cosine > -_Smooth.min_cosine)
    is_near &= (s >= wall.span_m[0]) & (s <= wall.span_m[1])
    is_near &= (z >= wall.height_m[0]) & (z <= wall.height_m[1])
    cell = np.stack([s - wall.span_m[0], z - wall.height_m[0]]) / (_Smooth.cell_voxels * voxel_m)
    layers = [np.flatnonzero(is_near)]
    for reach in _Smooth.reach_cells:
        remaining = []
        for rows in layers:
            known = rows[cosine[rows] > _Smooth.min_cosine]
            if len(known) == 0:
                continue
            above = out[rows] - _smooth_height_m(cell[:, known], out[known], reach, cell[:, rows])
            rough = _local_mean(cell[:, rows], 1.0 - cosine[rows], reach)
            bump = np.interp(rough, _Smooth.roughness, _Smooth.bump_m)
            fraction = (np.abs(above) - bump) / (
                np.interp(rough, _Smooth.roughness, _Smooth.layer_m) - bump
            )
            way = np.clip(1.0 - fraction, 0.0, 1.0) * above
            points[rows] -= way[:, None] * wall.normal
            out[rows] -= way
            is_out = fraction > 0
            remaining += [rows[is_out & (above > 0)], rows[is_out & (above < 0)]]
        layers = remaining


def _local_mean(
    cell: Float64[np.ndarray, "2 n"], values: Float64[np.ndarray, " n"], reach: int
) -> Float64[np.ndarray, " n"]:
    """Return the mean over the cells within `reach` of each point's cell."""
    from scipy.ndimage import uniform_filter

    index = cell.astype(np.int64)
    total = np.zeros((2, int(index[0].max()) + 1, int(index[1].max()) + 1))
    np.add.at(total, (0, *index), values)
    np.add.at(total, (1, *index), 1.0)
    total, count = (uniform_filter(t, 2 * reach + 1, mode="constant") for t in total)
    return total[tuple(index)] / count[tuple(index)]


def _smooth_height_m(
    cell: Float64[np.ndarray, "2 n"],
    height_m: Float64[np.ndarray, " n"],
    reach: int,
    wanted: Float64[np.ndarray, "2 m"],
) -> Float64[np.ndarray, " m"]:
    """Return the running median of heights over a plane at the wanted places, in units of cells."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    index = cell.astype(np.int64)
    shape = (int(index[0].max()) + 1, int(index[1].max()) + 1)
    medians = np.full(shape, np.nan)
    flat = index[0] * shape[1] + index[1]
    order = np.lexsort((height_m, flat))
    found, start, count = np.unique(flat[order], return_index=True, return_counts=True)
    medians.reshape(-1)[found] = height_m[order[start + count // 2]]
    around = np.pad(medians, reach, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(around, (2 * reach + 1,) * 2)
    is_known = np.isfinite(medians)
    level = np.zeros(shape)
    level[is_known] = np.nanmedian(windows[is_known].reshape(len(found), -1), axis=1)
    level = gaussian_filter(nearest_known(level, is_known), 1.0, mode="nearest")
    return np.asarray(map_coordinates(level, wanted - 0.5, order=1, mode="nearest"))
