"""Search for upright planes in pieces of surface: faces of a mesh, or LiDAR returns.

RANSAC with one piece as hypothesis (Fischler and Bolles 1981, doi:10.1145/358669.358692): position
and normal of a piece determine an upright plane.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lightsim.core.buildings import Wall

# The values below were chosen on log 002 and street 0; only their joint effect was measured
# (docs/benchmarks/reconstruction.md).

# Greatest distance of pieces from their plane, in metres.
THICKNESS_M = 0.2


class _Limits:
    """Search for planes, and limits of the walls on them."""

    seeds = 120  # Hypotheses of each round.
    max_planes = 120  # Greatest number of planes.
    # Least cosine between the normals of a piece and its plane.
    min_cosine = float(np.cos(np.radians(15.0)))
    min_area_m2 = 6.0  # Least measured area.
    min_width_m = 2.0  # Least width; poles and trunks are narrower.
    min_height_m = 1.8  # Least height; sides of vehicles and garden walls are lower.
    max_gap_m = 3.0  # Gap along the plane above which two walls are separate.
    min_density = 0.25  # Least measured fraction of the area that columns span; foliage has less.
    column_m = 1.0  # Width of these columns.


@dataclass(frozen=True, eq=False)
class Pieces:
    """Pieces of upright surface, frame world.

    Args:
        corners: corners of a face, or the one place of a return.
        normal: horizontal unit vectors, outward.
        area_m2: area of each piece.
    """

    corners: Float64[np.ndarray, "n k 3"]
    normal: Float64[np.ndarray, "n 2"]
    area_m2: Float64[np.ndarray, " n"]

    def select(self, rows: Int64[np.ndarray, " m"] | Bool[np.ndarray, " n"]) -> Pieces:
        """Return the selected pieces."""
        return Pieces(self.corners[rows], self.normal[rows], self.area_m2[rows])

    def line(self) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"]]:
        """Return a point and the normal, on the outer side, of the least-squares line in plan."""
        centres, area = self.corners[..., :2].mean(axis=1), self.area_m2[:, None]
        centre = np.average(centres, axis=0, weights=self.area_m2)
        offset = centres - centre
        _, vectors = np.linalg.eigh((offset * area).T @ offset)
        return centre, vectors[:, 0] * np.sign((self.normal * area).sum(axis=0) @ vectors[:, 0])


def walls_among(pieces: Pieces) -> Iterator[Wall]:
    """Yield the rectangles of upright planes with much surface, greatest plane first."""
    centres = np.ascontiguousarray(pieces.corners[..., :2].mean(axis=1))
    rng = np.random.default_rng(0)
    is_free = pieces.area_m2 > 0
    for _ in range(_Limits.max_planes):
        rows = np.flatnonzero(is_free)
        if pieces.area_m2[rows].sum() < _Limits.min_area_m2:
            return
        chosen = rows[_best_plane(pieces.select(rows), centres[rows], rng)]
        plane = pieces.select(chosen)
        if plane.area_m2.sum() < _Limits.min_area_m2:
            return
        yield from _walls_on(plane)
        is_free[chosen] = False


def _best_plane(
    pieces: Pieces, centres: Float64[np.ndarray, "n 2"], rng: np.random.Generator
) -> Bool[np.ndarray, " n"]:
    """Return the pieces on the plane with most area among hypotheses, refined twice."""
    area = pieces.area_m2

    def on(place: Float64[np.ndarray, "2"], normal: Float64[np.ndarray, "2"]) -> np.ndarray:
        is_near = np.abs(centres @ normal - place @ normal) < THICKNESS_M
        return is_near & (pieces.normal @ normal > _Limits.min_cosine)

    # Hypotheses are drawn in proportion to area: large planes are found in few draws.
    seeds = rng.choice(len(area), size=min(_Limits.seeds, len(area)), p=area / area.sum())
    found = [on(centres[seed], pieces.normal[seed]) for seed in seeds]
    best = max(found, key=lambda is_on: float(area[is_on].sum()))
    for _ in range(2):
        refined = on(*pieces.select(best).line())
        if area[refined].sum() < area[best].sum():
            break
        best = refined
    return best


def _walls_on(pieces: Pieces) -> Iterator[Wall]:
    """Yield the separate walls on one plane."""
    centre, normal = pieces.line()
    along = np.array([-normal[1], normal[0]])
    s = (pieces.corners[..., :2] - centre) @ along
    low, high = s.min(axis=1), s.max(axis=1)
    order = np.argsort(low)
    reach = np.maximum.accumulate(high[order])
    starts = np.flatnonzero(low[order][1:] > reach[:-1] + _Limits.max_gap_m) + 1
    for rows in np.split(order, starts):
        z = pieces.corners[rows, :, 2]
        span = (float(low[rows].min()), float(high[rows].max()))
        height = (float(z.min()), float(z.max()))
        is_large = span[1] - span[0] >= _Limits.min_width_m
        is_large &= height[1] - height[0] >= _Limits.min_height_m
        least_m2 = max(_Limits.min_area_m2, _Limits.min_density * _spanned_m2(s[rows], z))
        if is_large and pieces.area_m2[rows].sum() >= least_m2:
            origin, up_to = np.array([*centre, 0.0]), (span, height)
            yield Wall(origin, np.array([*normal, 0.0]), np.array([*along, 0.0]), *up_to)


def _spanned_m2(s: Float64[np.ndarray, "n k"], z: Float64[np.ndarray, "n k"]) -> float:
    """Return the area from the lowest to the highest piece of each column, in square metres.

    Distant walls may be measured near their top alone, so the wall's full rectangle would be too
    large.
    """
    column = np.floor((s.mean(axis=1) - s.min()) / _Limits.column_m).astype(np.int64)
    low = np.full(int(column.max()) + 1, np.inf)
    high = -low
    np.minimum.at(low, column, z.min(axis=1))
    np.maximum.at(high, column, z.max(axis=1))
    return float(np.maximum(high - low, 0.0).sum() * _Limits.column_m)
