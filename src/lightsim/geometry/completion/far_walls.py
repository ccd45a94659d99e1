"""Walls further down the street, where returns are too few for a mesh but lie on a known plane.

Houses of a row share the plane of their fronts. What stands behind a wall's end is often the same
row seen at a grazing angle, from which a grid of samples keeps nothing; without it the far field
would show those houses as a backdrop that faces the road, in the wrong light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from lightsim.core.buildings import Wall
from lightsim.core.casting import RayCaster
from lightsim.core.fields import GroundMap
from lightsim.geometry.completion.walls import surface_offset_m

# Chosen while looking at log 002 and the streets of seeds 0, 77 and 412; what they bring is
# measured (docs/benchmarks/reconstruction.md).

# Walls at least this wide tell a plane's direction well enough to follow it, this far.
_LEAST_WIDTH_M, _FOLLOWED_M = 8.0, 60.0
# Returns this near a plane lie on it; of those this near, so many must: trees fill a volume.
_ON_PLANE_M, _AROUND_M, _LEAST_ON_PLANE = 0.35, 1.5, 0.6
LOWEST_M = 0.8
# Columns along the plane, their returns, and the widest gap between them.
_COLUMN_M, _LEAST_RETURNS, _MAX_GAP_M = 1.0, 2, 3.0
# Of a wall: width, height above the lowest return, returns.
_WIDTH_M, _HEIGHT_M, _RETURNS = 4.0, 2.0, 15
# A column is measured where the mesh has so much of its returns.
_MEASURED = 0.5
_MESH_NEAR_M = 0.6, 0.6
FOOT_M = 0.25


def find_far_walls(
    walls: Sequence[Wall],
    returns_world: Float32[np.ndarray, "n 3"],
    ground: GroundMap,
    caster: RayCaster,
) -> list[Wall]:
    """Walls on the planes of known ones, where returns lie and the mesh has nothing.

    Args:
        walls: of the measured background.
        returns_world: LiDAR returns of what stands still.
        ground: walls begin at it.
        caster: over the measured background.
    """
    height = returns_world[:, 2] - ground.look_up(returns_world[:, :2].astype(np.float64))
    points = returns_world[height > LOWEST_M].astype(np.float64)
    is_free = np.ones(len(points), dtype=bool)
    found: list[Wall] = []
    for wall in sorted(walls, key=lambda w: w.span_m[0] - w.span_m[1]):
        if wall.span_m[1] - wall.span_m[0] < _LEAST_WIDTH_M:
            continue
        rows = np.flatnonzero(is_free)
        s, out = wall.place(points[rows])
        is_around = (np.abs(out) < _AROUND_M) & (s > wall.span_m[0] - _FOLLOWED_M)
        is_around &= s < wall.span_m[1] + _FOLLOWED_M
        rows, s, out = rows[is_around], s[is_around], out[is_around]
        is_beyond = (s < wall.span_m[0]) | (s > wall.span_m[1])
        is_on = np.abs(out) < _ON_PLANE_M
        if not (is_on & is_beyond).any():
            continue
        is_used = is_beyond & ~_is_measured(wall, points[rows], s, caster)
        for low, high in pieces(s[is_on & is_used]):
            is_in = is_used & (s >= low) & (s <= high)
            own = is_in & is_on
            if own.sum() < max(_RETURNS, _LEAST_ON_PLANE * is_in.sum()):
                continue
            z = points[rows[own], 2]
            if np.percentile(z, 98) - np.percentile(z, 2) < _HEIGHT_M:
                continue
            is_free[rows[own]] = False
            origin = wall.origin_m + float(np.median(out[own])) * wall.normal
            foot = Wall(origin, wall.normal, wall.along, (low, high), (0.0, 0.0))
            middle = foot.at(np.linspace(low, high, 5), np.zeros(5), 1.0)
            lowest = float(ground.look_up(middle[:, :2]).min()) - FOOT_M
            found.append(replace(foot, height_m=(lowest, float(z.max()))))
    return found


def _is_measured(
    wall: Wall,
    points: Float64[np.ndarray, "n 3"],
    s: Float64[np.ndarray, " n"],
    caster: RayCaster,
) -> Bool[np.ndarray, " n"]:
    """Returns in columns that the mesh has already."""
    is_near = np.isfinite(surface_offset_m(wall, s, points[:, 2], caster, _MESH_NEAR_M))
    column = _column(s)
    total = np.maximum(np.bincount(column), 1)
    return (np.bincount(column, is_near) / total > _MEASURED)[column]


def _column(s: Float64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    return np.floor((s - s.min()) / _COLUMN_M).astype(np.int64)


def pieces(s: Float64[np.ndarray, " n"]) -> list[tuple[float, float]]:
    """Stretches of columns with returns, without wide gaps."""
    if len(s) == 0:
        return []
    count = np.bincount(_column(s))
    occupied = np.flatnonzero(count >= _LEAST_RETURNS)
    if len(occupied) == 0:
        return []
    breaks = np.flatnonzero(np.diff(occupied) * _COLUMN_M > _MAX_GAP_M) + 1
    parts = [(int(part[0]), int(part[-1]) + 1) for part in np.split(occupied, breaks)]
    first = float(s.min())
    spans = [(first + a * _COLUMN_M, first + b * _COLUMN_M) for a, b in parts]
    return [(low, high) for low, high in spans if high - low >= _WIDTH_M]
