"""Walls with too few returns for a mesh: side walls above low roofs, fronts of cross streets.

High beams are metres apart. Their returns above the dense part of a sweep do not form a surface,
and the background proxy would show the wall at a wrong distance. But returns of several sweeps lie
on one upright plane to within centimetres, no beam passes through it, and no view shows sky there,
as it would between wires.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree

from lightsim.core.buildings import Wall
from lightsim.core.casting import RayCaster
from lightsim.core.fields import GroundMap
from lightsim.geometry.completion.crowns import Beams, Crowns
from lightsim.geometry.completion.far_walls import FOOT_M, LOWEST_M, lowest_ground_m, pieces
from lightsim.geometry.completion.view_evidence import WALL_VIEW_M, ViewEvidence

# All values below were chosen on log 002; their joint effect was measured there and on streets
# (docs/benchmarks/reconstruction.md).


class _Search:
    """RANSAC search for planes."""

    known_m = 0.6  # Distance from known surface within which returns are explained.
    thin_m = 0.25  # Edge of the cubes of which one return each is used.
    apart_m = (1.0, 6.0)  # Distance between the returns of a hypothesis.
    draws = 300  # Hypotheses of a round.
    rounds = 40  # Rounds, each with one plane.
    reach_m = 15.0  # Distance around a hypothesis in which it is scored.
    cell_m = (1.0, 0.5)  # Cells of a plane, along and up.
    least_cells = 16  # Least number of cells with returns.


class _Limits:
    """Limits of a wall on a plane."""

    on_plane_m = 0.15  # Distance of returns on a plane.
    around_m = 1.0  # Distance of returns around it.
    least_on_plane = 0.6  # Least fraction of the returns around a plane that lie on it.
    height_m = 2.0  # Least height of all returns,
    column_height_m = 1.0  # and of their columns, in the median.
    least_filled = 0.2  # Least fraction of cells with returns.
    least_stopped = 0.6  # Least fraction of the beams towards the wall that end on it.
    corner_m = 2.5  # Distance up to which a wall is extended to another one across it,
    least_across = 0.3  # with at least this sine of the angle between the two.
    most_sky = 0.1  # Greatest fraction of test points that views show as sky.
    place_m = 0.5  # Distance between these test points.
    near_ground_m = 3.0  # Height of the lowest returns up to which a wall reaches the ground.


def find_sparse_walls(
    known: Sequence[Wall],
    beams: Beams,
    evidence: ViewEvidence,
    crowns: Crowns,
    ground: GroundMap,
    caster: RayCaster,
) -> list[Wall]:
    """Find upright planes with returns that neither a mesh nor a known wall explains, greatest
    first.

    RANSAC with two returns as hypothesis (Fischler and Bolles 1981, doi:10.1145/358669.358692).

    Args:
        known: walls that are known already.
        beams: beams that ended on static surfaces.
        evidence: the views of the log.
        crowns: foliage, which explains returns.
        ground: height of the walls' feet.
        caster: over the measured background and vehicles at rest.

    Raises:
        InputError: a matte does not fit its camera.
    """
    points = _unexplained(known, beams, crowns, ground, caster)
    rng = np.random.default_rng(0)
    is_free = np.ones(len(points), dtype=bool)
    found: list[Wall] = []
    for _ in range(_Search.rounds):
        rows = np.flatnonzero(is_free)
        best = _best_line(points[rows], rng)
        if best is None:
            break
        is_free[rows[best]] = False
        walls = _walls_on(_plane(points[rows[best]]), points[rows], beams, ground)
        new = [_to_corners(wall, known) for wall in walls if _shows_matter(wall, evidence)]
        is_free &= ~_lie_on(new, points)
        found.extend(new)
    return found


def _unexplained(
    known: Sequence[Wall], beams: Beams, crowns: Crowns, ground: GroundMap, caster: RayCaster
) -> Float64[np.ndarray, "n 3"]:
    """Return the returns well above the ground that no known surface explains, thinned out."""
    height = beams.ends[:, 2] - ground.look_up(beams.ends[:, :2].astype(np.float64))
    rows = np.flatnonzero(height > LOWEST_M)
    _, first = np.unique(np.floor(beams.ends[rows] / _Search.thin_m), axis=0, return_index=True)
    rows = rows[np.sort(first)]
    ends, origins = (a[rows].astype(np.float64) for a in (beams.ends, beams.origins))
    way = ends - origins
    distance = np.linalg.norm(way, axis=1)
    hits = caster.intersect(origins, way / np.maximum(distance, 1e-9)[:, None])
    is_new = hits.distance_m > distance + _Search.known_m
    return ends[is_new & ~_lie_on(known, ends) & ~crowns.contain(ends)]


def _lie_on(walls: Sequence[Wall], points: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Return whether points lie near the planes of walls, within their length."""
    is_on = np.zeros(len(points), dtype=bool)
    for wall in walls:
        s, out = wall.place(points)
        is_on |= (np.abs(out) < _Search.known_m) & (s > wall.span_m[0]) & (s < wall.span_m[1])
    return is_on


