"""Poles, posts and trunks: upright rods that beams draw, and that a grid of samples breaks up.

A column of space is a rod where returns lie close together, level above level, with nothing around
them. What is measured of it becomes one tapering cylinder; pictures carry it on above the highest
beam.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from scipy import ndimage
from scipy.optimize import least_squares

from lightsim.core.fields import GroundMap
from lightsim.geometry.completion.silhouettes import (
    MIN_BASELINE_M,
    SKY_ALPHA,
    View,
    spaced_views,
)
from lightsim.geometry.surface import path_distance_m

# Chosen while looking at log 002 and the streets of seeds 0 and 77; what they bring is measured
# (docs/benchmarks/reconstruction.md).

# Beams are too far apart beyond.
_REACH_M = 35.0
_LOWEST_M, _HIGHEST_M = 0.15, 12.0
# Cells in which returns are counted: across, and upwards.
_CELL_M, _LEVEL_M = 0.1, 0.25
# A rod lies within the first distance and has nothing out to the second, but for a few returns or
# this fraction of its own.
_OWN_CELLS, _CLEAR_CELLS = 2, 7
_MOST_AROUND, _AROUND = 2, 0.15
# Levels on end, with one missing at most, that make a rod; fewer if it stands on the ground.
_LEAST_LEVELS, _LEAST_FROM_GROUND = 5, 3
_STANDS_WITHIN_M = 0.6
# Lower ends higher than this over the ground hang: wires, signs, branches.
_HANGS_M = 3.0
# Of the fit: noise of a return, and so many independent ones at most (path and calibration err,
# too); the radius against half of the width that is seen; slant and taper of posts.
_NOISE_M, _INDEPENDENT = 0.025, 50
_THINNEST_M, _RADIUS_LOG_STD = 0.03, 0.25
_LEAST_RADIUS_M, _MOST_RADIUS_M = 0.015, 0.3
_SLANT, _TAPER = 0.02, 0.015
_LEAST_RETURNS, _MOST_RETURNS = 10, 1500
# Median distance of the returns from the cylinder; most of its slant and of its taper.
_MOST_ERROR_M, _MOST_SLANT, _MOST_TAPER = 0.035, 0.08, 0.03
# Beams pass on both sides of a rod, this near and this far behind it, so many at least; and those
# that aim at it end there, but for a fraction; few end right beside it.
_BESIDE_M, _BEHIND_M, _LEAST_PASSES = (0.05, 0.6), 0.7, 4
_AT_M = 0.35
_LEAST_SOLID, _MOST_BESIDE = 0.6, 0.4
_EVERY_NTH_BEAM = 4
# So far above a rod beams are asked whether it ends.
_ABOVE_M = 0.8
# Above the beams: steps, how far, and log-odds of a view that shows the rod, or sky in its place.
_STEP_M, _MOST_ADDED_M = 0.25, 8.0
_SHOWN, _MISSING = 1.0, -2.0
_UNSEEN = -0.5
_MAX_VIEW_M = 40.0
# Log-odds of a view in which a place differs from both sides at least half as much as usual where
# beams met the rod; places, views and 8-bit steps that make the usual one known.
_LINE = 0.5
_LEVELS_BELOW, _LEAST_LINES, _LEAST_CONTRAST = 8, 12, 8.0


@dataclass(frozen=True, eq=False)
class Pole:
    """An upright rod, frame world.

    Args:
        foot_m: of its axis, on the ground.
        slant: of the axis, metres per metre of height.
        radius_m: at the foot.
        taper: change of the radius per metre of height.
        measured_m: lowest and highest z that beams reached.
        top_m: z up to which it stands.
        is_open: no beam tells what is above: none went through there, and none ended near by.
    """

    foot_m: Float64[np.ndarray, "3"]
    slant: Float64[np.ndarray, "2"]
    radius_m: float
    taper: float
    measured_m: tuple[float, float]
    top_m: float
    is_open: bool = True

    def axis_at(self, z: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 3"]:
        """Points of the axis at heights."""
        across = self.foot_m[:2] + (z - self.foot_m[2])[:, None] * self.slant
        return np.concatenate([across, z[:, None]], axis=1)

    def radius_at(self, z: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Radius at heights."""
        radius = self.radius_m + self.taper * (z - self.foot_m[2])
        return np.maximum(radius, _LEAST_RADIUS_M)


