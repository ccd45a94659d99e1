"""Crowns beyond what beams tell of them: tops above the highest beam, far sides behind leaves.

A crown is as deep and as high as it is wide, an ellipsoid about its middle. Cells of it that no
beam told of are leaves unless beams passed there, or pictures show sky, or another colour than that
of leaves: the log-odds of all three are summed.
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
from lightsim.geometry.completion.crown_colours import HIDDEN_M, towards_points
from lightsim.geometry.completion.crowns import Beams, Crowns
from lightsim.geometry.completion.free_space_kernels import walk_beams
from lightsim.geometry.completion.silhouettes import ClassifiedView, View, classified_views

# Chosen while looking at streets 0 and 1 of the benchmark; what they bring is measured
# (docs/benchmarks/reconstruction.md).

# Log-odds of a cell within the ellipsoid; of sky in one view, and at most in all.
_WITHIN, _SKY, _MOST_SKY = 1.1, -2.0, 6.0
# Colours of one view and of all views tell at most so much: views of a place are much alike.
_COLOUR, _MOST_COLOUR = 1.5, 4.0
# Crowns wider than this, or so many times as wide as they are seen high, are several in a row.
_MOST_WIDTH_M, _MOST_ASPECT = 6.0, 2.5
# Ends of a crown: fractions of its voxels.
_ENDS = (0.03, 0.97)
# Colours from further away do not count, which distant trees share.
_MAX_COLOUR_M = 30.0
# Chroma: logs to base 2 of red and blue over green, in bins; blurred, so that few samples do.
_CHROMA, _BINS, _BLUR, _DARKEST = 2.0, 24, 1.0, 2e-3
_SAMPLES = 2000
"""Pixels of each view that tell the colours of all that is no leaf."""


def unseen_leaves(
    crowns: Crowns,
    beams: Beams,
    walls: Sequence[Wall],
    views: Iterable[View],
    caster: RayCaster,
) -> Float64[np.ndarray, "n 3"]:
    """Middles of the cells (of `crowns.voxel_m`) that are full of leaves, though no beam stopped
    there, frame world, metres.

    Args:
        beams: of what stands still, all that `find_crowns` has seen.
        walls: behind which nothing grows.
        views: frames with their camera (of the matte's size) and sky matte.
        caster: over the measured background, crowns as cards.

    Raises:
        InputError: a matte does not fit its camera.
    """
    cell, crown = _within(crowns)
    if not len(cell):
        return np.zeros((0, 3))
    odds = _WITHIN - _passed(crowns, cell, crown, beams)
    middle = crowns.low_m + (cell + 0.5) * crowns.voxel_m
    odds[_is_behind(middle, crowns, crown, walls)] = -np.inf
    looks = [_Look.of(view, crowns, caster) for view in classified_views(views)]
    seen, colours = _Seen.of(len(cell)), _Colours.of(looks)
    for look in looks:
        look.at(middle, seen, colours, crowns, caster)
    odds += np.clip(seen.colour, -_MOST_COLOUR, _MOST_COLOUR)
    odds += np.maximum(_SKY * seen.sky, -_MOST_SKY)
    return middle[odds > 0]


def _within(crowns: Crowns) -> tuple[Int64[np.ndarray, "n 3"], Int64[np.ndarray, " n"]]:
    """Cells within the crowns' ellipsoids that are not measured, and whose they are; pieces with a
    voxel between them are one crown, unless that is too wide."""
    found: dict[tuple[int, ...], int] = {}
    for rows in _pieces_together(crowns):
        numbers = crowns.crown[rows]
        whole = _ellipsoid(crowns, crowns.cells[rows])
        parts = [rows] if len(whole) else [rows[numbers == k] for k in np.unique(numbers)]
        for part in parts:
            for cell in _ellipsoid(crowns, crowns.cells[part]).tolist():
                found.setdefault(tuple(cell), int(crowns.crown[part[0]]))
    for cell in crowns.cells.tolist():
        found.pop(tuple(cell), None)
    return np.array([*found], np.int64).reshape(-1, 3), np.array([*found.values()], np.int64)


def _pieces_together(crowns: Crowns) -> Iterator[Int64[np.ndarray, " m"]]:
    """Voxels of crowns that have at most a voxel between them."""
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
    """Cells of what these voxels are a part of, seen from the path; none where they may be those of
    several crowns."""
    edge = crowns.voxel_m
    points = crowns.low_m + (own + 0.5) * edge
    eye = crowns.nearest_eyes(points.mean(axis=0)[None])[0]
    away = points.mean(axis=0)[:2] - eye[:2]
    away /= max(float(np.linalg.norm(away)), 1e-9)
    across = np.array([-away[1], away[0]])
    (left, right), (near, far), (low, high) = (
        np.quantile(x, _ENDS) + (-edge / 2, edge / 2)
        for x in (points[:, :2] @ across, points[:, :2] @ away, points[:, 2])
    )
    width = right - left
    if width > min(_MOST_WIDTH_M, _MOST_ASPECT * (high - low)):
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


def _passed(
    crowns: Crowns, cell: Int64[np.ndarray, "n 3"], crown: Int64[np.ndarray, " n"], beams: Beams
) -> Float64[np.ndarray, " n"]:
    """How improbable leaves are by what passed: free way times the extinction of the crown (Beer
    and Lambert). Infinite where beams stopped on what is no crown."""
    low = cell.min(axis=0)
    shape = tuple((cell.max(axis=0) - low + 1).tolist())
    stops, entries = (np.zeros(shape, np.int32) for _ in range(2))
    way = np.zeros(shape, np.float32)
    corner = crowns.low_m + low * crowns.voxel_m
    origins, ends = (
        (p.astype(np.float64) - corner) / crowns.voxel_m for p in (beams.origins, beams.ends)
    )
    walk_beams(origins, ends, stops, entries, way)
    place = tuple((cell - low).T)
    found = crowns.usual_extinction[crown] * crowns.voxel_m * way[place].astype(np.float64)
    found[stops[place] > 0] = np.inf
    return found


def _is_behind(
    middle: Float64[np.ndarray, "n 3"],
    crowns: Crowns,
    crown: Int64[np.ndarray, " n"],
    walls: Sequence[Wall],
) -> Bool[np.ndarray, " n"]:
    """Cells on or behind a wall that their crown stands before."""
    points = crowns.middle_m
    centres = np.stack([points[crowns.crown == k].mean(axis=0) for k in range(len(crowns))])
    found = np.zeros(len(middle), dtype=bool)
    for wall in walls:
        s, out = wall.place(middle)
        is_before = wall.place(centres)[1][crown] > 0
        found |= is_before & (out < 0) & (s > wall.span_m[0]) & (s < wall.span_m[1])
    return found


@dataclass(eq=False)
class _Seen:
    """What views say of each cell: log-odds of its colours, and how many show sky."""

    colour: Float64[np.ndarray, " n"]
    sky: Int64[np.ndarray, " n"]

    @staticmethod
    def of(count: int) -> _Seen:
        return _Seen(np.zeros(count), np.zeros(count, np.int64))


@dataclass(frozen=True, eq=False)
class _Look:
    """A view with its picture, and colours in it of leaves and of all else."""

    view: ClassifiedView
    bins: Int64[np.ndarray, "h w"]
    leaves: Int64[np.ndarray, " a"]
    others: Int64[np.ndarray, " b"]

    @staticmethod
    def of(view: ClassifiedView, crowns: Crowns, caster: RayCaster) -> _Look:
        frame, camera, kinds = view
        bins = _chroma_bins(frame.load_srgb8())
        eye = frame.world_from_camera.translation_m
        pixel, way, distance, _ = towards_points(view, crowns.returns_m)
        hits = caster.intersect(np.broadcast_to(eye, way.shape).copy(), way)
        is_leaf = hits.distance_m > distance - HIDDEN_M
        leaves = bins[pixel[1][is_leaf], pixel[0][is_leaf]]
        rows, columns = np.nonzero(kinds < 0)
        step = max(1, len(rows) // _SAMPLES)
        uv = np.stack([columns[::step], rows[::step]], axis=1) + 0.5
        origins, rays = frame.pixel_rays(camera, uv)
        hits = caster.intersect(origins, rays)
        ends = origins + np.where(hits.is_hit, hits.distance_m, 0.0)[:, None] * rays
        is_other = hits.is_hit & ~crowns.contain(ends)
        return _Look(view, bins, leaves, bins[rows[::step][is_other], columns[::step][is_other]])

    def at(
        self,
        middle: Float64[np.ndarray, "n 3"],
        seen: _Seen,
        colours: _Colours,
        crowns: Crowns,
        caster: RayCaster,
    ) -> None:
        """Add what it says of cells that nothing hides, unless leaves are behind them, too."""
        frame, _, kinds = self.view
        eye = frame.world_from_camera.translation_m
        pixel, way, distance, row = towards_points(self.view, middle)
        hits = caster.intersect(np.broadcast_to(eye, way.shape).copy(), way)
        is_open = hits.distance_m > distance + HIDDEN_M
        ends = eye + np.where(hits.is_hit, hits.distance_m, 0.0)[:, None] * way
        is_open &= ~(hits.is_hit & crowns.contain(ends))
        kind = kinds[pixel[1], pixel[0]]
        np.add.at(seen.sky, row[is_open & (kind > 0)], 1)
        shown = is_open & (kind < 0) & (distance < _MAX_COLOUR_M)
        odds = colours.odds[self.bins[pixel[1][shown], pixel[0][shown]]]
        np.add.at(seen.colour, row[shown], np.clip(odds, -_COLOUR, _COLOUR))


@dataclass(frozen=True, eq=False)
class _Colours:
    """Log of how much more often leaves have a colour than other things do."""

    odds: Float64[np.ndarray, " bins"]

    @staticmethod
    def of(looks: Iterable[_Look]) -> _Colours:
        counts = np.zeros((2, _BINS, _BINS))
        for look in looks:
            for k, found in enumerate((look.leaves, look.others)):
                counts[k] += np.bincount(found, minlength=_BINS**2).reshape(_BINS, _BINS)
        if (counts.sum(axis=(1, 2)) == 0).any():
            return _Colours(np.zeros(_BINS**2))
        smooth = np.stack([ndimage.gaussian_filter(one, _BLUR, mode="nearest") for one in counts])
        share = (smooth + 1) / (smooth.sum(axis=(1, 2), keepdims=True) + _BINS**2)
        return _Colours(np.log(share[0] / share[1]).ravel())


def _chroma_bins(srgb8: UInt8[np.ndarray, "h w 3"]) -> Int64[np.ndarray, "h w"]:
    light = np.log2(np.maximum(linear_from_srgb8(srgb8), _DARKEST))
    chroma = (light[..., [0, 2]] - light[..., 1:2] + _CHROMA) * (_BINS / (2 * _CHROMA))
    cell = np.clip(chroma, 0, _BINS - 1).astype(np.int64)
    return cell[..., 0] * _BINS + cell[..., 1]
