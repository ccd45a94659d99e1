"""Unmeasured parts of crowns: tops above the highest beam, and far sides behind leaves.

The shape prior of a crown is an ellipsoid as deep and as high as the measured part is wide. A cell
within it contains leaves unless the summed log-odds of three observations indicate otherwise: beams
that passed, views that show sky, and views whose colour is not that of leaves.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8
from scipy import ndimage

from lightsim.core.buildings import Wall
from lightsim.core.casting import RayCaster
from lightsim.core.colour import linear_from_srgb8
from lightsim.geometry.completion.crowns import Beams, Crowns, count_beams
from lightsim.geometry.completion.view_evidence import (
    DARK_LINEAR,
    DEPTH_TOLERANCE_M,
    MAX_LOG_ODDS,
    OBJECT_VIEW_M,
    SKY_LOG_ODDS,
    View,
    ViewEvidence,
)

# The values below were chosen on streets 0 and 1 of the benchmark; only their joint effect was
# measured.


class _Shape:
    """The ellipsoid of a crown and the evidence of its cells."""

    prior_log_odds = 1.1  # Prior log-odds of leaves in a cell.
    colour_log_odds = (1.5, 4.0)  # Greatest log-odds of colour: one view, all.
    max_width_m = 6.0  # Greatest width of one crown.
    max_aspect = 2.5  # Greatest ratio of width to visible height; wider ones are several crowns.
    ends = (0.03, 0.97)  # Quantiles of voxel positions that bound a crown.
    # Maximum distance of views whose colours are used: beyond, other trees are often in the
    # background.
    max_colour_m = 30.0


class _Chroma:
    """Histogram of chroma, log2 of red and of blue over green."""

    limit = 2.0  # Limit of both axes.
    bins = 24  # Bins of an axis.
    blur = 1.0  # Standard deviation of the blur, in bins: few samples suffice with it.
    samples = 2000  # Pixels of each view that sample everything except leaves.


def unseen_leaves(
    crowns: Crowns,
    beams: Beams,
    walls: Sequence[Wall],
    evidence: ViewEvidence,
    caster: RayCaster,
) -> Float64[np.ndarray, "n 3"]:
    """Return the centres of the unmeasured cells that contain leaves, [n, 3], frame world, metres.

    Cells have edge `crowns.voxel_m`.

    Args:
        crowns: the measured crowns.
        beams: all beams that `find_crowns` used.
        walls: planes behind which no leaves are placed.
        evidence: the views of the log.
        caster: over the measured background, with crowns as cards.

    Raises:
        InputError: a matte does not fit its camera.
    """
    cell, crown = _cells_of_ellipsoids(crowns)
    if not len(cell):
        return np.zeros((0, 3))
    log_odds = _Shape.prior_log_odds - _beam_log_odds(crowns, cell, crown, beams)
    middle = crowns.low_m + (cell + 0.5) * crowns.voxel_m
    log_odds[_is_behind(middle, crowns, crown, walls)] = -np.inf
    leaf_views = [_LeafView.of(view, crowns, caster) for view in evidence.views()]
    colour, sky = np.zeros(len(cell)), np.zeros(len(cell), np.int64)
    leaf_log_odds = _leaf_log_odds(leaf_views)
    for leaf_view in leaf_views:
        leaf_view.add_to(colour, sky, middle, leaf_log_odds, crowns, caster)
    log_odds += np.clip(colour, -_Shape.colour_log_odds[1], _Shape.colour_log_odds[1])
    log_odds += np.maximum(SKY_LOG_ODDS * sky, -MAX_LOG_ODDS)
    return middle[log_odds > 0]


def _cells_of_ellipsoids(
    crowns: Crowns,
) -> tuple[Int64[np.ndarray, "n 3"], Int64[np.ndarray, " n"]]:
    """Return the unmeasured cells within the crowns' ellipsoids, and the crown of each.

    Pieces with at most a voxel between them are one crown, unless that would be too wide.
    """
    found: dict[tuple[int, ...], int] = {}
    for rows in _merged_crowns(crowns):
        numbers = crowns.crown[rows]
        whole = _ellipsoid(crowns, crowns.cells[rows])
        parts = [rows] if len(whole) else [rows[numbers == k] for k in np.unique(numbers)]
        for part in parts:
            for cell in _ellipsoid(crowns, crowns.cells[part]).tolist():
                found.setdefault(tuple(cell), int(crowns.crown[part[0]]))
    for cell in crowns.cells.tolist():
        found.pop(tuple(cell), None)
    return np.array([*found], np.int64).reshape(-1, 3), np.array([*found.values()], np.int64)


def _merged_crowns(crowns: Crowns) -> Iterator[Int64[np.ndarray, " m"]]:
    """Yield the rows of the voxels of each group of crowns with gaps of at most a voxel."""
    if not len(crowns.cells):
        return
    low = crowns.cells.min(axis=0) - 1
    is_in = np.zeros(tuple((crowns.cells.max(axis=0) - low + 2).tolist()), dtype=bool)
    place = tuple((crowns.cells - low).T)
    is_in[place] = True
    around = np.ones((3, 3, 3))
    label = np.zeros(is_in.shape, np.int64)
    ndimage.label(ndimage.binary_dilation(is_in, around), around, output=label)
    for number in np.unique(label[place]):
        yield np.flatnonzero(label[place] == number)


def _ellipsoid(crowns: Crowns, own: Int64[np.ndarray, "n 3"]) -> Int64[np.ndarray, "m 3"]:
    """Return the cells of the ellipsoid around voxels, with one axis along the line of sight.

    The result is empty if the voxels are wide enough to be several crowns.
    """
    edge = crowns.voxel_m
    points = crowns.low_m + (own + 0.5) * edge
    eye = crowns.nearest_path_points(points.mean(axis=0)[None])[0]
    away = points.mean(axis=0)[:2] - eye[:2]
    away /= max(float(np.linalg.norm(away)), 1e-9)
    across = np.array([-away[1], away[0]])
    (left, right), (near, far), (low, high) = (
        np.quantile(x, _Shape.ends) + (-edge / 2, edge / 2)
        for x in (points[:, :2] @ across, points[:, :2] @ away, points[:, 2])
    )
    width = right - left
    if width > min(_Shape.max_width_m, _Shape.max_aspect * (high - low)):
        return np.zeros((0, 3), np.int64)
    depth, height = max(width, far - near), max(width, high - low)
    level = (left + right) / 2 * across + (near + depth / 2) * away
    centre = np.array([*level, low + height / 2])
    reach = int(np.ceil(max(width, depth, height) / 2 / edge)) + 1
    steps = np.arange(-reach, reach + 1)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    cell = np.floor((centre - crowns.low_m) / edge).astype(np.int64) + grid
    offset = crowns.low_m + (cell + 0.5) * edge - centre
    parts = offset[:, :2] @ across / width, offset[:, :2] @ away / depth, offset[:, 2] / height
    return cell[4 * np.square(np.stack(parts)).sum(axis=0) < 1]


def _beam_log_odds(
    crowns: Crowns, cell: Int64[np.ndarray, "n 3"], crown: Int64[np.ndarray, " n"], beams: Beams
) -> Float64[np.ndarray, " n"]:
    """Return the log-odds against leaves from beams that passed: free path times extinction (Beer
    and Lambert's law); infinite where beams ended on other surfaces."""
    low = cell.min(axis=0)
    shape = tuple((cell.max(axis=0) - low + 1).tolist())
    corner = crowns.low_m + low * crowns.voxel_m
    stops, _, way = count_beams(beams, corner, crowns.voxel_m, shape)
    place = tuple((cell - low).T)
    found = crowns.median_extinction[crown] * crowns.voxel_m * way[place].astype(np.float64)
    found[stops[place] > 0] = np.inf
    return found


def _is_behind(
    middle: Float64[np.ndarray, "n 3"],
    crowns: Crowns,
    crown: Int64[np.ndarray, " n"],
    walls: Sequence[Wall],
) -> Bool[np.ndarray, " n"]:
    """Return whether each cell lies behind a wall that its crown is in front of."""
    points = crowns.middle_m
    centres = np.stack([points[crowns.crown == k].mean(axis=0) for k in range(len(crowns))])
    found = np.zeros(len(middle), dtype=bool)
    for wall in walls:
        s, out = wall.place(middle)
        is_before = wall.place(centres)[1][crown] > 0
        found |= is_before & (out < 0) & (s > wall.span_m[0]) & (s < wall.span_m[1])
    return found


@dataclass(frozen=True, eq=False)
class _LeafView:
    """A view with chroma bins of its pixels, and samples on leaves and on other surfaces."""

    view: View
    bins: Int64[np.ndarray, "h w"]
    leaves: Int64[np.ndarray, " a"]
    others: Int64[np.ndarray, " b"]

    @staticmethod
    def of(view: View, crowns: Crowns, caster: RayCaster) -> _LeafView:
        bins = _chroma_bins(view.frame.load_srgb8())
        sightlines = view.sightlines(crowns.returns_m, OBJECT_VIEW_M).visible(caster)
        leaves = bins[sightlines.pixel]
        rows, columns = np.nonzero(view.has_surface)
        step = max(1, len(rows) // _Chroma.samples)
        uv = np.stack([columns[::step], rows[::step]], axis=1) + 0.5
        origins, rays = view.frame.pixel_rays(view.camera, uv)
        hits = caster.intersect(origins, rays)
        ends = origins + np.where(hits.is_hit, hits.distance_m, 0.0)[:, None] * rays
        is_other = hits.is_hit & ~crowns.contain(ends)
        return _LeafView(
            view, bins, leaves, bins[rows[::step][is_other], columns[::step][is_other]]
        )

    def add_to(
        self,
        colour: Float64[np.ndarray, " n"],
        sky: Int64[np.ndarray, " n"],
        middle: Float64[np.ndarray, "n 3"],
        leaf_log_odds: Float64[np.ndarray, " bins"],
        crowns: Crowns,
        caster: RayCaster,
    ) -> None:
        """Add this view's evidence for the visible cells: log-odds of their colour, count of sky.

        Cells with measured leaves behind them are skipped, because a pixel may show those instead.
        """
        sightlines = self.view.sightlines(middle, OBJECT_VIEW_M)
        beyond_m = sightlines.beyond_m(caster)
        is_open, is_measured = beyond_m > DEPTH_TOLERANCE_M, np.isfinite(beyond_m)
        reach_m = np.where(is_measured, sightlines.distance_m + beyond_m, 0.0)
        is_open &= ~(
            is_measured & crowns.contain(sightlines.eye_m + reach_m[:, None] * sightlines.ray)
        )
        kind = self.view.classes_at(sightlines)
        np.add.at(sky, sightlines.row[is_open & (kind > 0)], 1)
        sightlines = sightlines.select(
            is_open & (kind < 0) & (sightlines.distance_m < _Shape.max_colour_m)
        )
        log_odds, most = leaf_log_odds[self.bins[sightlines.pixel]], _Shape.colour_log_odds[0]
        np.add.at(colour, sightlines.row, np.clip(log_odds, -most, most))


def _leaf_log_odds(leaf_views: Iterable[_LeafView]) -> Float64[np.ndarray, " bins"]:
    """Return the log-likelihood ratio of each chroma bin: leaves against everything else."""
    counts = np.zeros((2, _Chroma.bins**2))
    for leaf_view in leaf_views:
        for k, found in enumerate((leaf_view.leaves, leaf_view.others)):
            counts[k] += np.bincount(found, minlength=_Chroma.bins**2)
    if (counts.sum(axis=1) == 0).any():
        return np.zeros(_Chroma.bins**2)
    grids = counts.reshape(2, _Chroma.bins, _Chroma.bins)
    smooth = np.stack([ndimage.gaussian_filter(g, _Chroma.blur, mode="nearest") for g in grids])
    frequency = (smooth + 1) / (smooth.sum(axis=(1, 2), keepdims=True) + _Chroma.bins**2)
    return np.log(frequency[0] / frequency[1]).ravel()


def _chroma_bins(srgb8: UInt8[np.ndarray, "h w 3"]) -> Int64[np.ndarray, "h w"]:
    """Return the flat index of each pixel's chroma bin."""
    light = np.log2(np.maximum(linear_from_srgb8(srgb8), DARK_LINEAR))
    chroma = (light[..., [0, 2]] - light[..., 1:2] + _Chroma.limit) * (
        _Chroma.bins / (2 * _Chroma.limit)
    )
    cell = np.clip(chroma, 0, _Chroma.bins - 1).astype(np.int64)
    return cell[..., 0] * _Chroma.bins + cell[..., 1]
