"""Sky colour by world direction, from frames of one camera at several positions of a log.

The sky has no parallax: it has the same colour in the same direction from every position, whereas
a surface hides it from some positions only. A pixel that agrees with the sky colour of its
direction is the same object; its log-odds are averaged over all positions (not added, because they
depend on the same colours). A pixel that deviates from it is an occluder. The likelihood ratios of
agreement and deviation are estimated from each log, from certain sky and from pixels with LiDAR
returns. Directions without observed sky are compared with the nearest certain sky (`certain_sky`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from lightsim.core.sensors import CameraFrame
from lightsim.masks.certain_sky import (
    CERTAIN_LOG_ODDS,
    RESIDUALS_LAB,
    CertainSky,
    log_ratios,
    ratio_at,
)
from lightsim.masks.sky_regions import LOG_ODDS_LIMIT, ImageEvidence, RegionMean

# Edge of a cell of directions: about a pixel at working width, because clouds have sharp edges.
_CELL_DEG = 0.25
# Rows of cells, from the horizon to the zenith.
_ROWS = round(90 / _CELL_DEG)
# Columns of cells, over all azimuths.
_COLUMNS = 4 * _ROWS
# Least distance between two frames: the direction of a point 30 m away then changes by 2 degrees.
_LEAST_STEP_M = 1.0
# Most frames of a camera. Gaps between houses are visible in few of them: with 8 frames, wires in
# such a gap of log 002 excluded the clouds between them.
_MOST_FRAMES = 16
# Fewest frames in which a direction must be sky: two frames can have the same error.
_LEAST_FRAMES = 3


class Kind(IntEnum):
    """Kind of a pixel: no observed sky in its direction; the sky's colour; another colour."""

    UNKNOWN = 0
    SAME = 1
    OTHER = 2


