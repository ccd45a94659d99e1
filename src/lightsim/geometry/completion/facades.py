"""Facades without holes and up to the sky: the parts of walls that no LiDAR beam returned from.

Beams pass through glass and end at the LiDAR's highest channel. Both gaps are closed on the plane
of the wall around them: holes with measured wall on most of their border, and the wall above the
highest beam as far as images show matter there and no image shows sky (silhouette carving,
Laurentini 1994, doi:10.1109/34.273735, on a plane that is known). The result is a guess, but one
on a measured plane: images can be projected onto it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int8, Int32

from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import MakeCaster, RayCaster, check_world
from lightsim.core.mesh import Material, Provenance, TriMesh, concatenate_meshes
from lightsim.core.sensors import CameraFrame, LidarSweep
from lightsim.geometry.completion.silhouettes import (
    MIN_BASELINE_M,
    View,
    classify_matte,
    spaced_views,
)
from lightsim.geometry.completion.walls import Wall, find_walls
from lightsim.geometry.materials import FACADE

WINDOW = Material(0.1, 0.0, "window")
_FRONT_M = 0.5
_BEHIND_M = 0.6
_OFFSET_LIMIT_M = 0.3
_LEVEL_M = 1.0
"""Roof lines are medians over this far to either side."""
_OVERLAP_M = 0.03
"""Fillings reach one cell behind the measured wall around them, this deep."""


# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/reconstruction.md, where the street of seed 1 is the fair test).

# Cells of a wall that are filled or not.
_CELL_M = 0.25
# No wall is raised by more than this above its measured part.
_MAX_RISE_M = 20.0
# Larger holes stay open.
_MAX_HOLE_M2 = 40.0
# Fraction of a hole's border, and of its lintel, that must be measured wall.
_MIN_BORDER = 0.6
# Views from further away do not count.
_MAX_VIEW_M = 90.0
# Cells above the measured wall that more than this fraction of the views shows as sky are open.
_MAX_SKY_FRACTION = 0.3
# The same within the measured wall, where glass reflects the sky.
_MAX_HOLE_SKY_FRACTION = 0.7
# Views that must show matter in a cell above the measured wall.
_MIN_VOTES = 2
# Beams through a cell that returned from behind the wall: there is no wall.
_MIN_PASSES = 2
# LiDAR returns used for that.
_EVERY_NTH_RETURN = 4
# Fraction of the cells between measured and inferred top that have those votes.
_MIN_SUPPORT = 0.5


@dataclass(eq=False)
class WallCells:
    """Cells [s, z] of one wall and what is known of them.

    Args:
        wall: the plane.
        cell_m: edge of a cell.
        is_covered: a measured surface lies within 0.6 m of the plane.
        offset_m: of that surface in front of the plane; 0 elsewhere.
        sky: views that show sky.
        matter: views that show something, with nothing measured before it.
        passes: beams that went through and returned from behind.
    """

    wall: Wall
    cell_m: float
    is_covered: Bool[np.ndarray, "s z"]
    offset_m: Float64[np.ndarray, "s z"]
    sky: Int32[np.ndarray, "s z"]
    matter: Int32[np.ndarray, "s z"]
    passes: Int32[np.ndarray, "s z"]

    def centres(self, out_m: float = 0.0) -> Float64[np.ndarray, "s z 3"]:
        """Middle of each cell in frame world, `out_m` in front of the wall's plane."""
        ns, nz = self.is_covered.shape
        s = self.wall.span_m[0] + (np.arange(ns) + 0.5) * self.cell_m
        z = self.wall.height_m[0] + (np.arange(nz) + 0.5) * self.cell_m
        grid = np.meshgrid(s, z, indexing="ij")
        return self.wall.at(grid[0], grid[1], out_m)


def complete_facades(
    background: TriMesh,
    silhouettes: Iterable[View],
    sweeps: Iterable[LidarSweep],
    *,
    make_caster: MakeCaster,
) -> TriMesh:
    """Closed holes (windows, interpolated) and raised walls (facade, inferred), frame world; black.

    Args:
        background: measured static surfaces, frame world, outward faces counter-clockwise.
        silhouettes: frames with their camera (of the matte's size) and sky matte.
        sweeps: beams that went over a wall tell that it ends there.
        make_caster: builds the ray caster.

    Raises:
        FrameMismatchError: the mesh is not in frame world.
        InputError: a matte does not fit its camera.
    """
    check_world([background])
    walls = find_walls(background)
    caster = make_caster([background])
    cells = [_measure(wall, caster) for wall in walls]
    for frame, camera, matte in spaced_views(silhouettes, MIN_BASELINE_M):
        kind = classify_matte(camera, matte)
        for wall_cells in cells:
            _look(wall_cells, (frame, camera, kind), caster)
    for sweep in sweeps:
        for wall_cells in cells:
            _pass(wall_cells, sweep)
    parts = [part for c in cells for part in _fill(c)]
    if not parts:
        nothing = np.zeros((0, 3), dtype=np.float32)
        return TriMesh("world", nothing, np.zeros((0, 3), dtype=np.int32), nothing, (FACADE,))
    return concatenate_meshes(parts)


