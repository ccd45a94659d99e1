"""Poles, posts and trunks as upright rods fitted to LiDAR returns.

A rod is a vertical cluster of returns on successive levels with free space around it. Its measured
part is fitted by one tapering cylinder, which is extended above the highest beam from the images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from scipy import ndimage
from scipy.optimize import least_squares
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from lightsim.core.fields import GroundMap
from lightsim.core.statistics import charbonnier_roots
from lightsim.geometry.completion.rods import (
    MIN_RADIUS_M,
    REACH_M,
    Pole,
    ends_openly,
    is_free_standing,
)
from lightsim.geometry.completion.view_evidence import (
    DETAIL_VIEW_M,
    SKY_LOG_ODDS,
    SURFACE_LOG_ODDS,
    UNOBSERVED_LOG_ODDS,
    ViewEvidence,
)
from lightsim.geometry.surface import path_distance_m


class _Search:
    """Search for rods in columns of space."""

    heights_m = (0.15, 12.0)  # Heights above the ground that are searched.
    cell_m = 0.1  # Width of a cell.
    level_m = 0.25  # Height of a level.
    own_cells = 2  # Distance within which a rod's returns lie, in cells and levels.
    clear_cells = 7  # Distance up to which nothing else may lie, in cells.
    max_around = 2  # Tolerated number of other returns within that distance.
    around = 0.15  # Tolerated ratio of other returns to the rod's own; the larger limit counts.
    min_levels = 3  # Least number of levels.
    every_nth_beam = 4  # Subsampling of the beams that test a rod, to limit the time.


class _Fit:
    """Fit of a tapering cylinder: likelihood, priors and limits."""

    noise_m = 0.025  # Standard deviation of a return.
    independent = 50  # Greatest effective number of returns: errors of poses are common to many.
    radius_log_std = 0.25  # Prior standard deviation of the radius's logarithm.
    slant_std = 0.02  # Prior standard deviation of the slant of posts,
    taper_std = 0.015  # and of their taper.
    max_radius_m = 0.3  # Greatest radius.
    returns = (10, 1500)  # Least number of returns; number that are used, about.
    max_error_m = 0.035  # Greatest median distance of returns from the cylinder.


class _Images:
    """Extension of a rod above the beams."""

    step_m = 0.25  # Height of a level.
    max_added_m = 8.0  # Greatest extension.
    levels_below = 8  # Measured levels that give the usual contrast of the rod.
    min_lines = 12  # Least number of observations of this contrast.
    min_contrast = 8.0  # Least usual contrast, in 8-bit steps.
    line_log_odds = 0.5  # Log-odds of a view with or without half the usual contrast.


def find_poles(
    returns_world: Float32[np.ndarray, "n 3"],
    origins_world: Float32[np.ndarray, "n 3"],
    ground: GroundMap,
    path_m: Float64[np.ndarray, "k 3"],
) -> list[Pole]:
    """Find rods among the returns from static surfaces.

    Args:
        returns_world: LiDAR returns, frame world.
        origins_world: position of the sensor for each return.
        ground: reference of heights.
        path_m: positions of the sensor.
    """
    height = returns_world[:, 2] - ground.look_up(returns_world[:, :2].astype(np.float64))
    is_near = (height > _Search.heights_m[0]) & (height < _Search.heights_m[1])
    is_near &= path_distance_m(returns_world, path_m) < REACH_M
    points = returns_world[is_near].astype(np.float64)
    origins, height = origins_world[is_near].astype(np.float64), height[is_near]
    if len(points) == 0:
        return []
    low = points[:, :2].min(axis=0) - (_Search.clear_cells + 1) * _Search.cell_m
    cell = np.floor((points[:, :2] - low) / _Search.cell_m).astype(np.int64)
    level = np.floor((height - _Search.heights_m[0]) / _Search.level_m).astype(np.int64)
    found = [_fit(points[rows], origins[rows], ground) for rows in _rods(cell, level)]
    beams = origins_world[:: _Search.every_nth_beam], returns_world[:: _Search.every_nth_beam]
    free = [pole for pole in found if pole is not None and is_free_standing(pole, *beams)]
    return [replace(pole, is_open=ends_openly(pole, *beams)) for pole in free]


def _rods(
    cell: Int64[np.ndarray, "n 2"], level: Int64[np.ndarray, " n"]
) -> list[Int64[np.ndarray, " k"]]:
    """Return the rows of each rod's returns: cells above each other with clear surroundings."""
    shape = tuple((cell.max(axis=0) + _Search.clear_cells + 2).tolist())
    is_thin = np.zeros(len(cell), dtype=bool)
    for k in range(int(level.max()) + 1):
        rows = np.flatnonzero(level == k)
        is_thin[rows] = _is_thin(cell[rows], shape)
    rows = np.flatnonzero(is_thin)
    voxels, own = np.unique(np.column_stack([cell, level])[rows], axis=0, return_inverse=True)
    pairs = KDTree(voxels).query_pairs(_Search.own_cells, p=np.inf, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(voxels), len(voxels)))
    rod_of_voxel = connected_components(links, directed=False)[1]
    levels = np.bincount(np.unique(np.column_stack([rod_of_voxel, voxels[:, 2]]), axis=0)[:, 0])
    rod = rod_of_voxel[own.reshape(-1)]
    order = np.argsort(rod, kind="stable")
    order = order[levels[rod[order]] >= _Search.min_levels]
    return np.split(rows[order], np.flatnonzero(np.diff(rod[order])) + 1)