def _best_line(
    points: Float64[np.ndarray, "n 3"], rng: np.random.Generator
) -> Int64[np.ndarray, " k"] | None:
    """Return the points on the plane with the most cells, less cells beside it; may be None."""
    if len(points) < _Search.least_cells:
        return None
    tree = KDTree(points[:, :2])
    best: Int64[np.ndarray, " k"] | None = None
    best_score = _Search.least_cells - 1.0
    for seed in rng.choice(len(points), min(_Search.draws, len(points)), replace=False):
        near = np.array(tree.query_ball_point(points[seed, :2], _Search.reach_m))
        offset = points[near, :2] - points[seed, :2]
        apart = np.linalg.norm(offset, axis=1)
        partners = np.flatnonzero((apart > _Search.apart_m[0]) & (apart < _Search.apart_m[1]))
        if not len(partners):
            continue
        along = offset[rng.choice(partners)]
        along = along / np.linalg.norm(along)
        out = np.abs(offset @ [-along[1], along[0]])
        on, beside = (
            near[out < _Limits.on_plane_m],
            near[(out > _Limits.on_plane_m) & (out < 3 * _Limits.on_plane_m)],
        )
        # Returns beside the plane count against it: foliage fills a volume.
        score = _cell_count(points[on], along) - 0.5 * _cell_count(points[beside], along)
        if score > best_score:
            best, best_score = on, score
    return best


def _cell_count(points: Float64[np.ndarray, "n 3"], along: Float64[np.ndarray, "2"]) -> int:
    return len(np.unique(_cells(points[:, :2] @ along, points[:, 2]), axis=0))


def _cells(s: Float64[np.ndarray, " n"], z: Float64[np.ndarray, " n"]) -> Int64[np.ndarray, "n 2"]:
    return np.floor(np.stack([s, z], axis=1) / _Search.cell_m).astype(np.int64)


def _plane(points: Float64[np.ndarray, "n 3"]) -> Wall:
    """Return the least-squares upright plane of points; its outer side is arbitrary."""
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
    """Yield the separate walls on one plane; the outer side is that from which the beams come."""
    s, out = plane.place(points)
    is_on = np.abs(out) < _Limits.on_plane_m
    for low, high in pieces(s[is_on]):
        is_in = (s >= low) & (s <= high) & (np.abs(out) < _Limits.around_m)
        own = is_in & is_on
        z = points[own, 2]
        bottom, top = np.percentile(z, (2, 98))
        column = np.floor(s[own] - low).astype(np.int64)
        filled = len(np.unique(_cells(s[own], z), axis=0)) * _Search.cell_m[0] * _Search.cell_m[1]
        is_wall = (
            own.sum() >= _Limits.least_on_plane * is_in.sum() and top - bottom >= _Limits.height_m
        )
        is_wall &= filled >= _Limits.least_filled * (high - low) * (top - bottom)
        if not is_wall or _column_height_m(column, z) < _Limits.column_height_m:
            continue
        before, behind = _stops(plane, beams, (low, high), (bottom, top))
        stopped, passed = before + behind
        if stopped < _Limits.least_stopped * (stopped + passed):
            continue
        wall = plane if before[0] >= behind[0] else _wall(plane.origin_m, -plane.normal)
        span = (low, high) if wall is plane else (-high, -low)
        lowest = lowest_ground_m(wall, span, ground)
        foot = lowest if bottom - lowest < _Limits.near_ground_m else float(bottom)
        yield Wall(wall.origin_m, wall.normal, wall.along, span, (foot - FOOT_M, float(z.max())))