def _measure(wall: Wall, caster: RayCaster) -> WallCells:
    """Which cells have a measured surface, by rays square to the plane from just before it."""
    cell = _CELL_M
    ns = max(int(np.ceil((wall.span_m[1] - wall.span_m[0]) / cell)), 1)
    nz = int(np.ceil((wall.height_m[1] + _MAX_RISE_M - wall.height_m[0]) / cell))
    shape = (ns, nz)
    cells = WallCells(
        wall,
        cell,
        np.zeros(shape, dtype=bool),
        np.zeros(shape),
        *(np.zeros(shape, dtype=np.int32) for _ in range(3)),
    )
    start = cells.centres(_FRONT_M).reshape(-1, 3)
    hits = caster.intersect(start, np.broadcast_to(-wall.normal, start.shape).copy())
    is_near = hits.is_hit & (hits.distance_m < _FRONT_M + _BEHIND_M)
    cells.is_covered[:] = is_near.reshape(shape)
    distance = np.where(is_near, hits.distance_m, _FRONT_M).astype(np.float64)
    cells.offset_m[:] = (_FRONT_M - distance).reshape(shape)
    return cells


def _look(
    cells: WallCells,
    view: tuple[CameraFrame, PinholeCamera, Int8[np.ndarray, "h w"]],
    caster: RayCaster,
) -> None:
    """What one view shows at the cells without measured surface."""
    frame, camera, kinds = view
    eye = frame.world_from_camera.translation_m
    if (eye - cells.wall.origin_m) @ cells.wall.normal < _FRONT_M:
        return
    rows = np.flatnonzero(~cells.is_covered.ravel())
    points = cells.centres().reshape(-1, 3)[rows]
    distance = np.linalg.norm(points - eye, axis=1)
    uv, is_inside = frame.project(camera, points)
    is_inside &= distance < _MAX_VIEW_M
    rows, points, uv = rows[is_inside], points[is_inside], uv[is_inside]
    distance = distance[is_inside]
    kind = kinds[uv[:, 1].astype(np.int64), uv[:, 0].astype(np.int64)]
    cells.sky.reshape(-1)[rows[kind > 0]] += 1
    matter = np.flatnonzero(kind < 0)
    rays = (points[matter] - eye) / distance[matter, None]
    hits = caster.intersect(np.broadcast_to(eye, rays.shape).copy(), rays)
    is_open = hits.distance_m > distance[matter] - _BEHIND_M
    cells.matter.reshape(-1)[rows[matter[is_open]]] += 1


def _pass(cells: WallCells, sweep: LidarSweep) -> None:
    """Count the beams of a sweep that crossed the plane and returned from well behind it."""
    wall, step = cells.wall, _EVERY_NTH_RETURN
    start = sweep.origins_world[::step].astype(np.float64) - wall.origin_m
    end = sweep.points_world[::step].astype(np.float64) - wall.origin_m
    before, after = start @ wall.normal, end @ wall.normal
    crosses = (before > _FRONT_M) & (after < -2 * _BEHIND_M)
    start, end = start[crosses], end[crosses]
    fraction = (before[crosses] / (before[crosses] - after[crosses]))[:, None]
    place = start + fraction * (end - start)
    i = np.floor((place @ wall.along - wall.span_m[0]) / cells.cell_m).astype(np.int64)
    j = np.floor((place[:, 2] - wall.height_m[0]) / cells.cell_m).astype(np.int64)
    shape = cells.passes.shape
    is_inside = (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])
    np.add.at(cells.passes, (i[is_inside], j[is_inside]), 1)


def _fill(cells: WallCells) -> list[TriMesh]:
    seen = np.maximum(cells.sky + cells.matter, 1)
    levels = np.arange(cells.is_covered.shape[1])
    measured = np.where(cells.is_covered, levels, -1).max(axis=1)
    is_above = levels > measured[:, None]
    is_open = cells.sky > _MAX_SKY_FRACTION * seen
    is_open |= cells.passes >= _MIN_PASSES
    top = _raised(cells, is_open & is_above, measured)
    is_inner = ~is_above & ~cells.is_covered & (cells.sky <= _MAX_HOLE_SKY_FRACTION * seen)
    is_hole = _closed_holes(cells, is_inner)
    is_upper = is_above & (levels <= top[:, None]) & (measured >= 0)[:, None]
    offset = _spread_offset(cells)
    parts = (
        (is_hole, WINDOW, Provenance.INTERPOLATED),
        (is_upper, FACADE, Provenance.INFERRED),
    )
    return [
        _mesh_cells(cells, mask, offset, material).with_provenance(provenance)
        for mask, material, provenance in parts
        if mask.any()
    ]


