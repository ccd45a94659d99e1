"""Upright objects above measured surface that are no walls: masts, posts, crowns above the beams.

The LiDAR's highest channel limits measured objects; images show their upper parts. Above the top of
each measured column of space, cells are filled as long as views show a surface there that no
measured surface explains, with sky on both sides near by (visual hull, Laurentini 1994,
doi:10.1109/34.273735). A surface without sky beside it may lie anywhere behind.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int8, Int64

from lightsim.core.casting import RayCaster, check_world
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.geometry.completion.leaf_cards import cards_above
from lightsim.geometry.completion.scene import Inputs, Scene
from lightsim.geometry.completion.upright_meshes import CELL_M, upright_mesh
from lightsim.geometry.completion.view_evidence import (
    DEPTH_M,
    OBJECT_VIEW_M,
    View,
    odds_of_views,
)
from lightsim.geometry.completion.walls import lie_on
from lightsim.geometry.materials import VEGETATION

# The values below were chosen on log 002; their joint effect was measured there.

# Height above the ground below which columns are not extended, in metres: cars, people, hedges.
_LEAST_HEIGHT_M = 2.0
# Distance from a wall's plane within which columns are not extended, in metres: the step of roofs
# estimates the wall's upper edge from all evidence.
_ON_WALL_M = 0.3
# Greatest extension of a column, in metres.
_MOST_ADDED_M = 12.0
# Greatest distance between the sky on both sides of a free-standing object, in metres: the largest
# common billboards are 48 feet (14.6 m) wide.
_WIDTH_M = 16.0
# Least number of views that must show a surface in the lowest cell; that of one view may lie
# anywhere behind.
_LEAST_VIEWS = 3


@dataclass(eq=False)
class _Columns:
    """Columns of space at the top of measured surface.

    Args:
        cell: index in x and y, unique.
        place_m: x and y of the uppermost measured surface, and its top z.
        is_green: whether most of that surface is vegetation.
        matter, sky: number of views that show each cell above as surface or as sky.
    """

    cell: Int64[np.ndarray, "n 2"]
    place_m: Float64[np.ndarray, "n 3"]
    is_green: Bool[np.ndarray, " n"]
    matter: Int64[np.ndarray, "n z"]
    sky: Int64[np.ndarray, "n z"]

    def some(self, chosen: Bool[np.ndarray, " n"]) -> _Columns:
        return _Columns(
            self.cell[chosen],
            self.place_m[chosen],
            self.is_green[chosen],
            self.matter[chosen],
            self.sky[chosen],
        )


def raise_uprights(inputs: Inputs, scene: Scene) -> TriMesh:
    """Add the cells above measured columns that views show; inferred, black.

    Cells on crowns contain leaves, others are solid (`upright_meshes`).

    Raises:
        InputError: a matte does not fit its camera.
    """
    check_world([scene.background])
    crowns, caster = scene.crowns, scene.caster(inputs.make_caster)
    columns = _find_columns(scene.background, inputs.ground)
    walls = [*scene.walls, *scene.far_walls]
    columns = columns.some(~lie_on(walls, columns.place_m, _ON_WALL_M))
    levels = round(_MOST_ADDED_M / CELL_M)
    # Two passes save time: most columns end in their first two cells.
    for first, last in ((0, 2), (2, levels)):
        for view in inputs.evidence.views():
            _look(columns, (first, last), view, caster)
        is_alive = (_height(columns, last) == last) & (columns.matter[:, 0] >= _LEAST_VIEWS)
        columns = columns.some(is_alive if last < levels else columns.matter[:, 0] > 0)
    height, is_crown = _height(columns, levels), crowns.contain(columns.place_m)
    # Vegetation on measured surface is a crown too, although `crowns` has no voxel there.
    is_crown |= columns.is_green & (len(crowns) > 0)
    is_solid = (height > 0) & ~is_crown
    solid_mesh = upright_mesh(
        columns.cell[is_solid], columns.place_m[is_solid, 2], height[is_solid]
    )
    column = np.repeat(np.flatnonzero(is_crown), height[is_crown])
    if not len(column):
        return solid_mesh
    level = np.concatenate([np.arange(count) for count in height[is_crown]])
    middle = columns.place_m[column]
    middle[:, :2] = (columns.cell[column] + 0.5) * CELL_M
    middle[:, 2] += (level + 0.5) * CELL_M
    leaves = cards_above(crowns, middle, CELL_M, np.random.default_rng(0))
    return concatenate_meshes([solid_mesh, leaves])


def _find_columns(background: TriMesh, ground: GroundMap) -> _Columns:
    centres = background.vertices[background.faces].mean(axis=1).astype(np.float64)
    cell, row = np.unique(
        np.floor(centres[:, :2] / CELL_M).astype(np.int64), axis=0, return_inverse=True
    )
    row = row.reshape(-1)
    top = np.full(len(cell), -np.inf)
    np.maximum.at(top, row, centres[:, 2])
    is_upper = centres[:, 2] > top[row] - 2 * CELL_M
    count = np.maximum(np.bincount(row[is_upper], minlength=len(cell)), 1)
    place = [np.bincount(row[is_upper], centres[is_upper, k], len(cell)) / count for k in (0, 1)]
    green = [k for k, material in enumerate(background.materials) if material == VEGETATION]
    material = background.face_material
    kind = np.zeros(len(centres), np.uint8) if material is None else material
    is_green = np.isin(kind, green) & is_upper
    is_green = np.bincount(row[is_green], minlength=len(cell)) > 0.5 * count
    is_high = top - ground.look_up(np.stack(place, axis=1)) > _LEAST_HEIGHT_M
    shape = (int(is_high.sum()), round(_MOST_ADDED_M / CELL_M))
    places = np.stack([*place, top], axis=1)[is_high]
    none = np.zeros(shape, np.int64)
    return _Columns(cell[is_high], places, is_green[is_high], none, none.copy())


def _look(
    columns: _Columns,
    levels: tuple[int, int],
    view: View,
    caster: RayCaster,
) -> None:
    """Count the levels of columns that one view shows as sky or as surface.

    Hidden points are ignored, and surface that is measured behind or has no sky beside it.
    """
    eye, kinds = view.frame.world_from_camera.translation_m, view.kinds
    near = np.flatnonzero(np.linalg.norm(columns.place_m[:, :2] - eye[:2], axis=1) < OBJECT_VIEW_M)
    height = (np.arange(*levels) + 0.5) * CELL_M
    points = np.repeat(columns.place_m[near][:, None], len(height), axis=1)
    points[..., 2] += height
    lines = view.lines(points.reshape(-1, 3), np.inf)
    rows, level = np.divmod(lines.row, len(height))
    rows, level = near[rows], level + levels[0]
    kind = kinds[lines.pixel]
    np.add.at(columns.sky, (rows[kind > 0], level[kind > 0]), 1)
    reach_px = _WIDTH_M * view.camera.fx / lines.distance_m
    is_matter = (kind < 0) & (_free_width_px(kinds)[lines.pixel] < reach_px)
    matter = lines.some(is_matter)
    beyond_m = matter.beyond_m(caster)
    is_matter[is_matter] = np.isinf(beyond_m) | (np.abs(beyond_m) < DEPTH_M)
    np.add.at(columns.matter, (rows[is_matter], level[is_matter]), 1)


def _free_width_px(kinds: Int8[np.ndarray, "h w"]) -> Int64[np.ndarray, "h w"]:
    """Return the distance along the row between the next sky left and right, in pixels."""
    width = kinds.shape[1]
    column = np.arange(width)
    is_sky = kinds > 0
    left = np.maximum.accumulate(np.where(is_sky, column, -width), axis=1)
    right = np.minimum.accumulate(np.where(is_sky, column, 2 * width)[:, ::-1], axis=1)[:, ::-1]
    return right - left


def _height(columns: _Columns, levels: int) -> Int64[np.ndarray, " n"]:
    """Return the most probable number of filled cells of each column."""
    total = np.cumsum(odds_of_views(columns.matter, columns.sky)[:, :levels], axis=1)
    best = total.argmax(axis=1)
    return np.where(total[np.arange(len(total)), best] > 0, best + 1, 0)
