"""Completion of buildings: holes in measured walls are closed and walls are raised to their roofs.

Beams pass through glass, and the LiDAR's highest channel limits the measured height. The missing
parts of a building are added on the planes of its measured walls (`glass` decides which of them are
glass); each wall is the front of an upright prism. Parts that some view shows belong to the visible
mesh and are textured from the images. Parts that no view shows (roofs, rear walls, the tops of
houses near the road) only cast shadows (`prisms`).
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

# Largest offset of measured surface from the wall's plane that counts as the wall, in metres: bays
# and canopies are further out. Chosen on log 002; sensitivity not measured.
_OFFSET_LIMIT_M = 0.3
# Distance along the wall within which columns determine the offset of their house, in metres.
# Chosen on log 002; not measured alone.
_HOUSE_REACH_M = 2.0
# Weight of the house's offset against the measured offsets around a cell, as a fraction of the
# cells around. Small, so that it matters only far from measured cells; not measured alone.
_LEVEL_WEIGHT = 0.1
# Depth by which added surface lies behind measured wall at its border, in metres, so that the two
# do not intersect visibly.
_OVERLAP_M = 0.03


@dataclass(frozen=True, eq=False)
class MeasuredScene:
    """Measured surfaces, frame world.

    Args:
        background: static surfaces, outward faces counter-clockwise.
        walls: planes in the background (`walls.find_walls`).
        crowns: foliage, which is continued upward as leaves.
        parked: vehicles at rest, which hide the surface behind them.
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
    """Add visible unmeasured parts of buildings and upright objects; estimate rooflines.

    Args:
        scene: the measured surfaces.
        silhouettes: returns frames with their camera (of the matte's size) and sky matte; it is
            called several times.
        sweeps: LiDAR sweeps; beams that pass above a wall limit its height.
        ground: reference of heights.
        beams: beams that ended on static surfaces, from which sparse and distant walls are found.
        make_caster: builds the ray caster.

    Returns:
        The added mesh, frame world, black: interpolated where it closes holes, else inferred; and
            one roofline for each measured or distant wall.

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
        # Sparse walls are mostly sides of houses whose fronts have roofs already; a second estimate
        # of the height would cast a second shadow.
        rooflines = rooflines[: len(known)]
    # Raised walls come first: they explain surface that views show above objects in front of them.
    raised = concatenate_meshes([background, *parts])
    caster = make_caster([raised])
    uprights = raise_uprights(raised, silhouettes, ground, caster, scene.crowns, standing)
    return concatenate_meshes([*parts, uprights]), rooflines


def _visible_parts(walls: Sequence[WallCells], rooflines: Sequence[Roofline]) -> Iterator[TriMesh]:
    """Yield the panes of each wall, and its surface above the highest beam that views show."""
    for cells, roofline in zip(walls, rooflines, strict=True):
        offset = _smooth_offset_m(cells)
        is_pane = find_panes(cells)
        is_upper = _unmeasured(cells, roofline) & ~is_pane
        for is_filled, source in (
            (is_pane, Provenance.INTERPOLATED),
            (is_upper, Provenance.INFERRED),
        ):
            if is_filled.any():
                yield _mesh_cells(cells, is_filled, offset).with_provenance(source)


def _unmeasured(cells: WallCells, roofline: Roofline) -> Bool[np.ndarray, "s z"]:
    """Return the unmeasured cells that some view shows.

    These lie above the measured part of the wall up to its roof, or below it without evidence
    against them (distant walls), or at its foot behind parked vehicles.
    """
    levels = np.arange(cells.sky.shape[1])
    end = np.minimum(roofline.top, roofline.shown)
    if cells.is_far:
        return ~cells.is_covered & (cells.sky == 0) & (levels < end[:, None])
    is_plain = (cells.matter > 0) | (cells.through == 0)
    is_plain &= (cells.sky == 0) & (cells.passes == 0) & ~cells.is_covered
    is_plain &= levels < cells.measured_top[:, None]
    return (is_plain | (levels > cells.front_top[:, None])) & (levels < end[:, None])


def _smooth_offset_m(cells: WallCells) -> Float64[np.ndarray, "s z"]:
    """Return the offset of the wall in front of its plane, in metres, at every cell.

    It is the measured offset around each cell (reveals and ledges), else the offset of the house.
    """
    from scipy.ndimage import gaussian_filter

    is_used = cells.is_met & (np.abs(cells.offset_m) < _OFFSET_LIMIT_M)
    level = _house_level_m(cells.offset_m, is_used, round(_HOUSE_REACH_M / cells.cell_m))[:, None]
    sigma = 1.0 / cells.cell_m
    beside = np.where(is_used, cells.offset_m - level, 0.0)
    total = np.asarray(gaussian_filter(beside, sigma))
    fraction = np.asarray(gaussian_filter(is_used.astype(np.float64), sigma))
    return level + total / (fraction + _LEVEL_WEIGHT)


def _house_level_m(
    offset_m: Float64[np.ndarray, "s z"], is_used: Bool[np.ndarray, "s z"], reach: int
) -> Float64[np.ndarray, " s"]:
    """Return the upper quartile of the offsets measured around each column, in metres.

    Houses of one plane are set back by a few centimetres each. The upper quartile is used because
    panes lie behind the wall.
    """
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
    """Return the filled cells as a mesh of two triangles a cell with common corners."""
    from scipy.ndimage import binary_dilation

    # One ring of measured cells is drawn too, so that no gap opens at the border.
    is_drawn = np.asarray(binary_dilation(is_filled, np.ones((3, 3), dtype=bool)))
    is_drawn = is_filled | (is_drawn & cells.is_covered)
    i, j = np.nonzero(is_drawn)
    across = is_filled.shape[1] + 1
    corner = i * across + j
    # Counter-clockwise from outside: `along` runs from left to right for an observer outside.
    quads = np.stack([corner, corner + across, corner + across + 1, corner + 1], axis=1)
    out = np.pad(offset, ((0, 1), (0, 1)), mode="edge") - _OVERLAP_M
    place = np.indices(out.shape)
    s = cells.wall.span_m[0] + place[0] * cells.cell_m
    z = cells.wall.height_m[0] + place[1] * cells.cell_m
    points = cells.wall.at(s, z) + out[..., None] * cells.wall.normal
    return quad_mesh(points.reshape(-1, 3), quads, FACADE)