def _raised(
    cells: WallCells,
    is_open: Bool[np.ndarray, "s z"],
    measured: np.ndarray,
) -> np.ndarray:
    """Highest cell of each column up to which images show matter, levelled along the wall."""

    levels = np.arange(is_open.shape[1])
    is_above = levels > measured[:, None]
    first = np.where(is_open.any(axis=1), is_open.argmax(axis=1), len(levels))
    has_votes = (cells.matter >= _MIN_VOTES) & is_above
    is_judged = (cells.sky + cells.matter > 0) & is_above
    supported = np.cumsum(has_votes, axis=1)
    judged = np.maximum(np.cumsum(is_judged, axis=1), 1)
    # Medians along the wall: panes that mirror the sky are narrower than a roof's steps.
    first = _levelled(first, cells.cell_m)
    is_good = has_votes & (supported >= _MIN_SUPPORT * judged)
    is_good &= levels < first[:, None]
    top = np.where(is_good.any(axis=1), np.where(is_good, levels, -1).max(axis=1), measured)
    return np.minimum(np.maximum(_levelled(top, cells.cell_m), top), first - 1)


def _levelled(row: np.ndarray, cell_m: float) -> np.ndarray:
    from scipy.ndimage import median_filter

    return np.asarray(median_filter(row, 2 * round(_LEVEL_M / cell_m) + 1, mode="nearest"))


def _closed_holes(cells: WallCells, is_missing: Bool[np.ndarray, "s z"]) -> Bool[np.ndarray, "s z"]:
    """Missing parts that measured wall surrounds, with a measured lintel."""
    from scipy.ndimage import find_objects
    from skimage.measure import label

    pieces = np.asarray(label(is_missing, connectivity=1))
    covered = np.pad(cells.is_covered, 1)
    kept = np.zeros_like(is_missing)
    for number, box in enumerate(find_objects(pieces), start=1):
        piece = pieces[box] == number
        if piece.sum() * _CELL_M**2 > _MAX_HOLE_M2:
            continue
        grown = tuple(slice(b.start, b.stop + 2) for b in box)
        if _border_fraction(np.pad(piece, 1), covered[grown], _MIN_BORDER):
            kept[box] |= piece
    return kept


def _border_fraction(
    piece: Bool[np.ndarray, "a b"], covered: Bool[np.ndarray, "a b"], needed: float
) -> bool:
    """Whether enough of a hole's border, and enough of what lies over it, is measured."""
    from scipy.ndimage import binary_dilation

    border = np.asarray(binary_dilation(piece)) & ~piece
    lintel = np.zeros_like(piece)
    lintel[:, 1:] = piece[:, :-1]
    lintel &= ~piece
    return bool(covered[border].mean() >= needed and covered[lintel].mean() >= needed)


def _spread_offset(cells: WallCells) -> Float64[np.ndarray, "s z"]:
    """How far before the plane the measured wall around each cell lies: reveals and ledges."""
    from scipy.ndimage import gaussian_filter

    is_used = cells.is_covered & (np.abs(cells.offset_m) < _OFFSET_LIMIT_M)
    spread = 1.0 / cells.cell_m
    total = np.asarray(gaussian_filter(np.where(is_used, cells.offset_m, 0.0), spread))
    fraction = np.asarray(gaussian_filter(is_used.astype(np.float64), spread))
    return total / np.maximum(fraction, 0.02)


def _mesh_cells(
    cells: WallCells,
    is_filled: Bool[np.ndarray, "s z"],
    offset: Float64[np.ndarray, "s z"],
    material: Material,
) -> TriMesh:
    """Two triangles a cell, corners shared."""
    from scipy.ndimage import binary_dilation

    is_drawn = np.asarray(binary_dilation(is_filled, np.ones((3, 3), dtype=bool)))
    is_drawn = is_filled | (is_drawn & cells.is_covered)
    i, j = np.nonzero(is_drawn)
    across = is_filled.shape[1] + 1
    corner = i * across + j
    # `along` runs from left to right seen from outside.
    quads = np.stack([corner, corner + across, corner + across + 1, corner + 1], axis=1)
    used, index = np.unique(quads, return_inverse=True)
    index = index.reshape(-1, 4)
    padded = np.pad(offset, ((0, 1), (0, 1)), mode="edge") - _OVERLAP_M
    place = used // across, used % across
    s = cells.wall.span_m[0] + place[0] * cells.cell_m
    z = cells.wall.height_m[0] + place[1] * cells.cell_m
    points = cells.wall.at(s, z) + padded[place][:, None] * cells.wall.normal
    faces = np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]])
    return TriMesh(
        "world",
        points.astype(np.float32),
        faces.astype(np.int32),
        np.zeros((len(points), 3), dtype=np.float32),
        (material,),
    )
