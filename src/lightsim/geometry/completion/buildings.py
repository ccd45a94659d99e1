"""Buildings behind measured walls: holes closed, walls raised, and how high all of it rises.

Beams pass through glass and end at the LiDAR's highest channel. What is missing of a building is
closed on the planes of its measured walls (`glass` tells which of it is glass); each wall is the
front of an upright prism. What some view shows of it belongs to the visible mesh and gets its
texture from the images; what no view shows (roofs, rear walls, the tops of houses near the road)
casts shadows and is kept apart (`prisms`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from lightsim.core.buildings import Roofline, Wall
from lightsim.core.casting import MakeCaster, check_world
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.core.sensors import LidarSweep
from lightsim.geometry.completion.crowns import Beams, Crowns
from lightsim.geometry.completion.far_walls import find_far_walls
from lightsim.geometry.completion.free_space import find_free_space
from lightsim.geometry.completion.neighbours import raised_to_neighbours
from lightsim.geometry.completion.panes import find_panes
from lightsim.geometry.completion.rooflines import find_rooflines, with_depths
from lightsim.geometry.completion.silhouettes import View
from lightsim.geometry.completion.sparse_walls import find_sparse_walls
from lightsim.geometry.completion.uprights import raise_uprights
from lightsim.geometry.completion.wall_cells import (
    MAX_HEIGHT_M,
    WallCells,
    gather_cells,
    with_returns,
)
from lightsim.geometry.materials import FACADE
from lightsim.geometry.surface import quad_mesh

_OFFSET_LIMIT_M = 0.3
_HOUSE_REACH_M = 2.0
"""Columns this near tell how far out a house stands. Not measured alone."""
_LEVEL_WEIGHT = 0.1
"""Of the house's level against what was measured, as a fraction of the cells around."""
_OVERLAP_M = 0.03
"""Fillings reach one cell behind the measured wall around them, this deep."""


@dataclass(frozen=True, eq=False)
class MeasuredScene:
    """What beams met, frame world.

    Args:
        background: static surfaces, outward faces counter-clockwise.
        walls: planes in it (`walls.find_walls`).
        crowns: go on upward as leaves.
        parked: vehicles at rest, which hide what is behind them.
    """

    background: TriMesh
    walls: Sequence[Wall]
    crowns: Crowns
    parked: Sequence[TriMesh] = ()


def complete_buildings(
    scene: MeasuredScene,
    silhouettes: Callable[[], Iterable[View]],
    sweeps: Iterable[LidarSweep],
    ground: GroundMap,
    beams: Beams,
    *,
    make_caster: MakeCaster,
) -> tuple[TriMesh, list[Roofline]]:
    """What views show of buildings, and of other things that stand upright, beyond what was
    measured (holes interpolated, the rest inferred; frame world, black), and how high walls rise.

    Args:
        scene: what was measured.
        silhouettes: gives frames with their camera (of the matte's size) and sky matte, any number
            of times.
        sweeps: beams that went over a wall tell that it ends there.
        ground: heights count from it.
        beams: of what stands still; walls go on where they end on their planes, and stand where
            many end on one plane.
        make_caster: builds the ray caster.

    Raises:
        FrameMismatchError: the mesh is not in frame world.
        InputError: a matte does not fit its camera.
    """
    background, walls = scene.background, scene.walls
    check_world([background])
    parts: list[TriMesh] = []
    rooflines: list[Roofline] = []
    standing = list(walls)
    if walls:
        caster = make_caster([background])
        before = make_caster([background, *scene.parked])
        far_walls = find_far_walls(walls, beams.ends, ground, caster)
        known = [*walls, *far_walls]
        far_walls += find_sparse_walls(known, beams, silhouettes(), scene.crowns, ground, before)
        standing += far_walls
        cells = gather_cells(walls, caster, silhouettes(), sweeps, far_walls, before)
        cells = [with_returns(c, beams.ends) if c.is_far else c for c in cells]
        rooflines = find_rooflines(cells, ground)
        fronts = concatenate_meshes([background, *_visible_parts(cells, rooflines)])
        space = find_free_space(fronts, silhouettes(), make_caster([fronts]), MAX_HEIGHT_M)
        rooflines = with_depths(rooflines, space)
        parts.extend(_visible_parts(cells, raised_to_neighbours(rooflines)))
        # Mostly sides of houses whose fronts have roofs: a second guess of how high they are would
        # cast a second shadow.
        rooflines = rooflines[: len(known)]
    # Raised walls explain what views show above things that stand before them.
    raised = concatenate_meshes([background, *parts])
    caster = make_caster([raised])
    uprights = raise_uprights(raised, silhouettes, ground, caster, scene.crowns, standing)
    return concatenate_meshes([*parts, uprights]), rooflines


