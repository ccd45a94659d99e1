"""Evidence of images and LiDAR in the plane of each wall, cell by cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from scipy.ndimage import maximum_filter

from lightsim.core.buildings import Wall
from lightsim.core.casting import RayCaster
from lightsim.core.sensors import LidarSweep
from lightsim.geometry.completion.pitched_roofs import PitchedRoof, lowest_roof_m
from lightsim.geometry.completion.scene import Inputs, Scene
from lightsim.geometry.completion.view_evidence import (
    DEPTH_TOLERANCE_M,
    MIN_BASELINE_M,
    WALL_VIEW_M,
    View,
)
from lightsim.geometry.completion.walls import WALL_CELL_M, returns_near, surface_offset_m

# The values below were chosen on log 002 and street 0; only their joint effect was measured
# (docs/benchmarks/reconstruction.md).

# Distance in front of the plane up to which measured surface belongs to the wall, in metres.
FRONT_M = 0.5
# Distance behind the plane up to which measured surface belongs to the wall, in metres: panes are
# set back in their frames.
BEHIND_M = 0.6
# Greatest height of a building above the lowest measured part of its wall, in metres.
MAX_HEIGHT_M = 40.0
# Height of sky on a wall up to which it may be a reflection in a pane, in metres.
_REFLECTED_M = 0.5
# Distance up to which walls return beams with certainty, in metres.
_MAX_BEAM_M = 60.0
# Elevation below the highest beam up to which cells are certain to be reached, in degrees: the
# highest channels are that far apart.
_BEAM_MARGIN_DEG = 1.5
# Distance around a return within which missing returns are no evidence, in metres: the spacing of
# beams on walls.
_RETURN_REACH_M = 1.0
# Subsampling of the returns that are tested for passing a wall, to limit the time.
_EVERY_NTH_RETURN = 4


@dataclass(frozen=True, eq=False)
class SurfaceSighting:
    """Cells of a wall at which one view shows a surface that is not in the measured mesh.

    Args:
        eye_m: position of the camera, frame world.
        rows: rows of the flattened cells.
    """

    eye_m: Float64[np.ndarray, "3"]
    rows: Int32[np.ndarray, " n"]


@dataclass(eq=False)
class WallCells:
    """Cells [s, z] of one wall from its lowest measured part up, with their evidence.

    Args:
        wall: the plane.
        cell_m: edge of a cell.
        is_covered: measured surface lies on the plane at the centre of the cell.
        is_whole: it also lies at the centres of the cell's quarters; otherwise it may be a window
            bar.
        offset_m: offset of that surface in front of the plane, or of the returns in a cell of a
            distant wall; 0 elsewhere.
        sky: number of views that show sky.
        surface_views: number of views that show a surface, with no measured surface before or
            behind it.
        background_views: number of views that show measured surface well behind the wall.
        passing_beams: number of beams that passed the cell and ended behind it.
        sweeps_without_return: number of sweeps with unobstructed beams through the cell and no
            return within 1 m.
        sightings: the views that `surface_views` counts.
        is_measured: covered, or a cell of a distant wall with a return.
        roof_m: height of the pitched roof above each column; infinite if none is known.
        is_far: the wall is known from returns alone.
    """

    wall: Wall
    cell_m: float
    is_covered: Bool[np.ndarray, "s z"]
    is_whole: Bool[np.ndarray, "s z"]
    offset_m: Float64[np.ndarray, "s z"]
    sky: Int32[np.ndarray, "s z"]
    surface_views: Int32[np.ndarray, "s z"]
    background_views: Int32[np.ndarray, "s z"]
    passing_beams: Int32[np.ndarray, "s z"]
    sweeps_without_return: Int32[np.ndarray, "s z"]
    sightings: list[SurfaceSighting]
    is_measured: Bool[np.ndarray, "s z"]
    roof_m: Float64[np.ndarray, " s"]
    is_far: bool = False

    @property
    def s_m(self) -> Float64[np.ndarray, " s"]:
        """Centre of each column along the wall."""
        return self.wall.span_m[0] + (np.arange(self.sky.shape[0]) + 0.5) * self.cell_m

    @property
    def measured_top(self) -> Int32[np.ndarray, " s"]:
        """Highest measured cell of each column; -1 without any."""
        levels = np.arange(self.sky.shape[1], dtype=np.int32)
        return np.where(self.is_measured, levels, -1).max(axis=1)

    @property
    def is_hidden(self) -> Bool[np.ndarray, "s z"]:
        """Unobserved cells below measured surface: parked cars hide the wall's foot."""
        levels = np.arange(self.sky.shape[1])
        is_seen = self.is_measured | (
            self.sky + self.surface_views + self.background_views + self.passing_beams > 0
        )
        return ~is_seen & (levels < self.measured_top[:, None])

    @property
    def front_top(self) -> Float64[np.ndarray, " s"]:
        """Highest measured cell of each column, interpolated between measured columns."""
        top = self.measured_top
        columns, known = np.arange(len(top)), np.flatnonzero(top >= 0)
        return np.interp(columns, known, top[known]) if len(known) else top.astype(np.float64)

    def has(self, places: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return whether places, relative to the plane's origin, project onto a cell."""
        i, j = self._index(places)
        shape = self.sky.shape
        return (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])

    def index_of(
        self, places: Float64[np.ndarray, "n 3"]
    ) -> tuple[Int64[np.ndarray, " m"], Int64[np.ndarray, " m"]]:
        """Return the cell indices of points relative to the plane's origin, without points outside
        the grid."""
        i, j = self._index(places[self.has(places)])
        return i.astype(np.int64), j.astype(np.int64)

    def _index(
        self, places: Float64[np.ndarray, "n 3"]
    ) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        i = np.floor((places @ self.wall.along - self.wall.span_m[0]) / self.cell_m)
        return i, np.floor((places[:, 2] - self.wall.height_m[0]) / self.cell_m)

    def centres(self) -> Float64[np.ndarray, "s z 3"]:
        """Return the centre of each cell on the wall's plane, frame world."""
        return self.wall.at(*self.wall.grid(self.cell_m, self.sky.shape))


