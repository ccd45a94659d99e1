"""Walls that too few beams met for a mesh: side walls above low roofs, fronts of cross streets.

High beams lie metres apart. What they met above the dense part of a sweep no grid of samples
keeps, and the far field would show it as a backdrop, at a distance where it does not stand; but
returns of several sweeps lie on one upright plane to within centimetres, no beam goes on through
it, and no view shows sky there, as between wires.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree

from lightsim.core.buildings import Wall
from lightsim.core.casting import RayCaster
from lightsim.core.fields import GroundMap
from lightsim.geometry.completion.crowns import Beams, Crowns
from lightsim.geometry.completion.far_walls import FOOT_M, LOWEST_M, pieces
from lightsim.geometry.completion.silhouettes import ClassifiedView, View, classified_views

# Chosen while looking at log 002; what they bring there and on streets is measured
# (docs/benchmarks/reconstruction.md).

# Returns this near a surface that is known belong to it.
_KNOWN_M = 0.6
# One return for each cube of this edge is enough.
_THIN_M = 0.25
# Planes are drawn through two returns this far apart, so many a round, for so many rounds, and
# looked at this far around.
_APART_M, _DRAWS, _ROUNDS, _REACH_M = (1.0, 6.0), 300, 40, 15.0
# Returns this near a plane lie on it; of those this near, so many must.
_ON_PLANE_M, _AROUND_M, _LEAST_ON_PLANE = 0.15, 1.0, 0.6
# Along and up: cells of a plane, and how many of them must have returns.
_CELL_M, _LEAST_CELLS = (1.0, 0.5), 16
# Of a wall: height of its returns, in the median over columns, too; fraction of its cells.
_HEIGHT_M, _COLUMN_HEIGHT_M, _LEAST_FILLED = 2.0, 1.0, 0.2
# Of the beams that come to its plane, so many must end there.
_LEAST_STOPPED = 0.6
# Walls go on this far to one that stands across.
_CORNER_M, _LEAST_ACROSS = 2.5, 0.3
# Of the places between its returns that views look at, so many at most may show sky.
_MOST_SKY, _PLACE_M, _MAX_VIEW_M = 0.1, 0.5, 90.0
# A wall whose returns begin this near the ground stands on it.
_NEAR_GROUND_M = 3.0


def find_sparse_walls(
    known: Sequence[Wall],
    beams: Beams,
    silhouettes: Iterable[View],
    crowns: Crowns,
    ground: GroundMap,
    caster: RayCaster,
) -> list[Wall]:
    """Upright planes with returns that neither a mesh nor a known wall explains, greatest first.

    RANSAC with two returns as hypothesis (Fischler and Bolles 1981, doi:10.1145/358669.358692).

    Args:
        known: walls that are there already.
        beams: of what stands still.
        silhouettes: frames with their camera (of the matte's size) and sky matte.
        crowns: returns of leaves are explained.
        ground: walls begin at it.
        caster: over the measured background and vehicles at rest.

    Raises:
        InputError: a matte does not fit its camera.
    """
    views = list(classified_views(silhouettes))
    points = _unexplained(known, beams, crowns, ground, caster)
    rng = np.random.default_rng(0)
    is_free = np.ones(len(points), dtype=bool)
    found: list[Wall] = []
    for _ in range(_ROUNDS):
        rows = np.flatnonzero(is_free)
        best = _best_line(points[rows], rng)
        if best is None:
            break
        is_free[rows[best]] = False
        walls = _walls_on(_plane(points[rows[best]]), points[rows], beams, ground)
        new = [_to_corners(wall, known) for wall in walls if _shows_matter(wall, views)]
        is_free &= ~_lie_on(new, points)
        found.extend(new)
    return found


def _unexplained(
    known: Sequence[Wall], beams: Beams, crowns: Crowns, ground: GroundMap, caster: RayCaster
) -> Float64[np.ndarray, "n 3"]:
    """Returns well above the ground where nothing is known to stand, thinned out."""
    height = beams.ends[:, 2] - ground.look_up(beams.ends[:, :2].astype(np.float64))
    rows = np.flatnonzero(height > LOWEST_M)
    _, first = np.unique(np.floor(beams.ends[rows] / _THIN_M), axis=0, return_index=True)
    rows = rows[np.sort(first)]
    ends, origins = (a[rows].astype(np.float64) for a in (beams.ends, beams.origins))
    way = ends - origins
    distance = np.linalg.norm(way, axis=1)
    hits = caster.intersect(origins, way / np.maximum(distance, 1e-9)[:, None])
    is_new = hits.distance_m > distance + _KNOWN_M
    return ends[is_new & ~_lie_on(known, ends) & ~crowns.contain(ends)]


def _lie_on(walls: Sequence[Wall], points: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Points near the planes of walls, as far as these reach along."""
    is_on = np.zeros(len(points), dtype=bool)
    for wall in walls:
        s, out = wall.place(points)
        is_on |= (np.abs(out) < _KNOWN_M) & (s > wall.span_m[0]) & (s < wall.span_m[1])
    return is_on


def _best_line(
    points: Float64[np.ndarray, "n 3"], rng: np.random.Generator
) -> Int64[np.ndarray, " k"] | None:
    """Those on the upright plane through two that most cells have points of, and few beside."""
    if len(points) < _LEAST_CELLS:
        return None
    tree = KDTree(points[:, :2])
    best: Int64[np.ndarray, " k"] | None = None
    best_score = _LEAST_CELLS - 1.0
    for seed in rng.choice(len(points), min(_DRAWS, len(points)), replace=False):
        near = np.array(tree.query_ball_point(points[seed, :2], _REACH_M))
        offset = points[near, :2] - points[seed, :2]
        apart = np.linalg.norm(offset, axis=1)
        partners = np.flatnonzero((apart > _APART_M[0]) & (apart < _APART_M[1]))
        if not len(partners):
            continue
        along = offset[rng.choice(partners)]
        along = along / np.linalg.norm(along)
        out = np.abs(offset @ [-along[1], along[0]])
        on, beside = near[out < _ON_PLANE_M], near[(out > _ON_PLANE_M) & (out < 3 * _ON_PLANE_M)]
        # What fills a volume lies beside any plane, too.
        score = _cell_count(points[on], along) - 0.5 * _cell_count(points[beside], along)
        if score > best_score:
            best, best_score = on, score
    return best


def _cell_count(points: Float64[np.ndarray, "n 3"], along: Float64[np.ndarray, "2"]) -> int:
    return len(np.unique(_cells(points[:, :2] @ along, points[:, 2]), axis=0))


def _cells(s: Float64[np.ndarray, " n"], z: Float64[np.ndarray, " n"]) -> Int64[np.ndarray, "n 2"]:
    return np.floor(np.stack([s, z], axis=1) / _CELL_M).astype(np.int64)


def _plane(points: Float64[np.ndarray, "n 3"]) -> Wall:
    """The upright plane nearest to points (least squares), either side outside."""
    centre = np.median(points[:, :2], axis=0)
    offset = points[:, :2] - centre
    _, vectors = np.linalg.eigh(offset.T @ offset)
    return _wall(np.array([*centre, 0.0]), np.array([*vectors[:, 0], 0.0]))


def _wall(origin: Float64[np.ndarray, "3"], normal: Float64[np.ndarray, "3"]) -> Wall:
    along = np.array([-normal[1], normal[0], 0.0])
    return Wall(origin, normal, along, (0.0, 0.0), (0.0, 0.0))


def _walls_on(
    plane: Wall, points: Float64[np.ndarray, "n 3"], beams: Beams, ground: GroundMap
) -> Iterator[Wall]:
    """The walls on one plane, apart from each other; outside is where the beams come from."""
    s, out = plane.place(points)
    is_on = np.abs(out) < _ON_PLANE_M
    for low, high in pieces(s[is_on]):
        is_in = (s >= low) & (s <= high) & (np.abs(out) < _AROUND_M)
        own = is_in & is_on
        z = points[own, 2]
        bottom, top = np.percentile(z, (2, 98))
        column = np.floor(s[own] - low).astype(np.int64)
        filled = len(np.unique(_cells(s[own], z), axis=0)) * _CELL_M[0] * _CELL_M[1]
        is_wall = own.sum() >= _LEAST_ON_PLANE * is_in.sum() and top - bottom >= _HEIGHT_M
        is_wall &= filled >= _LEAST_FILLED * (high - low) * (top - bottom)
        if not is_wall or _column_height_m(column, z) < _COLUMN_HEIGHT_M:
            continue
        before, behind = _stops(plane, beams, (low, high), (bottom, top))
        stopped, passed = before + behind
        if stopped < _LEAST_STOPPED * (stopped + passed):
            continue
        wall = plane if before[0] >= behind[0] else _wall(plane.origin_m, -plane.normal)
        span = (low, high) if wall is plane else (-high, -low)
        middle = wall.at(np.linspace(*span, 5), np.zeros(5), 1.0)
        lowest = float(ground.look_up(middle[:, :2]).min())
        foot = lowest if bottom - lowest < _NEAR_GROUND_M else float(bottom)
        yield Wall(wall.origin_m, wall.normal, wall.along, span, (foot - FOOT_M, float(z.max())))


def _shows_matter(wall: Wall, views: Sequence[ClassifiedView]) -> bool:
    """Whether views look at a wall, and hardly see sky there."""
    counts = [int((b - a) / _PLACE_M) for a, b in (wall.span_m, wall.height_m)]
    places = wall.at(*wall.grid(_PLACE_M, (counts[0], counts[1]))).reshape(-1, 3)
    sky, seen = 0, 0
    for frame, camera, kinds in views:
        near = np.linalg.norm(places - frame.world_from_camera.translation_m, axis=1) < _MAX_VIEW_M
        uv, is_inside = frame.project(camera, places[near])
        uv = uv[is_inside].astype(np.int64)
        sky, seen = sky + int((kinds[uv[:, 1], uv[:, 0]] > 0).sum()), seen + len(uv)
    return seen > 0 and sky <= _MOST_SKY * seen


def _to_corners(wall: Wall, others: Sequence[Wall]) -> Wall:
    """Ends at another wall that stands near its end: returns thin out towards corners, and columns
    of them may reach beyond."""
    low, high = wall.span_m
    for other in others:
        across = float(wall.along @ other.normal)
        if abs(across) < _LEAST_ACROSS:
            continue
        s = float((other.origin_m - wall.origin_m) @ other.normal) / across
        along, _ = other.place(wall.at(np.array([s]), np.zeros(1)))
        if not other.span_m[0] - _CELL_M[0] < along[0] < other.span_m[1] + _CELL_M[0]:
            continue
        if low - _CORNER_M < s < low + _CELL_M[0]:
            low = s
        elif high - _CELL_M[0] < s < high + _CORNER_M:
            high = s
    return replace(wall, span_m=(low, high))


def _column_height_m(column: Int64[np.ndarray, " n"], z: Float64[np.ndarray, " n"]) -> float:
    """Median over columns of how far the heights in them reach."""
    low, high = np.full(int(column.max()) + 1, np.inf), np.full(int(column.max()) + 1, -np.inf)
    np.minimum.at(low, column, z)
    np.maximum.at(high, column, z)
    return float(np.median((high - low)[np.isfinite(low)]))


def _stops(
    plane: Wall, beams: Beams, span_m: tuple[float, float], height_m: tuple[float, float]
) -> tuple[Int64[np.ndarray, "2"], Int64[np.ndarray, "2"]]:
    """Beams that end on a part of a plane, and that pass it: from before, and from behind."""
    start = ((beams.origins - plane.origin_m) @ plane.normal).astype(np.float64)
    end = ((beams.ends - plane.origin_m) @ plane.normal).astype(np.float64)
    near = np.flatnonzero((start * end < 0) | (np.abs(end) < _ON_PLANE_M))
    start, end = start[near], end[near]
    reach = start / np.where(np.abs(start - end) > 1e-9, start - end, 1e-9)
    origins = beams.origins[near].astype(np.float64)
    place = origins + reach[:, None] * (beams.ends[near] - origins)
    s, _ = plane.place(place)
    is_in = (s > span_m[0]) & (s < span_m[1])
    is_in &= (place[:, 2] > height_m[0]) & (place[:, 2] < height_m[1])
    is_end = np.abs(end) < _ON_PLANE_M
    is_past = (start * end < 0) & (np.abs(end) > _KNOWN_M)

    def count(side: Bool[np.ndarray, " n"]) -> Int64[np.ndarray, "2"]:
        return np.array([(is_in & side & is_end).sum(), (is_in & side & is_past).sum()])

    return count(start > 0), count(start <= 0)