def find_poles(
    returns_world: Float32[np.ndarray, "n 3"],
    origins_world: Float32[np.ndarray, "n 3"],
    ground: GroundMap,
    path_m: Float64[np.ndarray, "k 3"],
) -> list[Pole]:
    """Rods among the returns from what stands still, as far as beams reach.

    Args:
        origins_world: where the sensor stood.
        ground: heights count from it.
        path_m: of the sensor.
    """
    height = returns_world[:, 2] - ground.look_up(returns_world[:, :2].astype(np.float64))
    is_near = (height > _LOWEST_M) & (height < _HIGHEST_M)
    is_near &= path_distance_m(returns_world, path_m) < _REACH_M
    points = returns_world[is_near].astype(np.float64)
    origins, height = origins_world[is_near].astype(np.float64), height[is_near]
    if len(points) == 0:
        return []
    low = points[:, :2].min(axis=0) - (_CLEAR_CELLS + 1) * _CELL_M
    cell = np.floor((points[:, :2] - low) / _CELL_M).astype(np.int64)
    level = np.floor((height - _LOWEST_M) / _LEVEL_M).astype(np.int64)
    rod = _rods(cell, level)
    number = rod.label[cell[:, 0], cell[:, 1]]
    is_own = (number > 0) & (level >= rod.first[number]) & (level < rod.end[number])
    order = np.flatnonzero(is_own)
    order = order[np.argsort(number[order], kind="stable")]
    pieces = np.split(order, np.flatnonzero(np.diff(number[order])) + 1)
    found = [_fit(points[rows], origins[rows], ground) for rows in pieces]
    beams = origins_world[::_EVERY_NTH_BEAM], returns_world[::_EVERY_NTH_BEAM]
    free = [pole for pole in found if pole is not None and _stands_free(pole, *beams)]
    return [replace(pole, is_open=_is_open(pole, *beams)) for pole in free]


@dataclass(frozen=True, eq=False)
class _Rods:
    """Number of the rod at each cell, 0 for none, and the levels of each number."""

    label: Int64[np.ndarray, "x y"]
    first: Int64[np.ndarray, " r"]
    end: Int64[np.ndarray, " r"]


def _rods(cell: Int64[np.ndarray, "n 2"], level: Int64[np.ndarray, " n"]) -> _Rods:
    """Stretches of levels in which a cell has something and its surroundings have nothing."""
    shape = tuple((cell.max(axis=0) + _CLEAR_CELLS + 2).tolist())
    levels = round((_HIGHEST_M - _LOWEST_M) / _LEVEL_M) + 1
    flat = cell[:, 0] * shape[1] + cell[:, 1]
    run, gap = np.zeros(shape, np.int16), np.zeros(shape, np.int16)
    best, end = np.zeros(shape, np.int16), np.zeros(shape, np.int16)
    for k in range(levels):
        is_thin = _is_thin(np.bincount(flat[level == k], minlength=shape[0] * shape[1]), shape)
        gap = np.where(is_thin, 0, gap + 1).astype(np.int16)
        run = np.where(gap > 1, 0, run + 1).astype(np.int16)
        length = run - gap
        least = np.where(
            k - length < _STANDS_WITHIN_M / _LEVEL_M, _LEAST_FROM_GROUND, _LEAST_LEVELS
        )
        is_best = is_thin & (length >= least) & (length > best)
        best, end = np.where(is_best, length, best), np.where(is_best, k + 1, end)
    label = np.zeros(shape, dtype=np.int64)
    count = ndimage.label(best > 0, np.ones((3, 3)), output=label)
    index = np.arange(int(np.asarray(count)) + 1)
    start = np.where(best > 0, end - best, levels)
    first = np.asarray(ndimage.minimum(start, label, index)).astype(np.int64)
    last = np.asarray(ndimage.maximum(end, label, index)).astype(np.int64)
    last[0] = 0
    return _Rods(label, first, last)