def _visible_parts(walls: Sequence[WallCells], rooflines: Sequence[Roofline]) -> Iterator[TriMesh]:
    """Of each wall panes, and what is above the highest beam as far as a view shows it."""
    for cells, roofline in zip(walls, rooflines, strict=True):
        yield from _visible_parts_of(cells, roofline)


def _visible_parts_of(cells: WallCells, roofline: Roofline) -> Iterator[TriMesh]:
    offset = _spread_offset(cells)
    is_pane = find_panes(cells)
    is_upper = _unmeasured(cells, roofline) & ~is_pane
    if is_pane.any():
        pane = _mesh_cells(cells, is_pane, offset)
        yield pane.with_provenance(Provenance.INTERPOLATED)
    if is_upper.any():
        upper = _mesh_cells(cells, is_upper, offset)
        yield upper.with_provenance(Provenance.INFERRED)


def _unmeasured(cells: WallCells, roofline: Roofline) -> Bool[np.ndarray, "s z"]:
    """Cells that some view shows: above the measured part of the wall up to its roof, and those
    below it, far down the street, that nothing contradicts; and what parked cars hide of its
    foot."""
    levels = np.arange(cells.sky.shape[1])
    end = np.minimum(roofline.top, roofline.shown)
    if cells.is_far:
        return ~cells.is_covered & (cells.sky == 0) & (levels < end[:, None])
    is_plain = (cells.matter > 0) | (cells.through == 0)
    is_plain &= (cells.sky == 0) & (cells.passes == 0) & ~cells.is_covered
    is_plain &= levels < cells.measured_top[:, None]
    return (is_plain | (levels > cells.front_top[:, None])) & (levels < end[:, None])


def _spread_offset(cells: WallCells) -> Float64[np.ndarray, "s z"]:
    """How far before the plane the wall lies: as measured around each cell (reveals and ledges),
    and else as its house stands there."""
    from scipy.ndimage import gaussian_filter

    is_used = cells.is_met & (np.abs(cells.offset_m) < _OFFSET_LIMIT_M)
    level = _house_level_m(cells.offset_m, is_used, round(_HOUSE_REACH_M / cells.cell_m))[:, None]
    spread = 1.0 / cells.cell_m
    beside = np.where(is_used, cells.offset_m - level, 0.0)
    total = np.asarray(gaussian_filter(beside, spread))
    fraction = np.asarray(gaussian_filter(is_used.astype(np.float64), spread))
    return level + total / (fraction + _LEVEL_WEIGHT)


def _house_level_m(
    offset_m: Float64[np.ndarray, "s z"], is_used: Bool[np.ndarray, "s z"], reach: int
) -> Float64[np.ndarray, " s"]:
    """Upper quartile of what was measured in the columns around each: houses of one plane are set
    back by a few centimetres, an upright wall keeps its way out, and panes lie behind it."""
    known = np.flatnonzero(is_used.any(axis=1))
    if len(known) == 0:
        return np.zeros(len(offset_m))
    measured = np.where(is_used, offset_m, np.nan)
    level = [np.nanpercentile(measured[max(k - reach, 0) : k + reach + 1], 75) for k in known]
    nearest = np.abs(np.arange(len(offset_m))[:, None] - known).argmin(axis=1)
    return np.array(level)[nearest]


def _mesh_cells(
    cells: WallCells,
    is_filled: Bool[np.ndarray, "s z"],
    offset: Float64[np.ndarray, "s z"],
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
    out = np.pad(offset, ((0, 1), (0, 1)), mode="edge") - _OVERLAP_M
    place = np.indices(out.shape)
    s = cells.wall.span_m[0] + place[0] * cells.cell_m
    z = cells.wall.height_m[0] + place[1] * cells.cell_m
    points = cells.wall.at(s, z) + out[..., None] * cells.wall.normal
    return quad_mesh(points.reshape(-1, 3), quads, FACADE)