def _is_thin(cell: Int64[np.ndarray, "n 2"], shape: tuple[int, ...]) -> Bool[np.ndarray, " n"]:
    """Return which returns of one level have hardly any others around their rod."""
    grid = np.zeros(shape, np.float32)
    np.add.at(grid, tuple(cell.T), 1.0)

    def within(cells: int) -> Float32[np.ndarray, " n"]:
        width = 2 * cells + 1
        mean = np.asarray(ndimage.uniform_filter(grid, width, mode="constant"))
        return mean[tuple(cell.T)] * np.float32(width**2)

    own = within(_Search.own_cells)
    around = within(_Search.clear_cells) - own
    return around < np.maximum(_Search.max_around, _Search.around * own) + 0.5


def _fit(
    points: Float64[np.ndarray, "n 3"], origins: Float64[np.ndarray, "n 3"], ground: GroundMap
) -> Pole | None:
    """Fit a tapering cylinder to returns; None if it exceeds a limit."""
    if len(points) < _Fit.returns[0]:
        return None
    step = max(1, len(points) // _Fit.returns[1])
    points, origins = points[::step], origins[::step]
    centre = np.median(points, axis=0)
    offset, way = points - centre, (points - origins)[:, :2]
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    # An arc observed from one side fits circles of any radius; its width is the better evidence.
    beside = offset[:, 0] * way[:, 1] - offset[:, 1] * way[:, 0]
    width_m = max(float(np.ptp(np.percentile(beside, (3, 97)))) / 2, MIN_RADIUS_M)
    precision = min(1.0, np.sqrt(_Fit.independent / len(points))) / _Fit.noise_m

    def residuals(x: Float64[np.ndarray, " 6"]) -> Float64[np.ndarray, " r"]:
        across = offset[:, :2] - x[:2] - offset[:, 2:] * x[2:4]
        radius = np.exp(x[4]) + x[5] * offset[:, 2]
        error = precision * (np.linalg.norm(across, axis=1) - radius)
        prior = [
            x[2] / _Fit.slant_std,
            x[3] / _Fit.slant_std,
            (x[4] - np.log(width_m)) / _Fit.radius_log_std,
        ]
        return np.concatenate([error, prior, [x[5] / _Fit.taper_std]])

    start = np.array([*(width_m * way.mean(axis=0)), 0.0, 0.0, np.log(width_m), 0.0])
    x = least_squares(lambda x: charbonnier_roots(residuals(x)), start, method="lm").x
    error = np.abs(residuals(x)[: len(points)]) / precision
    radius = float(np.exp(x[4]))
    if np.median(error) > _Fit.max_error_m or radius > _Fit.max_radius_m:
        return None
    low, high = (float(v) for v in np.percentile(points[:, 2], (0.5, 99.5)))
    place = centre[:2] + x[:2]
    ground_m = float(ground.look_up(place[None])[0])
    # Hanging objects (wires, signs, branches) are shorter than the free space below them.
    if low - ground_m > high - low:
        return None
    fall = ground_m - float(centre[2])
    foot = np.array([*(place + fall * x[2:4]), ground_m])
    taper = float(x[5])
    at_foot = max(radius + taper * fall, MIN_RADIUS_M)
    return Pole(foot, x[2:4].copy(), at_foot, taper, (low, high), high)


def extend_poles(poles: Sequence[Pole], evidence: ViewEvidence) -> list[Pole]:
    """Extend poles upward as far as views show them.

    A view shows a pole in front of the sky, or as a line with the same contrast to both sides as at
    the measured heights.

    Args:
        poles: rods from `find_poles`.
        evidence: the views of the log.
    """
    if not poles:
        return []
    above = _Images.step_m * (np.arange(round(_Images.max_added_m / _Images.step_m)) + 0.5)
    levels = np.linspace(0.1, 0.9, _Images.levels_below)
    z = np.stack(
        [
            np.r_[p.measured_m[0] + levels * (p.measured_m[1] - p.measured_m[0]), p.top_m + above]
            for p in poles
        ]
    )
    points = np.stack([pole.axis_at(row) for pole, row in zip(poles, z, strict=True)])
    radius = np.stack([pole.radius_at(row) for pole, row in zip(poles, z, strict=True)])
    log_odds, contrasts = np.zeros(z.shape), [np.full(z.shape, np.nan)]
    for view in evidence.views():
        frame, camera = view.frame, view.camera
        distance = np.linalg.norm(points - frame.world_from_camera.translation_m, axis=-1)
        uv, is_inside = frame.project(camera, points.reshape(-1, 3))
        half_px = camera.fx * radius / distance
        beside_px = np.ceil(2 * half_px) + 2
        u, v = (uv[:, k].reshape(z.shape) for k in (0, 1))
        is_inside = is_inside.reshape(z.shape) & (distance < DETAIL_VIEW_M)
        is_inside &= (u > beside_px + 2) & (u < camera.width_px - beside_px - 3)
        if not is_inside.any():
            continue
        row, column, beside = (np.where(is_inside, a, 8) for a in (v, u, beside_px))
        pixels = row.astype(np.int64), column.astype(np.int64), beside.astype(np.int64)
        has_sky, is_shown = _before_sky(view.has_sky, pixels)
        log_odds += np.where(
            is_inside & has_sky, np.where(is_shown, SURFACE_LOG_ODDS, SKY_LOG_ODDS), 0.0
        )
        line = _line(frame.load_srgb8(), pixels)
        contrasts.append(np.where(is_inside & ~has_sky, line, np.nan))
    log_odds += _contrast_log_odds(np.stack(contrasts))
    log_odds = log_odds[:, _Images.levels_below :]
    total = np.cumsum(np.where(log_odds == 0, UNOBSERVED_LOG_ODDS, log_odds), axis=1)
    is_open = np.array([pole.is_open for pole in poles])
    count = np.where(is_open & (total.max(axis=1) > 0), total.argmax(axis=1) + 1, 0)
    return [
        replace(pole, top_m=pole.top_m + _Images.step_m * float(n))
        for pole, n in zip(poles, count, strict=True)
    ]


_Pixels = tuple[Int64[np.ndarray, "p z"], Int64[np.ndarray, "p z"], Int64[np.ndarray, "p z"]]
"""Row, column, and distance in columns to either side, for each pole and level."""


def _before_sky(
    is_sky: Bool[np.ndarray, "h w"], pixels: _Pixels
) -> tuple[Bool[np.ndarray, "p z"], Bool[np.ndarray, "p z"]]:
    """Return whether both sides show sky, and whether a surface lies between them."""
    row, column, beside = pixels
    has_sky = is_sky[row, column - beside] & is_sky[row, column + beside]
    # Poses have errors of about a pixel, so that the adjacent columns are used too.
    return has_sky, ~np.all([is_sky[row, column + k] for k in (-1, 0, 1)], axis=0)


def _line(image: UInt8[np.ndarray, "h w 3"], pixels: _Pixels) -> Float64[np.ndarray, "p z"]:
    """Return the difference of each place from the more similar of its sides, in 8-bit steps."""
    row, column, beside = pixels
    sides = [image[row, column + side].astype(np.float64) for side in (-beside, beside)]
    middles = [image[row, column + k].astype(np.float64) for k in (-1, 0, 1)]
    between = [np.min([np.abs(m - s).mean(axis=-1) for s in sides], axis=0) for m in middles]
    return np.max(between, axis=0)


def _contrast_log_odds(contrasts: Float64[np.ndarray, "v p z"]) -> Float64[np.ndarray, "p z"]:
    """Return the log-odds of each level from the views without sky beside it.

    The reference is the contrast at the measured levels; poles with low contrast have log-odds 0.
    """
    log_odds = np.zeros(contrasts.shape[1:])
    for k in range(contrasts.shape[1]):
        known = contrasts[:, k, : _Images.levels_below]
        known = known[np.isfinite(known)]
        if (
            len(known) < _Images.min_lines
            or (usual := float(np.median(known))) < _Images.min_contrast
        ):
            continue
        is_known = np.isfinite(contrasts[:, k])
        is_line = is_known & (np.where(is_known, contrasts[:, k], 0.0) > 0.5 * usual)
        log_odds[k] = _Images.line_log_odds * (2.0 * is_line.sum(axis=0) - is_known.sum(axis=0))
    return log_odds