def gather_cells(inputs: Inputs, scene: Scene) -> list[WallCells]:
    """Collect the evidence of all views and sweeps for each wall.

    Returns:
        Cells of measured walls, then of distant walls.

    Raises:
        InputError: a matte does not fit its camera.
    """
    caster = scene.caster(inputs.make_caster)
    roofs = scene.pitched_roofs
    cells = [_measure(wall, roofs, caster) for wall in scene.walls]
    cells += [replace(_measure(wall, roofs, caster), is_far=True) for wall in scene.far_walls]
    caster = scene.caster(inputs.make_caster, with_parked=True)
    low_sky_views = [np.zeros_like(wall_cells.sky) for wall_cells in cells]
    for view in inputs.evidence.views():
        for pair in zip(cells, low_sky_views, strict=True):
            _add_view(*pair, view, caster)
    for wall_cells, glimpse in zip(cells, low_sky_views, strict=True):
        # Panes reflect the sky into few views, so the majority of views counts.
        wall_cells.sky += np.where(glimpse > wall_cells.surface_views, glimpse, 0)
    returns = [np.zeros_like(wall_cells.is_covered) for wall_cells in cells]
    last = np.full(3, np.inf)
    for sweep in inputs.sweeps():
        place = sweep.origins_world.mean(axis=0).astype(np.float64)
        is_apart = not np.linalg.norm(place - last) < MIN_BASELINE_M
        last = place if is_apart else last
        for wall_cells, has_return in zip(cells, returns, strict=True):
            _count_passing_beams(wall_cells, sweep, has_return)
            if is_apart:
                _count_sweeps_without_return(wall_cells, place, _highest_beam_deg(sweep), caster)
    for wall_cells, has_return in zip(cells, returns, strict=True):
        reach = round(_RETURN_REACH_M / wall_cells.cell_m)
        is_near = np.asarray(maximum_filter(has_return, 2 * reach + 1), dtype=bool)
        wall_cells.sweeps_without_return[is_near] = 0
        if wall_cells.is_far:
            wall_cells.is_measured |= has_return
    return cells


def with_returns(cells: WallCells, returns_world: Float32[np.ndarray, "n 3"]) -> WallCells:
    """Set the offset of a distant wall's cells to that of their returns.

    Houses of a row are set back differently, and their common plane is extended over a long
    distance.
    """
    near = returns_near(cells.wall, returns_world, (FRONT_M, BEHIND_M)) - cells.wall.origin_m
    near = near[cells.has(near)]
    at, out = cells.index_of(near), near @ cells.wall.normal
    count, total = (np.zeros(cells.sky.shape) for _ in range(2))
    np.add.at(count, at, 1.0)
    np.add.at(total, at, out)
    return replace(
        cells, offset_m=total / np.maximum(count, 1), is_measured=cells.is_measured | (count > 0)
    )


def _measure(wall: Wall, roofs: Sequence[PitchedRoof], caster: RayCaster) -> WallCells:
    """Return the cells of a wall with their measured surface and no other evidence."""
    cell = WALL_CELL_M
    ns = max(int(np.ceil((wall.span_m[1] - wall.span_m[0]) / cell)), 1)
    shape = (ns, int(np.ceil(MAX_HEIGHT_M / cell)))
    counts = [np.zeros(shape, dtype=np.int32) for _ in range(5)]
    near_m = (FRONT_M, BEHIND_M)
    offset = surface_offset_m(wall, *wall.grid(cell, shape), caster, near_m)
    fine = wall.grid(cell / 2, (2 * shape[0], 2 * shape[1]))
    quarters = np.isfinite(surface_offset_m(wall, *fine, caster, near_m))
    is_covered = np.isfinite(offset)
    is_whole = is_covered & quarters.reshape(shape[0], 2, shape[1], 2).all(axis=(1, 3))
    cells = WallCells(
        wall,
        cell,
        is_covered,
        is_whole,
        np.nan_to_num(offset),
        *counts,
        sightings=[],
        is_measured=is_covered.copy(),
        roof_m=np.zeros(ns),
    )
    behind = wall.at(cells.s_m, np.zeros(ns), -0.5 * BEHIND_M)
    roof_m = lowest_roof_m(roofs, behind)
    # A wall with measured surface above a roof does not belong to the house of that roof.
    top_m = wall.height_m[0] + cell * (cells.measured_top + 1)
    roof_m[top_m > roof_m + BEHIND_M] = np.inf
    return replace(cells, roof_m=roof_m)


