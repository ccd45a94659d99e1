"""The sky by world direction, as one camera saw it from several places of a log.

The sky has no parallax: what is sky shows the same colour at the same direction wherever the ego
stands, and what hides it from one place does not from another. What agrees with the sky seen at its
direction is the same thing, whose log-odds are averaged over all places (they are of the same
colours, so a sum would count them twice); what differs from it hides it. How much an agreement or
a difference is worth, the log itself shows: by sure sky, and by pixels that returned a beam. Beside
the directions at which sky was seen it can be told apart, too (`sure_sky`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from lightsim.core.sensors import CameraFrame
from lightsim.masks.sky_regions import ImageEvidence, RegionMean
from lightsim.masks.sure_sky import RESIDUALS_LAB, SURELY_SKY, SureSky, log_ratios, ratio_at

_CELL_DEG = 0.25
"""About a pixel at working width: clouds have sharp edges."""
_ROWS, _COLUMNS = round(90 / _CELL_DEG), round(360 / _CELL_DEG)
_LEAST_STEP_M = 1.0
"""Between two of its frames: what is 30 m away then moves by two degrees."""
_MOST_FRAMES = 16
"""Gaps between houses are seen from few of them: with 8, wires in such a gap of log 002 took the
clouds between them along."""
_LEAST_FRAMES = 3
"""In which a direction was sky: one and the picture in question could be mistaken together."""
_MOST_LOG_ODDS = 8.0
"""That no place may exceed in the mean, as in regions."""
UNKNOWN, SAME, OTHER = 0, 1, 2
"""Kinds of pixels: direction never sky; the sky's colour there; another colour."""