@dataclass(frozen=True, eq=False)
class SkyView:
    """Evidence of one image, and the log-odds of sky that result from this image alone."""

    evidence: ImageEvidence
    log_odds: Float[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class Agreement:
    """Comparison of an image with the observed sky in the directions of its pixels.

    Args:
        kind: the `Kind` of each pixel.
        expected_lab: sky colour of the direction; NaN unless SAME.
        is_same: probability that the pixel shows the same object as the panorama.
        log_odds: log-odds of sky of that object, mean over all positions; 0 if UNKNOWN.
        against: log-likelihood ratio of sky of OTHER pixels, at most 0.
        beside: log-likelihood ratio of sky of UNKNOWN pixels from nearby certain sky, at most 0.
    """

    kind: Int[np.ndarray, "h w"]
    expected_lab: Float32[np.ndarray, "h w 3"]
    is_same: Float[np.ndarray, "h w"]
    log_odds: Float[np.ndarray, "h w"]
    against: Float[np.ndarray, "h w"]
    beside: Float[np.ndarray, "h w"]

    def split(self, labels: Int[np.ndarray, "h w"]) -> Int[np.ndarray, "h w"]:
        """Return connected regions, divided where the kind changes.

        The division separates a thin cloud from the wires beside it. Parts are connected, so that
        specks of glare, which deviate from the sky, too, are classified separately.
        """
        from skimage.measure import label

        parts = label(labels * len(Kind) + self.kind, background=-1, connectivity=2)
        return np.asarray(parts, np.int64) - 1

    def applied_to(
        self, labels: Int[np.ndarray, "h w"], own: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Return log-odds of regions of `split`, averaged with the panorama's where it is SAME."""
        mean = RegionMean(labels)
        weight = mean(self.is_same * (self.kind == Kind.SAME))
        return (1.0 - weight) * own + weight * mean(self.log_odds) + mean(self.against)


@dataclass(frozen=True, eq=False)
class SkyPanorama:
    """Colour and log-odds of the sky in each cell of directions, and likelihood ratios.

    Args:
        lab: median colour over the frames in which the cell is sky; NaN if they are too few.
        log_odds: mean log-odds of sky over all frames with this colour in the cell.
        log_ratio: log-likelihood ratio of sky, by class of the residual from `lab`.
        certain: directions and colours of certain sky.
        beside_log_ratio: log-likelihood ratio of sky, by class of the angle to certain sky and of
            the residual from its colour.
    """

    lab: Float32[np.ndarray, "c 3"]
    log_odds: Float[np.ndarray, " c"]
    log_ratio: Float[np.ndarray, " r"]
    certain: CertainSky
    beside_log_ratio: Float[np.ndarray, "a r"]

    def compare(self, evidence: ImageEvidence) -> Agreement:
        """Compare an image of this camera with the sky that it observed at other positions."""
        residual, expected = _nearest(self.lab, evidence)
        is_known = np.isfinite(residual)
        ratio = np.where(is_known, ratio_at(self.log_ratio, residual), 0.0)
        kind = np.where(is_known, np.where(ratio > 0, Kind.SAME, Kind.OTHER), Kind.UNKNOWN)
        odds = np.where(is_known, self.log_odds[_cells(evidence)], 0.0)
        # The pixel deviates from the cell's object, which is sky with log-odds `odds`: marginalise
        # the ratio over both cases.
        hiding = np.logaddexp(odds + ratio, 0.0) - np.logaddexp(odds, 0.0)
        beside, chosen = np.zeros(kind.shape), ~is_known & ~evidence.is_excluded
        beside[chosen] = self.certain.against(
            evidence.directions_world[chosen], evidence.lab[chosen], self.beside_log_ratio
        )
        return Agreement(
            kind,
            np.where((kind == Kind.SAME)[..., None], expected, np.float32(np.nan)),
            1.0 / (1.0 + np.exp(-ratio)),
            odds,
            np.where(kind == Kind.OTHER, hiding, 0.0),
            beside,
        )


@dataclass(frozen=True, eq=False)
class CameraSky:
    """Input of one camera's panorama: colours and log-odds by cell, and histograms of residuals.

    Args:
        lab: median sky colour of every cell; NaN if unknown.
        known: indices of the cells with a sky colour.
        frames_lab: mean colour of each frame in the known cells.
        frames_log_odds: mean log-odds of each frame in the known cells.
        sky_count: histogram of residuals of certain sky from its cell's colour.
        other_count: histogram of residuals of pixels with LiDAR returns.
        certain: directions and colours of certain sky.
        beside_sky_count: histogram of residuals between directions of certain sky.
        beside_other_count: histogram of residuals of returns from the nearest certain sky.
    """

    lab: Float32[np.ndarray, "c 3"]
    known: Int[np.ndarray, " s"]
    frames_lab: Float32[np.ndarray, "f s 3"]
    frames_log_odds: Float32[np.ndarray, "f s"]
    sky_count: Float[np.ndarray, " r"]
    other_count: Float[np.ndarray, " r"]
    certain: CertainSky
    beside_sky_count: Float[np.ndarray, "a r"]
    beside_other_count: Float[np.ndarray, "a r"]

    @staticmethod
    def of(views: Sequence[SkyView]) -> CameraSky:
        """Collect one camera's views from different positions."""
        skies, everything, odds = [], [], []
        for view in views:
            evidence, is_up = view.evidence, ~view.evidence.is_excluded
            is_sky = is_up & (view.log_odds > 0) & ~evidence.has_hit
            skies.append(_cell_means(evidence, evidence.lab, is_sky))
            everything.append(_cell_means(evidence, evidence.lab, is_up))
            odds.append(_cell_means(evidence, view.log_odds[..., None], is_up)[:, 0])
        count = np.sum([np.isfinite(sky[:, 0]) for sky in skies], axis=0)
        known = np.flatnonzero(count >= _LEAST_FRAMES)
        lab = np.full((_ROWS * _COLUMNS, 3), np.nan, np.float32)
        if len(known):
            lab[known] = np.nanmedian(np.stack([sky[known] for sky in skies]), axis=0)
        counts = np.zeros((2, len(RESIDUALS_LAB) + 1))
        for view in views:
            residual, _ = _nearest(lab, view.evidence)
            hit, is_known = view.evidence.has_hit, np.isfinite(residual)
            is_sky = is_known & (view.log_odds > CERTAIN_LOG_ODDS) & ~hit
            for row, chosen in enumerate((is_sky, is_known & hit)):
                classes = np.digitize(residual[chosen], RESIDUALS_LAB)
                counts[row] += np.bincount(classes, minlength=counts.shape[1])
        frames_lab = np.stack([frame[known] for frame in everything])
        frames_odds = np.stack([o[known] for o in odds])
        cells = known[np.nanmean(frames_odds, axis=0) > CERTAIN_LOG_ODDS]
        certain = CertainSky.of(_directions(cells), lab[cells])
        hits = [v.evidence.has_hit & ~v.evidence.is_excluded for v in views]
        pairs = list(zip(views, hits, strict=True))
        beside = certain.other_count(
            np.concatenate([view.evidence.directions_world[hit] for view, hit in pairs]),
            np.concatenate([view.evidence.lab[hit] for view, hit in pairs]),
        )
        of_sky, of_other = counts
        return CameraSky(
            lab, known, frames_lab, frames_odds, of_sky, of_other,
            certain, certain.sky_count(), beside,
        )  # fmt: skip


def frames_apart(frames: Sequence[CameraFrame]) -> tuple[CameraFrame, ...]:
    """Return frames of one camera at different positions, evenly distributed over its path.

    Empty if the camera hardly moves, since near surfaces then hide the same sky in all frames.
    """
    apart: list[CameraFrame] = []
    for frame in frames:
        place_m = frame.world_from_camera.translation_m
        if all(_distance_m(place_m, other) >= _LEAST_STEP_M for other in apart):
            apart.append(frame)
    if len(apart) < _LEAST_FRAMES:
        return ()
    chosen = np.linspace(0, len(apart) - 1, min(len(apart), _MOST_FRAMES)).round().astype(int)
    return tuple(apart[k] for k in chosen)


def panoramas(sky_by_camera: Mapping[str, CameraSky]) -> dict[str, SkyPanorama]:
    """Return panoramas by camera name, with likelihood ratios of the whole log."""
    if not sky_by_camera:
        return {}
    skies = sky_by_camera.values()
    ratio, beside = (
        log_ratios(np.sum(sky, axis=0), np.sum(other, axis=0))
        for sky, other in (
            ([s.sky_count for s in skies], [s.other_count for s in skies]),
            ([s.beside_sky_count for s in skies], [s.beside_other_count for s in skies]),
        )
    )
    return {name: _panorama(s, ratio, beside) for name, s in sky_by_camera.items()}


def _panorama(
    sky: CameraSky, log_ratio: Float[np.ndarray, " r"], beside: Float[np.ndarray, "a r"]
) -> SkyPanorama:
    residual = np.linalg.norm(sky.frames_lab - sky.lab[sky.known], axis=2)
    is_same = 1.0 / (1.0 + np.exp(-ratio_at(log_ratio, residual)))
    weight = np.where(np.isfinite(residual), is_same, 0.0)
    odds = np.clip(np.nan_to_num(sky.frames_log_odds), -LOG_ODDS_LIMIT, LOG_ODDS_LIMIT)
    log_odds = np.zeros(len(sky.lab))
    log_odds[sky.known] = (weight * odds).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-6)
    return SkyPanorama(sky.lab, log_odds, log_ratio, sky.certain, beside)


def _cells(evidence: ImageEvidence) -> Int[np.ndarray, "h w"]:
    """Return the flat index of each pixel's cell; rows are counted upwards from the horizon."""
    x, y, z = np.moveaxis(evidence.directions_world, -1, 0)
    row = np.degrees(np.arcsin(np.clip(z, 0.0, 1.0))) / _CELL_DEG
    column = np.degrees(np.arctan2(y, x)) / _CELL_DEG
    rows = np.minimum(row.astype(np.int64), _ROWS - 1)
    return rows * _COLUMNS + np.floor(column).astype(np.int64) % _COLUMNS


def _directions(cells: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Return unit vectors to the middles of cells, frame `world`."""
    row, column = np.divmod(cells, _COLUMNS)
    up, right = np.radians((row + 0.5) * _CELL_DEG), np.radians((column + 0.5) * _CELL_DEG)
    flat = np.stack([np.cos(right), np.sin(right)], axis=1) * np.cos(up)[:, None]
    return np.concatenate([flat, np.sin(up)[:, None]], axis=1)


def _cell_means(
    evidence: ImageEvidence, values: Float[np.ndarray, "h w k"], chosen: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "c k"]:
    """Return means over the chosen pixels of each cell, NaN for cells without any."""
    cells, size = _cells(evidence)[chosen], _ROWS * _COLUMNS
    count = np.bincount(cells, minlength=size).astype(np.float64)
    count[count == 0] = np.nan
    sums = [np.bincount(cells, values[chosen, k], size) for k in range(values.shape[-1])]
    return (np.stack(sums, axis=1) / count[:, None]).astype(np.float32)


def _neighbours(cells: Int[np.ndarray, "h w"]) -> Iterator[Int[np.ndarray, "h w"]]:
    """Yield the cells and their eight neighbours: poses err by a fraction of a degree."""
    row, column = np.divmod(cells, _COLUMNS)
    for up in (0, -1, 1):
        for right in (0, -1, 1):
            rows = np.clip(row + up, 0, _ROWS - 1)
            yield rows * _COLUMNS + (column + right) % _COLUMNS


def _nearest(
    lab: Float32[np.ndarray, "c 3"], evidence: ImageEvidence
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w 3"]]:
    """Return the distance of each pixel's colour to the nearest colour of the cells around its
    direction, and that colour; NaN if its own cell has none."""
    cells = _cells(evidence)
    expected = lab[cells]
    squared = _squared_distance(evidence.lab, expected)
    for around in _neighbours(cells):
        other = lab[around]
        distance = _squared_distance(evidence.lab, other)
        is_nearer = distance < squared
        squared[is_nearer] = distance[is_nearer]
        expected[is_nearer] = other[is_nearer]
    residual = np.sqrt(squared)
    residual[evidence.is_excluded] = np.nan
    return residual, expected


def _squared_distance(
    one: Float32[np.ndarray, "h w 3"], other: Float32[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w"]:
    step = one - other
    return np.einsum("hwk,hwk->hw", step, step)


def _distance_m(place_m: Float[np.ndarray, "3"], other: CameraFrame) -> float:
    return float(np.linalg.norm(place_m - other.world_from_camera.translation_m))
