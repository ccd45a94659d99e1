"""Triangulation of polygons, concave ones included."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64, Int64

# Largest number of corners of a polygon whose corners are all tried as centre of a fan. Of larger
# polygons, only the first is tried, since ear clipping takes as long as further trials.
_MAX_APEXES = 16
# Tolerance of signed triangle area, as a fraction of the polygon's squared extent: rounding of
# float64 coordinates of large buildings.
_FLAT = 1e-9
# Number of candidates that are tested in one array operation; the first is an ear in most cases.
_EARS_AT_ONCE = 8
# Largest number of tests of points against candidates in a file: some five seconds. Models have few
# concave polygons; only hostile files reach the limit.
_MAX_TESTS = 100_000_000
# Largest number of array operations of ear clipping in a file: some ten seconds.
_MAX_CLIPS = 200_000


def triangulate(
    points: Float64[np.ndarray, "n 3"], counts: Int64[np.ndarray, " p"]
) -> tuple[Int64[np.ndarray, "m 3"], Int64[np.ndarray, " m"], int]:
    """Divide polygons into triangles of their corners, with the polygon's orientation.

    If all corners of a polygon are visible from one corner, it becomes a fan around this corner;
    other polygons are divided by ear clipping (Meisters 1975, doi:10.2307/2319703).

    Args:
        points: corners of all polygons, one polygon after the other.
        counts: number of corners of each polygon; fewer than 3 give no triangle.

    Returns:
        Corner indices of each triangle, polygon index of each triangle, and the number of polygons
        that are only approximated by a fan, because they intersect themselves or limits are
        reached.
    """
    start = np.cumsum(counts) - counts
    triangles: list[Int64[np.ndarray, "_ 3"]] = [np.zeros((0, 3), np.int64)]
    polygons: list[Int64[np.ndarray, " _"]] = [np.zeros(0, np.int64)]
    clipper = _EarClipper()
    # Polygons with the same number of corners are processed by the same array operations.
    for count in np.unique(counts[counts >= 3]):
        polygon = np.flatnonzero(counts == count)
        corners = start[polygon, None] + np.arange(count)
        if count > 3:
            flat = _projected(points[corners])
            apex = _fan_apex(flat)
            for n in np.flatnonzero(apex < 0):
                ears = np.array(list(clipper.triangles(flat[n])), np.int64)
                triangles.append(corners[n][ears])
                polygons.append(np.full(len(ears), polygon[n]))
            is_fan = apex >= 0
            turn = (np.arange(count) + apex[is_fan, None]) % count
            polygon = polygon[is_fan]
            corners = np.take_along_axis(corners[is_fan], turn, axis=1)
        fan = np.stack([np.broadcast_to(corners[:, :1], corners[:, 2:].shape), corners[:, 1:-1],
                        corners[:, 2:]], axis=-1)  # fmt: skip
        triangles.append(fan.reshape(-1, 3))
        polygons.append(np.repeat(polygon, int(count) - 2))
    return np.concatenate(triangles), np.concatenate(polygons), clipper.n_approximated


def _projected(corners: Float64[np.ndarray, "g k 3"]) -> Float64[np.ndarray, "g k 2"]:
    """Project polygons onto the coordinate plane in which they are largest, counter-clockwise.

    The largest component of the normal (Newell's method) determines the axis that is omitted.
    """
    local = corners - corners[:, :1]
    normal = np.cross(local, np.roll(local, -1, axis=1)).sum(axis=1)
    axis = np.abs(normal).argmax(axis=1)
    is_turned = np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] < 0
    first, second = (axis + 1) % 3, (axis + 2) % 3
    u = np.where(is_turned, second, first)
    v = np.where(is_turned, first, second)
    return np.take_along_axis(local, np.stack([u, v], axis=1)[:, None, :], axis=2)


def _fan_apex(corners: Float64[np.ndarray, "g k 2"]) -> Int64[np.ndarray, " g"]:
    """Return the first corner whose fan has no triangle of negative area; -1 if there is none."""
    apex = np.full(len(corners), -1, np.int64)
    least = -_FLAT * np.ptp(corners, axis=1).max(axis=1) ** 2
    n_corners = corners.shape[1]
    for candidate in range(n_corners if n_corners <= _MAX_APEXES else 1):
        left = np.flatnonzero(apex < 0)
        if not len(left):
            break
        spokes = np.roll(corners[left], -candidate, axis=1)
        spokes = spokes[:, 1:] - spokes[:, :1]
        area = _cross(spokes[:, :-1], spokes[:, 1:])
        apex[left[(area >= least[left, None]).all(axis=1)]] = candidate
    return apex


class _EarClipper:
    """Ear clipping with one limit of work for all polygons of a file."""

    def __init__(self) -> None:
        self.n_approximated = 0
        self._tests = self._clips = 0

    def triangles(self, corners: Float64[np.ndarray, "k 2"]) -> Iterator[tuple[int, int, int]]:
        """Yield the corner indices of one polygon's triangles."""
        ring = np.arange(len(corners))
        while len(ring) > 3:
            ear = self._ear(corners[ring])
            if ear < 0:
                self.n_approximated += 1
                break
            yield int(ring[ear - 1]), int(ring[ear]), int(ring[(ear + 1) % len(ring)])
            ring = np.delete(ring, ear)
        for second, third in pairwise(ring[1:]):
            yield int(ring[0]), int(second), int(third)

    def _ear(self, corners: Float64[np.ndarray, "k 2"]) -> int:
        """Return a corner whose triangle is inside and contains no other corner; -1 if none."""
        before, after = np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0)
        area = _cross(corners - before, after - corners)
        convex = np.flatnonzero(area > _FLAT * np.ptp(corners, axis=0).max() ** 2)
        for first in range(0, len(convex), _EARS_AT_ONCE):
            chosen = convex[first : first + _EARS_AT_ONCE]
            self._tests += len(chosen) * len(corners)
            self._clips += 1
            if self._tests > _MAX_TESTS or self._clips > _MAX_CLIPS:
                return -1
            ends = np.stack([before[chosen], corners[chosen], after[chosen]], axis=1)
            is_ear = ~_holds_any(ends, corners)
            if is_ear.any():
                return int(chosen[is_ear.argmax()])
        return -1


def _holds_any(
    triangles: Float64[np.ndarray, "c 3 2"], points: Float64[np.ndarray, "k 2"]
) -> Bool[np.ndarray, " c"]:
    """Return whether each triangle contains a point that is not at one of its corners."""
    is_inside = np.ones((len(triangles), len(points)), bool)
    is_corner = np.zeros_like(is_inside)
    for n in range(3):
        offset = points[None] - triangles[:, n, None]
        edge = triangles[:, (n + 1) % 3] - triangles[:, n]
        is_inside &= _cross(edge[:, None], offset) >= 0
        # Other corners at the same position, such as ends of a bridge to a hole, are allowed.
        is_corner |= (offset == 0).all(axis=2)
    return np.any(is_inside & ~is_corner, axis=1)


def _cross(
    a: Float64[np.ndarray, "*n 2"], b: Float64[np.ndarray, "*m 2"]
) -> Float64[np.ndarray, "*k"]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