def _shows_matter(wall: Wall, evidence: ViewEvidence) -> bool:
    """Return whether views show a wall, and hardly any sky there."""
    counts = [int((b - a) / _Limits.place_m) for a, b in (wall.span_m, wall.height_m)]
    places = wall.at(*wall.grid(_Limits.place_m, (counts[0], counts[1]))).reshape(-1, 3)
    sky, total = 0, 0
    for view in evidence.views():
        lines = view.lines(places, WALL_VIEW_M)
        sky += int((view.kinds_at(lines) > 0).sum())
        total += len(lines.row)
    return total > 0 and sky <= _Limits.most_sky * total


def _to_corners(wall: Wall, others: Sequence[Wall]) -> Wall:
    """Move the ends of a wall to other walls across it that lie near by.

    Returns become sparse towards corners, and columns of them may extend beyond.
    """
    low, high = wall.span_m
    for other in others:
        across = float(wall.along @ other.normal)
        if abs(across) < _Limits.least_across:
            continue
        s = float((other.origin_m - wall.origin_m) @ other.normal) / across
        along, _ = other.place(wall.at(np.array([s]), np.zeros(1)))
        if not other.span_m[0] - _Search.cell_m[0] < along[0] < other.span_m[1] + _Search.cell_m[0]:
            continue
        if low - _Limits.corner_m < s < low + _Search.cell_m[0]:
            low = s
        elif high - _Search.cell_m[0] < s < high + _Limits.corner_m:
            high = s
    return replace(wall, span_m=(low, high))


def _column_height_m(column: Int64[np.ndarray, " n"], z: Float64[np.ndarray, " n"]) -> float:
    """Return the median over columns of the range of their heights."""
    low, high = np.full(int(column.max()) + 1, np.inf), np.full(int(column.max()) + 1, -np.inf)
    np.minimum.at(low, column, z)
    np.maximum.at(high, column, z)
    return float(np.median((high - low)[np.isfinite(low)]))


def _stops(
    plane: Wall, beams: Beams, span_m: tuple[float, float], height_m: tuple[float, float]
) -> tuple[Int64[np.ndarray, "2"], Int64[np.ndarray, "2"]]:
    """Return numbers of beams that end on and that pass a part of a plane: front, behind."""
    start = ((beams.origins - plane.origin_m) @ plane.normal).astype(np.float64)
    end = ((beams.ends - plane.origin_m) @ plane.normal).astype(np.float64)
    near = np.flatnonzero((start * end < 0) | (np.abs(end) < _Limits.on_plane_m))
    start, end = start[near], end[near]
    reach = start / np.where(np.abs(start - end) > 1e-9, start - end, 1e-9)
    origins = beams.origins[near].astype(np.float64)
    place = origins + reach[:, None] * (beams.ends[near] - origins)
    s, _ = plane.place(place)
    is_in = (s > span_m[0]) & (s < span_m[1])
    is_in &= (place[:, 2] > height_m[0]) & (place[:, 2] < height_m[1])
    is_end = np.abs(end) < _Limits.on_plane_m
    is_past = (start * end < 0) & (np.abs(end) > _Search.known_m)

    def count(side: Bool[np.ndarray, " n"]) -> Int64[np.ndarray, "2"]:
        return np.array([(is_in & side & is_end).sum(), (is_in & side & is_past).sum()])

    return count(start > 0), count(start <= 0)