def _is_thin(count: Int64[np.ndarray, " c"], shape: tuple[int, ...]) -> Bool[np.ndarray, "x y"]:
    """Cells of one level with returns in or beside them and hardly any around."""
    if not count.any():
        return np.zeros(shape, dtype=bool)
    grid = count.reshape(shape).astype(np.float32)

    def within(cells: int) -> Float32[np.ndarray, "x y"]:
        width = 2 * cells + 1
        mean = np.asarray(ndimage.uniform_filter(grid, width, mode="constant"))
        return mean * np.float32(width**2)

    own = within(_OWN_CELLS)
    around = within(_CLEAR_CELLS) - own
    return (within(1) > 0.5) & (around < np.maximum(_MOST_AROUND, _AROUND * own) + 0.5)


def _fit(
    points: Float64[np.ndarray, "n 3"], origins: Float64[np.ndarray, "n 3"], ground: GroundMap
) -> Pole | None:
    """The tapering cylinder that beams from outside met; None where there is none."""
    if len(points) < _LEAST_RETURNS:
        return None
    step = max(1, len(points) // _MOST_RETURNS)
    points, origins = points[::step], origins[::step]
    centre = np.median(points, axis=0)
    offset, way = points - centre, (points - origins)[:, :2]
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    # An arc seen from one side fits circles of any size: how wide it looks tells more.
    beside = offset[:, 0] * way[:, 1] - offset[:, 1] * way[:, 0]
    seen_m = max(float(np.ptp(np.percentile(beside, (3, 97)))) / 2, _THINNEST_M)
    trust = min(1.0, np.sqrt(_INDEPENDENT / len(points))) / _NOISE_M

    def residuals(x: Float64[np.ndarray, " 6"]) -> Float64[np.ndarray, " r"]:
        across = offset[:, :2] - x[:2] - offset[:, 2:] * x[2:4]
        radius = np.exp(x[4]) + x[5] * offset[:, 2]
        error = trust * (np.linalg.norm(across, axis=1) - radius)
        prior = [x[2] / _SLANT, x[3] / _SLANT, (x[4] - np.log(seen_m)) / _RADIUS_LOG_STD]
        return np.concatenate([error, prior, [x[5] / _TAPER]])

    start = np.array([*(seen_m * way.mean(axis=0)), 0.0, 0.0, np.log(seen_m), 0.0])
    x = least_squares(residuals, start, loss="soft_l1", max_nfev=60).x
    error = np.abs(residuals(x)[: len(points)]) / trust
    radius = float(np.exp(x[4]))
    if np.median(error) > _MOST_ERROR_M or radius > _MOST_RADIUS_M:
        return None
    if np.abs(x[2:4]).max() > _MOST_SLANT or abs(x[5]) > _MOST_TAPER:
        return None
    low, high = (float(v) for v in np.percentile(points[:, 2], (0.5, 99.5)))
    place = centre[:2] + x[:2]
    ground_m = float(ground.look_up(place[None])[0])
    if low - ground_m > _HANGS_M:
        return None
    fall = ground_m - float(centre[2])
    foot = np.array([*(place + fall * x[2:4]), ground_m])
    taper = float(x[5])
    at_foot = max(radius + taper * fall, _LEAST_RADIUS_M)
    return Pole(foot, x[2:4].copy(), at_foot, taper, (low, high), high)


def _stands_free(
    pole: Pole, origins: Float32[np.ndarray, "b 3"], ends: Float32[np.ndarray, "b 3"]
) -> bool:
    """Whether beams pass on both sides and end on it between."""
    beside, is_past, is_met = _beams_by(pole, pole.measured_m, origins, ends)
    radius = float(pole.radius_at(np.array([0.5 * sum(pole.measured_m)]))[0])
    near, far = radius + _BESIDE_M[0], radius + _BESIDE_M[1]
    passes = [int((is_past & (side > near) & (side < far)).sum()) for side in (beside, -beside)]
    is_aimed = np.abs(beside) < 0.5 * radius
    met, through = int((is_aimed & is_met).sum()), int((is_aimed & is_past).sum())
    is_own = is_met & (np.abs(beside) < near)
    is_wider = is_met & (np.abs(beside) > near) & (np.abs(beside) < far)
    is_thin = bool(is_wider.sum() < _MOST_BESIDE * is_own.sum())
    return is_thin and min(passes) >= _LEAST_PASSES and met >= _LEAST_SOLID * (met + through)


def _is_open(
    pole: Pole, origins: Float32[np.ndarray, "b 3"], ends: Float32[np.ndarray, "b 3"]
) -> bool:
    """Whether no beam tells what is right above: none went through there, none ended near by."""
    span = (pole.top_m + 0.1, pole.top_m + _ABOVE_M)
    beside, is_past, is_met = _beams_by(pole, span, origins, ends)
    through = is_past & (np.abs(beside) < _BESIDE_M[0])
    near = is_met & (np.abs(beside) < _BESIDE_M[1])
    return int(through.sum()) < 2 and int(near.sum()) < 2


def _beams_by(
    pole: Pole,
    span_m: tuple[float, float],
    origins: Float32[np.ndarray, "b 3"],
    ends: Float32[np.ndarray, "b 3"],
) -> tuple[Float32[np.ndarray, " b"], Bool[np.ndarray, " b"], Bool[np.ndarray, " b"]]:
    """How far each beam passes beside the axis, and of those that do so between two heights, which
    end well behind and which end there."""
    centre = pole.axis_at(np.array([0.5 * sum(span_m)]))[0, :2].astype(np.float32)
    start, way = centre - origins[:, :2], ends[:, :2] - origins[:, :2]
    length = np.maximum(np.linalg.norm(way, axis=1), np.float32(1e-6))
    along = (start * way).sum(axis=1) / length
    beside = (start[:, 0] * way[:, 1] - start[:, 1] * way[:, 0]) / length
    height = origins[:, 2] + (ends[:, 2] - origins[:, 2]) * along / length
    is_level = (height > span_m[0]) & (height < span_m[1]) & (along > 0) & (along < _REACH_M)
    is_past = is_level & (length > along + _BEHIND_M)
    is_met = is_level & (np.abs(length - along) < _AT_M)
    return beside, is_past, is_met


def raise_poles(poles: Sequence[Pole], silhouettes: Callable[[], Iterable[View]]) -> list[Pole]:
    """The poles as far up as views show them: before the sky, or as a line that differs from both
    of its sides as much as it does where beams met it.

    Args:
        silhouettes: gives frames with their camera (of the matte's size) and sky matte.
    """
    if not poles:
        return []
    above = _STEP_M * (np.arange(round(_MOST_ADDED_M / _STEP_M)) + 0.5)
    levels = np.linspace(0.1, 0.9, _LEVELS_BELOW)
    z = np.stack(
        [
            np.r_[p.measured_m[0] + levels * (p.measured_m[1] - p.measured_m[0]), p.top_m + above]
            for p in poles
        ]
    )
    points = np.stack([pole.axis_at(row) for pole, row in zip(poles, z, strict=True)])
    radius = np.stack([pole.radius_at(row) for pole, row in zip(poles, z, strict=True)])
    odds, lines = np.zeros(z.shape), [np.full(z.shape, np.nan)]
    for frame, camera, matte in spaced_views(silhouettes(), MIN_BASELINE_M):
        distance = np.linalg.norm(points - frame.world_from_camera.translation_m, axis=-1)
        uv, is_inside = frame.project(camera, points.reshape(-1, 3))
        half_px = camera.fx * radius / distance
        beside_px = np.ceil(2 * half_px) + 2
        u, v = (uv[:, k].reshape(z.shape) for k in (0, 1))
        is_inside = is_inside.reshape(z.shape) & (distance < _MAX_VIEW_M)
        is_inside &= (u > beside_px + 2) & (u < camera.width_px - beside_px - 3)
        if not is_inside.any():
            continue
        row, column, beside = (np.where(is_inside, a, 8) for a in (v, u, beside_px))
        pixels = row.astype(np.int64), column.astype(np.int64), beside.astype(np.int64)
        has_sky, is_shown = _before_sky(matte, pixels, half_px)
        odds += np.where(is_inside & has_sky, np.where(is_shown, _SHOWN, _MISSING), 0.0)
        line = _line(frame.load_srgb8(), pixels)
        lines.append(np.where(is_inside & ~has_sky, line, np.nan))
    odds += _odds_of_lines(np.stack(lines))
    odds = odds[:, _LEVELS_BELOW:]
    total = np.cumsum(np.where(odds == 0, _UNSEEN, odds), axis=1)
    is_open = np.array([pole.is_open for pole in poles])
    count = np.where(is_open & (total.max(axis=1) > 0), total.argmax(axis=1) + 1, 0)
    return [
        replace(pole, top_m=pole.top_m + _STEP_M * float(n))
        for pole, n in zip(poles, count, strict=True)
    ]


_Pixels = tuple[Int64[np.ndarray, "p z"], Int64[np.ndarray, "p z"], Int64[np.ndarray, "p z"]]
"""Row, column, and columns to either side."""


def _before_sky(
    matte: Float32[np.ndarray, "h w"], pixels: _Pixels, half_px: Float64[np.ndarray, "p z"]
) -> tuple[Bool[np.ndarray, "p z"], Bool[np.ndarray, "p z"]]:
    """Whether both sides show sky, and whether something stands between."""
    row, column, beside = pixels
    has_sky = np.minimum(matte[row, column - beside], matte[row, column + beside]) > SKY_ALPHA
    # Poses err by a pixel.
    reach = np.min([matte[row, column + k] for k in (-1, 0, 1)], axis=0)
    return has_sky, reach < np.clip(1.0 - half_px, 0.3, SKY_ALPHA)


def _line(image: UInt8[np.ndarray, "h w 3"], pixels: _Pixels) -> Float64[np.ndarray, "p z"]:
    """By how much the place differs from the more similar one of its sides, 8-bit steps."""
    row, column, beside = pixels
    sides = [image[row, column + side].astype(np.float64) for side in (-beside, beside)]
    middles = [image[row, column + k].astype(np.float64) for k in (-1, 0, 1)]
    between = [np.min([np.abs(m - s).mean(axis=-1) for s in sides], axis=0) for m in middles]
    return np.max(between, axis=0)


def _odds_of_lines(lines: Float64[np.ndarray, "v p z"]) -> Float64[np.ndarray, "p z"]:
    """Log-odds of each level by the views that have no sky beside it, against the levels that
    beams reached; 0 for poles that hardly differ from what is behind them."""
    odds = np.zeros(lines.shape[1:])
    for k in range(lines.shape[1]):
        known = lines[:, k, :_LEVELS_BELOW]
        known = known[np.isfinite(known)]
        if len(known) < _LEAST_LINES or (usual := float(np.median(known))) < _LEAST_CONTRAST:
            continue
        seen = np.isfinite(lines[:, k])
        is_line = seen & (np.where(seen, lines[:, k], 0.0) > 0.5 * usual)
        odds[k] = _LINE * (2.0 * is_line.sum(axis=0) - seen.sum(axis=0))
    return odds
