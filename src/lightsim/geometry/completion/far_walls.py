"""Distant walls on the planes of known walls, where returns are too sparse for a mesh.

Houses of a row have a common front plane. Surface beyond a wall's end is often the same row at a
grazing angle, where the mesh has nothing. Without these walls the background proxy would show the
houses facing the road, with wrong shading.
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

# The values below were chosen on log 002 and streets 0, 77 and 412; only their joint effect was
# measured.


class _Limits:
    """Limits of planes that are extended, and of the distant walls on them."""

    # Least width of a known wall; planes of narrower ones have uncertain directions.
    least_width_m = 8.0
    followed_m = 60.0  # Distance up to which its plane is extended beyond its ends.
    on_plane_m = 0.35  # Distance of returns on the plane.
    around_m = 1.5  # Distance of returns around it.
    # Least fraction of the returns around that lie on it: trees fill a volume.
    least_on_plane = 0.6
    column_m = 1.0  # Width of a column along the plane.
    least_returns = 2  # Least number of returns of a column.
    max_gap_m = 3.0  # Widest gap between columns of one wall.
    width_m = 4.0  # Least width of a distant wall,
    height_m = 2.0  # least height of its returns,
    returns = 15  # and least number of them.
    measured = 0.5  # Fraction of returns on the mesh above which a column is measured already.
    mesh_near_m = (0.6, 0.6)  # Distances of the mesh before and behind the plane.


# Height above the ground from which returns are used, in metres, so that the ground is excluded.
LOWEST_M = 0.8
# Depth of a wall's foot below the ground, in metres, so that no gap opens there.
FOOT_M = 0.25


def find_far_walls(
    walls: Sequence[Wall],
    returns_world: Float32[np.ndarray, "n 3"],
    ground: GroundMap,
    caster: RayCaster,
) -> list[Wall]:
    """Find walls on the planes of known walls, where returns lie without a mesh.

    Args:
        walls: walls of the measured background.
        returns_world: LiDAR returns from static surfaces, frame world.
        ground: height of the walls' feet.
        caster: over the measured background.
    """
    height = returns_world[:, 2] - ground.look_up(returns_world[:, :2].astype(np.float64))
    points = returns_world[height > LOWEST_M].astype(np.float64)
    is_free = np.ones(len(points), dtype=bool)
    found: list[Wall] = []
    # Wide walls first: their planes are the most accurate, and each return is used once.
    for wall in sorted(walls, key=lambda w: w.span_m[0] - w.span_m[1]):
        if wall.span_m[1] - wall.span_m[0] < _Limits.least_width_m:
            continue
        rows = np.flatnonzero(is_free)
        s, out = wall.place(points[rows])
        is_around = (np.abs(out) < _Limits.around_m) & (s > wall.span_m[0] - _Limits.followed_m)
        is_around &= s < wall.span_m[1] + _Limits.followed_m
        rows, s, out = rows[is_around], s[is_around], out[is_around]
        is_beyond = (s < wall.span_m[0]) | (s > wall.span_m[1])
        is_on = np.abs(out) < _Limits.on_plane_m
        if not (is_on & is_beyond).any():
            continue
        is_used = is_beyond & ~_is_measured(wall, points[rows], s, caster)
        for low, high in pieces(s[is_on & is_used]):
            is_in = is_used & (s >= low) & (s <= high)
            own = is_in & is_on
            if own.sum() < max(_Limits.returns, _Limits.least_on_plane * is_in.sum()):
                continue
            z = points[rows[own], 2]
            if np.percentile(z, 98) - np.percentile(z, 2) < _Limits.height_m:
                continue
            is_free[rows[own]] = False
            # Houses of a row are set back differently: each wall has the median of its returns.
            origin = wall.origin_m + float(np.median(out[own])) * wall.normal
            foot = Wall(origin, wall.normal, wall.along, (low, high), (0.0, 0.0))
            bottom = lowest_ground_m(foot, (low, high), ground) - FOOT_M
            found.append(replace(foot, height_m=(bottom, float(z.max()))))
    return found


def lowest_ground_m(wall: Wall, span_m: tuple[float, float], ground: GroundMap) -> float:
    """Return the least height of the ground 1 m in front of a part of a wall, in metres."""
    places = wall.at(np.linspace(*span_m, 5), np.zeros(5), 1.0)
    return float(ground.look_up(places[:, :2]).min())


def _is_measured(
    wall: Wall,
    points: Float64[np.ndarray, "n 3"],
    s: Float64[np.ndarray, " n"],
    caster: RayCaster,
) -> Bool[np.ndarray, " n"]:
    """Return whether each return lies in a column that the mesh covers already."""
    is_near = np.isfinite(surface_offset_m(wall, s, points[:, 2], caster, _Limits.mesh_near_m))
    column = _column(s)
    total = np.maximum(np.bincount(column), 1)
    return (np.bincount(column, is_near) / total > _Limits.measured)[column]


def _column(s: Float64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    return np.floor((s - s.min()) / _Limits.column_m).astype(np.int64)


def pieces(s: Float64[np.ndarray, " n"]) -> list[tuple[float, float]]:
    """Return the ends of the stretches of columns with returns, without wide gaps."""
    if len(s) == 0:
        return []
    count = np.bincount(_column(s))
    occupied = np.flatnonzero(count >= _Limits.least_returns)
    if len(occupied) == 0:
        return []
    breaks = np.flatnonzero(np.diff(occupied) * _Limits.column_m > _Limits.max_gap_m) + 1
    parts = [(int(part[0]), int(part[-1]) + 1) for part in np.split(occupied, breaks)]
    first = float(s.min())
    spans = [(first + a * _Limits.column_m, first + b * _Limits.column_m) for a, b in parts]
    return [(low, high) for low, high in spans if high - low >= _Limits.width_m]