@dataclass(frozen=True, eq=False)
class SkyView:
    """What one picture alone makes of itself: log-odds of being sky of each pixel."""

    evidence: ImageEvidence
    log_odds: Float[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class Agreement:
    """How a picture compares with the sky that was seen at the directions of its pixels.

    Args:
        kind: UNKNOWN, SAME or OTHER.
        expected_lab: the sky's colour there; NaN but where SAME.
        is_same: probability that it is the same thing.
        log_odds: of the thing seen there, mean over the places that saw it; 0 where UNKNOWN.
        against: log-likelihood ratio (at most 0) of what differs from what was sky.
        beside: where UNKNOWN, the same of what differs from the sky that was seen beside it.
    """

    kind: Int[np.ndarray, "h w"]
    expected_lab: Float32[np.ndarray, "h w 3"]
    is_same: Float[np.ndarray, "h w"]
    log_odds: Float[np.ndarray, "h w"]
    against: Float[np.ndarray, "h w"]
    beside: Float[np.ndarray, "h w"]

    def split(self, labels: Int[np.ndarray, "h w"]) -> Int[np.ndarray, "h w"]:
        """Regions cut where the kind changes: a thin cloud between wires is not a wire. Each part
        holds together: specks of glare, too, look like another thing than the sky."""
        from skimage.measure import label

        parts = label(labels * 3 + self.kind, background=-1, connectivity=2)
        return np.asarray(parts, np.int64) - 1

    def applied_to(
        self, labels: Int[np.ndarray, "h w"], own: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Log-odds of `split` regions, averaged with those of the same thing elsewhere."""
        mean = RegionMean(labels)
        weight = mean(self.is_same * (self.kind == SAME))
        return (1.0 - weight) * own + weight * mean(self.log_odds) + mean(self.against)


@dataclass(frozen=True, eq=False)
class SkyPanorama:
    """Colour of the sky by direction, and what the thing seen there was thought to be.

    Args:
        lab: median over the frames in which the cell was sky; NaN where they were too few.
        log_odds: of being sky, mean over all frames that saw this colour there.
        log_ratio: of sky against anything else, by class of the residual.
        sure: where it was surely sky.
        beside_log_ratio: the same as `log_ratio` of residuals to the sky beside, by class of angle.
    """

    lab: Float32[np.ndarray, "c 3"]
    log_odds: Float[np.ndarray, " c"]
    log_ratio: Float[np.ndarray, " r"]
    sure: SureSky
    beside_log_ratio: Float[np.ndarray, "a r"]

    def compare(self, evidence: ImageEvidence) -> Agreement:
        """A picture of this camera with what it saw elsewhere."""
        residual, expected = _nearest(self.lab, evidence)
        is_known = np.isfinite(residual)
        ratio = np.where(is_known, ratio_at(self.log_ratio, residual), 0.0)
        kind = np.where(is_known, np.where(ratio > 0, SAME, OTHER), UNKNOWN)
        odds = np.where(is_known, self.log_odds[_cells(evidence)], 0.0)
        # Marginal of what hides the cell's thing, which is sky itself only so far as `odds` tell.
        hiding = np.logaddexp(odds + ratio, 0.0) - np.logaddexp(odds, 0.0)
        beside, asked = np.zeros(kind.shape), ~is_known & ~evidence.is_excluded
        beside[asked] = self.sure.against(
            evidence.directions_world[asked], evidence.lab[asked], self.beside_log_ratio
        )
        return Agreement(
            kind,
            np.where((kind == SAME)[..., None], expected, np.float32(np.nan)),
            1.0 / (1.0 + np.exp(-ratio)),
            odds,
            np.where(kind == OTHER, hiding, 0.0),
            beside,
        )


@dataclass(frozen=True, eq=False)
class CameraSky:
    """What a panorama is made of: the frames of one camera, by cell, and counts of residuals at the
    same direction and beside sure sky."""

    lab: Float32[np.ndarray, "c 3"]
    seen: Int[np.ndarray, " s"]
    frames_lab: Float32[np.ndarray, "f s 3"]
    frames_log_odds: Float32[np.ndarray, "f s"]
    sky_count: Float[np.ndarray, " r"]
    other_count: Float[np.ndarray, " r"]
    sure: SureSky
    beside_sky_count: Float[np.ndarray, "a r"]
    beside_other_count: Float[np.ndarray, "a r"]

    @staticmethod
    def of(views: Sequence[SkyView]) -> CameraSky:
        """Of one camera's views, from different places."""
        skies, everything, odds = [], [], []
        for view in views:
            evidence, is_up = view.evidence, ~view.evidence.is_excluded
            is_sky = is_up & (view.log_odds > 0) & ~evidence.has_hit
            skies.append(_cell_means(evidence, evidence.lab, is_sky))
            everything.append(_cell_means(evidence, evidence.lab, is_up))
            odds.append(_cell_means(evidence, view.log_odds[..., None], is_up)[:, 0])
        count = np.sum([np.isfinite(sky[:, 0]) for sky in skies], axis=0)
        seen = np.flatnonzero(count >= _LEAST_FRAMES)
        lab = np.full((_ROWS * _COLUMNS, 3), np.nan, np.float32)
        if len(seen):
            lab[seen] = np.nanmedian(np.stack([sky[seen] for sky in skies]), axis=0)
        counts = np.zeros((2, len(RESIDUALS_LAB) + 1))
        for view in views:
            residual, _ = _nearest(lab, view.evidence)
            hit, is_known = view.evidence.has_hit, np.isfinite(residual)
            is_sky = is_known & (view.log_odds > SURELY_SKY) & ~hit
            for row, chosen in enumerate((is_sky, is_known & hit)):
                classes = np.digitize(residual[chosen], RESIDUALS_LAB)
                counts[row] += np.bincount(classes, minlength=counts.shape[1])
        frames_lab = np.stack([frame[seen] for frame in everything])
        frames_odds = np.stack([o[seen] for o in odds])
        surely = seen[np.nanmean(frames_odds, axis=0) > SURELY_SKY]
        sure = SureSky.of(_directions(surely), lab[surely])
        hits = [v.evidence.has_hit & ~v.evidence.is_excluded for v in views]
        seen_in = list(zip(views, hits, strict=True))
        beside = sure.other_count(
            np.concatenate([view.evidence.directions_world[hit] for view, hit in seen_in]),
            np.concatenate([view.evidence.lab[hit] for view, hit in seen_in]),
        )
        of_sky, of_other = counts
        return CameraSky(
            lab, seen, frames_lab, frames_odds, of_sky, of_other, sure, sure.sky_count(), beside
        )


def frames_apart(frames: Sequence[CameraFrame]) -> tuple[CameraFrame, ...]:
    """Frames of one camera taken at different places, spread over its path; none where it hardly
    moves: near things then stay before the same sky."""
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
    """Panoramas of a log's cameras; what a residual is worth is all of the log's."""
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
    residual = np.linalg.norm(sky.frames_lab - sky.lab[sky.seen], axis=2)
    is_same = 1.0 / (1.0 + np.exp(-ratio_at(log_ratio, residual)))
    weight = np.where(np.isfinite(residual), is_same, 0.0)
    odds = np.clip(np.nan_to_num(sky.frames_log_odds), -_MOST_LOG_ODDS, _MOST_LOG_ODDS)
    log_odds = np.zeros(len(sky.lab))
    log_odds[sky.seen] = (weight * odds).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-6)
    return SkyPanorama(sky.lab, log_odds, log_ratio, sky.sure, beside)


def _cells(evidence: ImageEvidence) -> Int[np.ndarray, "h w"]:
    """Flat index of each pixel's cell, row by row upwards from the horizon."""
    x, y, z = np.moveaxis(evidence.directions_world, -1, 0)
    row = np.degrees(np.arcsin(np.clip(z, 0.0, 1.0))) / _CELL_DEG
    column = np.degrees(np.arctan2(y, x)) / _CELL_DEG
    rows = np.minimum(row.astype(np.int64), _ROWS - 1)
    return rows * _COLUMNS + np.floor(column).astype(np.int64) % _COLUMNS


def _directions(cells: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Middles of cells, frame world."""
    row, column = np.divmod(cells, _COLUMNS)
    up, right = np.radians((row + 0.5) * _CELL_DEG), np.radians((column + 0.5) * _CELL_DEG)
    flat = np.stack([np.cos(right), np.sin(right)], axis=1) * np.cos(up)[:, None]
    return np.concatenate([flat, np.sin(up)[:, None]], axis=1)


def _cell_means(
    evidence: ImageEvidence, values: Float[np.ndarray, "h w k"], chosen: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "c k"]:
    """Means over the chosen pixels of each cell, NaN where there are none."""
    cells, size = _cells(evidence)[chosen], _ROWS * _COLUMNS
    count = np.bincount(cells, minlength=size).astype(np.float64)
    count[count == 0] = np.nan
    sums = [np.bincount(cells, values[chosen, k], size) for k in range(values.shape[-1])]
    return (np.stack(sums, axis=1) / count[:, None]).astype(np.float32)


def _neighbours(cells: Int[np.ndarray, "h w"]) -> Iterator[Int[np.ndarray, "h w"]]:
    """The cells and those around them: poses err by a fraction of a degree."""
    row, column = np.divmod(cells, _COLUMNS)
    for up in (0, -1, 1):
        for right in (0, -1, 1):
            rows = np.clip(row + up, 0, _ROWS - 1)
            yield rows * _COLUMNS + (column + right) % _COLUMNS


def _nearest(
    lab: Float32[np.ndarray, "c 3"], evidence: ImageEvidence
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w 3"]]:
    """Distance of each pixel's colour to the nearest one of the cells around its direction, and
    that colour; NaN where its own cell has none."""
    cells = _cells(evidence)
    expected = lab[cells]
    residual = np.linalg.norm(evidence.lab - expected, axis=-1)
    for around in _neighbours(cells):
        other = np.linalg.norm(evidence.lab - lab[around], axis=-1)
        is_nearer = other < residual
        residual[is_nearer] = other[is_nearer]
        expected[is_nearer] = lab[around[is_nearer]]
    residual[evidence.is_excluded] = np.nan
    return residual, expected


def _distance_m(place_m: Float[np.ndarray, "3"], other: CameraFrame) -> float:
    return float(np.linalg.norm(place_m - other.world_from_camera.translation_m))