def _add_view(
    cells: WallCells, low_sky_views: Int32[np.ndarray, "s z"], view: View, caster: RayCaster
) -> None:
    """Add the evidence of one view at the cells without measured surface.

    `low_sky_views` counts low areas of sky, which may be reflections, the image's border or an
    overhang.
    """
    eye = view.frame.world_from_camera.translation_m
    if (eye - cells.wall.origin_m) @ cells.wall.normal < FRONT_M:
        return
    rows = np.flatnonzero(~cells.is_covered.ravel())
    sightlines = view.sightlines(cells.centres().reshape(-1, 3)[rows], WALL_VIEW_M)
    kind = view.classes_at(sightlines)
    surface_lines = sightlines.select(kind < 0)
    beyond_m = surface_lines.beyond_m(caster)
    # Measured surface further behind explains the pixel without the wall.
    shown = rows[surface_lines.row[(np.abs(beyond_m) < DEPTH_TOLERANCE_M) | np.isinf(beyond_m)]]
    cells.surface_views.reshape(-1)[shown] += 1
    cells.sightings.append(SurfaceSighting(eye, shown.astype(np.int32)))
    is_background = (beyond_m > 2 * DEPTH_TOLERANCE_M) & np.isfinite(beyond_m)
    cells.background_views.reshape(-1)[rows[surface_lines.row[is_background]]] += 1
    is_sky = np.zeros(cells.sky.size, dtype=bool)
    is_sky[rows[sightlines.row[kind > 0]]] = True
    is_sky = is_sky.reshape(cells.sky.shape)
    above_m = np.cumsum(is_sky[:, ::-1], axis=1)[:, ::-1] * cells.cell_m
    cells.sky[is_sky & (above_m > _REFLECTED_M)] += 1
    low_sky_views[is_sky & (above_m <= _REFLECTED_M)] += 1


def _count_passing_beams(
    cells: WallCells, sweep: LidarSweep, has_return: Bool[np.ndarray, "s z"]
) -> None:
    """Count the beams of a sweep that ended well behind each cell; mark cells with returns."""
    wall, step = cells.wall, _EVERY_NTH_RETURN
    start = sweep.origins_world[::step].astype(np.float64) - wall.origin_m
    end = sweep.points_world[::step].astype(np.float64) - wall.origin_m
    before, after = start @ wall.normal, end @ wall.normal
    has_return[cells.index_of(end[(after > -BEHIND_M) & (after < FRONT_M)])] = True
    crosses = (before > FRONT_M) & (after < -2 * BEHIND_M)
    start, end = start[crosses], end[crosses]
    fraction = (before[crosses] / (before[crosses] - after[crosses]))[:, None]
    place = start + fraction * (end - start)
    np.add.at(cells.passing_beams, cells.index_of(place), 1)


def _highest_beam_deg(sweep: LidarSweep) -> float:
    """Return the elevation up to which the sweep has returns, in degrees."""
    way = (sweep.points_world - sweep.origins_world).astype(np.float64)
    elevation = np.arctan2(way[:, 2], np.linalg.norm(way[:, :2], axis=1))
    return float(np.degrees(np.percentile(elevation, 99.9))) if len(way) else -90.0


def _count_sweeps_without_return(
    cells: WallCells, eye: Float64[np.ndarray, "3"], highest_deg: float, caster: RayCaster
) -> None:
    """Count a sweep at open cells that its beams reach: a wall there would have returned beams."""
    if (eye - cells.wall.origin_m) @ cells.wall.normal < FRONT_M:
        return
    rows = np.flatnonzero(~cells.is_covered.ravel())
    way = cells.centres().reshape(-1, 3)[rows] - eye
    distance = np.linalg.norm(way, axis=1)
    elevation = np.degrees(np.arcsin(way[:, 2] / distance))
    is_reached = (elevation < highest_deg - _BEAM_MARGIN_DEG) & (distance < _MAX_BEAM_M)
    rows, rays = rows[is_reached], (way / distance[:, None])[is_reached]
    hits = caster.intersect(np.broadcast_to(eye, rays.shape).copy(), rays)
    is_open = hits.distance_m > distance[is_reached] - BEHIND_M
    cells.sweeps_without_return.reshape(-1)[rows[is_open]] += 1
