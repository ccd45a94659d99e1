"""Completion of buildings: holes in measured walls are closed and walls are raised to their roofs.

Beams pass through glass, and the LiDAR's highest channel limits the measured height. The missing
parts of a building are added on the planes of its measured walls (`glass` decides which of them are
glass); each wall is the front of an upright prism. Parts that some view shows belong to the visible
mesh and are textured from the images. Parts that no view shows (roofs, rear walls, the tops of
houses near the road) only cast shadows (`prisms`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float64

from lightsim.core.buildings import Roofline
from lightsim.core.casting import check_world
from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.completion.free_space import find_free_space
from lightsim.geometry.completion.neighbours import raised_to_neighbours
from lightsim.geometry.completion.rooflines import find_rooflines, with_depths
from lightsim.geometry.completion.scene import Inputs, Scene
from lightsim.geometry.completion.wall_cells import (
    MAX_HEIGHT_M,
    WallCells,
    gather_cells,
    with_returns,
)
from lightsim.geometry.completion.wall_holes import find_wall_holes
from lightsim.geometry.materials import FACADE
from lightsim.geometry.surface import quad_mesh

# Largest offset of measured surface from the wall's plane that counts as the wall, in metres: bays
# and canopies are further out. Chosen on log 002; sensitivity not measured.
_OFFSET_LIMIT_M = 0.3
# Distance along the wall within which columns determine the offset of their house, in metres.
# Chosen on log 002; not measured alone.
_HOUSE_REACH_M = 2.0
# Weight of the house's offset in the mean with the measured offsets around a cell, as a fraction of
# the number of these cells. Small, so that it has an effect only far from them; not measured alone.
_LEVEL_WEIGHT = 0.1
# Depth by which added surface lies behind measured wall at its border, in metres, so that the two
# do not intersect visibly.
_OVERLAP_M = 0.03


def complete_walls(inputs: Inputs, scene: Scene) -> tuple[list[TriMesh], list[Roofline]]:
    """Add the visible unmeasured parts of walls, and estimate the roofline of each.

    Returns:
        The added meshes, frame world, black: interpolated where they close holes, else inferred;
            and one roofline for each wall and distant wall.

    Raises:
        FrameMismatchError: the mesh is not in frame world.
        InputError: a matte does not fit its camera.
    """
    check_world([scene.background])
    if not scene.walls:
        return [], []
    make_caster, evidence = inputs.make_caster, inputs.evidence
    cells = gather_cells(inputs, scene)
    cells = [with_returns(c, inputs.beams.ends) if c.is_far else c for c in cells]
    rooflines = find_rooflines(cells, inputs.ground)
    fronts = concatenate_meshes([scene.background, *_visible_parts(cells, rooflines)])
    space = find_free_space(fronts, evidence, make_caster([fronts]), MAX_HEIGHT_M)
    rooflines = with_depths(cells, rooflines, space)
    parts = [*_visible_parts(cells, raised_to_neighbours(rooflines))]
    return parts, rooflines


def _visible_parts(walls: Sequence[WallCells], rooflines: Sequence[Roofline]) -> Iterator[TriMesh]:
    """Yield the panes of each wall, and its surface above the highest beam that views show."""
    for cells, roofline in zip(walls, rooflines, strict=True):
        offset = _smooth_offset_m(cells)
        is_pane = find_wall_holes(cells)
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
    is_plain = (cells.surface_views > 0) | (cells.background_views == 0)
    is_plain &= (cells.sky == 0) & (cells.passing_beams == 0) & ~cells.is_covered
    is_plain &= levels < cells.measured_top[:, None]
    return (is_plain | (levels > cells.front_top[:, None])) & (levels < end[:, None])


def _smooth_offset_m(cells: WallCells) -> Float64[np.ndarray, "s z"]:
    """Return the offset of the wall in front of its plane, in metres, at every cell.

    It is the measured offset around each cell (reveals and ledges), else the offset of the house.
    """
    from scipy.ndimage import gaussian_filter

    is_used = cells.is_measured & (np.abs(cells.offset_m) < _OFFSET_LIMIT_M)
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
