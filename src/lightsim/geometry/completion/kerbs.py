"""Kerbs along the path as upright faces.

A kerb is about as high as the distance between the field's samples, so extraction turns it into a
ramp with the light of level ground. Returns give its edge to a few centimetres: the height profile
across the path has a step, and steps of successive profiles are linked to chains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.ndimage import correlate1d, maximum_filter1d, median_filter
from scipy.spatial import KDTree

from lightsim.core.fields import GroundMap
from lightsim.core.mesh import TriMesh
from lightsim.geometry.completion.ground import GROUND_BAND_M

# The values below were chosen on streets 0 and 1 of the benchmark; only their joint effect was
# measured.


class _Profile:
    """Height profiles across the path, and limits of their steps."""

    station_m = 0.5  # Distance between profiles along the path.
    beyond_m = 25.0  # Extension of the path beyond its ends.
    heading_m = 2.0  # Length of the path that gives the direction there.
    aside_m = 15.0  # Half the width of a profile.
    bin_m = 0.02  # Width of a bin.
    sides = (5, 22)  # Bins from a step between which heights count.
    min_returns = 6  # Least number of returns on each side.
    max_std_m = 0.03  # Greatest standard deviation of the heights of a side.
    heights_m = (0.05, 0.3)  # Least and greatest height of a step.
    apart = 25  # Least number of bins between steps of one profile.


class _Chain:
    """Limits of chains of steps."""

    next_m = 0.1  # Greatest sideways distance from the last step of the chain,
    moved_m = 0.04  # and its increase for each profile since.
    hidden = 12  # Greatest number of profiles without a step, behind a parked car (6 m).
    min_stations = 8  # Least number of steps of a kerb.
    smooth_stations = 5  # Width of the running median along a chain, in profiles.


class _Face:
    """Changes of the mesh around a kerb."""

    sample_m = 0.1  # Distance between samples of an edge.
    max_voxel_m = 0.2  # Levels with samples further apart are unchanged: they show no kerb.
    reach_voxels = 4.0  # Distance from a kerb up to which vertices are moved, in samples.
    taper = 0.2  # Outer fraction of the reach over which the movement decreases to 0.
    gap = 0.08  # Remaining fraction of a vertex's distance to the edge: faces need an area.
    face_m = 0.1  # Greatest distance of a kerb face's centre from the edge's samples.
    max_up = 0.5  # Greatest vertical component of a kerb face's normal.


@dataclass(frozen=True, eq=False)
class Kerb:
    """An edge along the path, with a point at each station, frame world.

    Args:
        edge_m: x and y.
        low_m, high_m: z of the ground before and behind the edge.
        towards_low: horizontal unit vectors across the edge, to its lower side.
    """

    edge_m: Float64[np.ndarray, "n 2"]
    low_m: Float64[np.ndarray, " n"]
    high_m: Float64[np.ndarray, " n"]
    towards_low: Float64[np.ndarray, "n 2"]


def find_kerbs(
    returns_world: Float[np.ndarray, "r 3"], ground: GroundMap, path_m: Float64[np.ndarray, "k 3"]
) -> list[Kerb]:
    """Find height steps of the ground that follow the path.

    Args:
        returns_world: LiDAR returns from static surfaces, frame world.
        ground: ground map; returns near it belong to the ground.
        path_m: positions of the recording vehicle.
    """
    stations_m = _stations(path_m[:, :2])
    if len(stations_m) == 0:
        return []
    ahead = np.gradient(stations_m, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    to_left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    height = returns_world[:, 2] - ground.look_up(returns_world[:, :2].astype(np.float64))
    points = returns_world[np.abs(height) < GROUND_BAND_M].astype(np.float64)
    station = np.asarray(KDTree(stations_m).query(points[:, :2])[1], dtype=np.int64)
    aside = ((points[:, :2] - stations_m[station]) * to_left[station]).sum(axis=1)
    is_near = np.abs(aside) < _Profile.aside_m
    steps = _steps(station[is_near], aside[is_near], points[is_near, 2], len(stations_m))
    chains = [chain for chain in _chains(steps) if len(chain) >= _Chain.min_stations]
    return [_kerb(stations_m, to_left, np.array(chain)) for chain in chains]


def _stations(xy: Float64[np.ndarray, "k 2"]) -> Float64[np.ndarray, "n 2"]:
    """Return the path, extended straight at both ends, as points at equal distances.

    The result is empty for a path shorter than the distance of two profiles.
    """
    length = _length_m(xy)
    if length[-1] < 2 * _Profile.station_m:
        return np.zeros((0, 2))
    heading = _Profile.heading_m
    first, second, third, last = _at(xy, np.array([0, heading, length[-1] - heading, length[-1]]))
    ends = [
        a + _Profile.beyond_m * (a - b) / np.linalg.norm(a - b)
        for a, b in ((first, second), (last, third))
    ]
    xy = np.concatenate([ends[:1], xy, ends[1:]])
    return _at(xy, np.arange(0.0, _length_m(xy)[-1], _Profile.station_m))


def _length_m(xy: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, " n"]:
    """Return the length of a line up to each of its points, in metres."""
    return np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))]


def _at(
    line: Float64[np.ndarray, "n k"], along_m: Float64[np.ndarray, " m"]
) -> Float64[np.ndarray, "m k"]:
    """Return the values of a line, whose first two columns are x and y, at distances along it."""
    length = _length_m(line[:, :2])
    return np.stack([np.interp(along_m, length, column) for column in line.T], axis=1)


_Step = tuple[float, float, float, float]
"""Station, distance to the left of the path, z to its right and z to its left, in metres."""


def _steps(
    station: Int64[np.ndarray, " n"],
    aside: Float64[np.ndarray, " n"],
    z: Float64[np.ndarray, " n"],
    stations: int,
) -> list[list[_Step]]:
    """Return the steps of each profile: places where levels differ more than heights deviate."""
    bins = round(2 * _Profile.aside_m / _Profile.bin_m)
    cell = station * bins + ((aside + _Profile.aside_m) / _Profile.bin_m).astype(np.int64)
    powers = [np.bincount(cell, z**k, stations * bins) for k in range(3)]
    # A profile has the returns of three stations.
    totals = correlate1d(np.reshape(powers, (3, stations, bins)), np.ones(3), 1, mode="constant")
    sums = np.pad(np.cumsum(totals, axis=2, dtype=np.float64), ((0, 0), (0, 0), (1, 0)))
    inner, outer = _Profile.sides
    edge, row = np.arange(outer, bins - outer)[None], np.arange(stations)[:, None]
    (n0, right, std0), (n1, left, std1) = _levels(sums, row, edge, inner)
    step = np.abs(left - right)
    is_step = (step > _Profile.heights_m[0]) & (step < _Profile.heights_m[1])
    is_step &= np.minimum(n0, n1) >= _Profile.min_returns
    is_step &= np.maximum(std0, std1) < _Profile.max_std_m
    clear = np.where(is_step, step - std0 - std1, 0.0)
    is_best = (clear > 0) & (clear == maximum_filter1d(clear, 2 * _Profile.apart + 1, axis=1))
    row, k = np.nonzero(is_best)
    near = edge[0, k][:, None] + np.arange(-2 * inner, 2 * inner + 1)
    near = np.clip(near, outer, bins - outer - 1)
    (n0, _, std0), (n1, _, std1) = _levels(sums, row[:, None], near, 0)
    # The split with the least variance about two levels, which includes returns on the face.
    split = near[np.arange(len(k)), (n0 * std0**2 + n1 * std1**2).argmin(axis=1)]
    found: list[list[_Step]] = [[] for _ in range(stations)]
    aside = split * _Profile.bin_m - _Profile.aside_m
    for values in np.stack([row, aside, right[row, k], left[row, k]], axis=1).tolist():
        found[int(values[0])].append(tuple(values))
    return found


def _levels(
    sums: Float64[np.ndarray, "3 s b"],
    row: Int64[np.ndarray, "r #e"],
    edge: Int64[np.ndarray, "#r e"],
    near: int,
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return number, mean and standard deviation of heights right and left of edges.

    Args:
        sums: number, sum and sum of squares of the heights up to each bin of each profile.
        row: profiles.
        edge: edges, in bins.
        near: bins beside an edge that do not count.
    """
    outer = _Profile.sides[1]
    levels = []
    for a, b in ((edge - outer, edge - near), (edge + near, edge + outer)):
        count, total, square = sums[:, row, b] - sums[:, row, a]
        mean = total / np.maximum(count, 1)
        variance = square / np.maximum(count, 1) - mean**2
        levels.append((count, mean, np.sqrt(np.maximum(variance, 0.0))))
    return levels


def _chains(steps: Sequence[Sequence[_Step]]) -> list[list[_Step]]:
    """Link steps of successive profiles that continue each other."""
    done: list[list[_Step]] = []
    open_: list[list[_Step]] = []
    for station, found in enumerate(steps):
        free = list(found)
        for chain in open_:
            last, aside, right, left = chain[-1]
            same = [s for s in free if (s[3] > s[2]) == (left > right)]
            nearest = min(same, key=lambda s: abs(s[1] - aside), default=None)
            reach_m = _Chain.next_m + _Chain.moved_m * (station - last)
            if nearest is not None and abs(nearest[1] - aside) < reach_m:
                chain.append(nearest)
                free.remove(nearest)
        done += [c for c in open_ if station - c[-1][0] > _Chain.hidden]
        open_ = [c for c in open_ if station - c[-1][0] <= _Chain.hidden] + [[s] for s in free]
    return done + open_


def _kerb(
    stations_m: Float64[np.ndarray, "s 2"],
    to_left: Float64[np.ndarray, "s 2"],
    chain: Float64[np.ndarray, "n 4"],
) -> Kerb:
    station = np.arange(int(chain[0, 0]), int(chain[-1, 0]) + 1)
    aside, right, left = (
        median_filter(
            np.interp(station, chain[:, 0], chain[:, k]), _Chain.smooth_stations, mode="mirror"
        )
        for k in (1, 2, 3)
    )
    edge, across = stations_m[station] + aside[:, None] * to_left[station], to_left[station]
    is_low_left = left.mean() < right.mean()
    return Kerb(edge, left, right, across) if is_low_left else Kerb(edge, right, left, -across)


def with_kerbs(mesh: TriMesh, kerbs: Sequence[Kerb], voxel_m: float) -> TriMesh:
    """Move the vertices of a background level around kerbs to the heights of both sides.

    Vertices next to an edge also move towards it, so that faces across it are upright.

    Args:
        mesh: one level of the background, frame world.
        kerbs: edges.
        voxel_m: distance between the level's samples.
    """
    if voxel_m > _Face.max_voxel_m or not kerbs or not len(mesh.vertices):
        return mesh
    samples, reach = _samples(kerbs), _Face.reach_voxels * voxel_m
    vertices = mesh.vertices.astype(np.float64)
    distance, nearest = KDTree(samples[:, :2]).query(vertices[:, :2], distance_upper_bound=reach)
    row = np.flatnonzero(np.isfinite(distance))
    place, low, high, normal = np.split(samples[np.asarray(nearest)[row]], [2, 3, 4], axis=1)
    low, high, z = low[:, 0], high[:, 0], vertices[row, 2]
    offset = vertices[row, :2] - place
    out = (offset * normal).sum(axis=1)
    beside = np.linalg.norm(offset - out[:, None] * normal, axis=1)
    is_ground = (z > low - voxel_m) & (z < high + voxel_m) & (beside < _Face.sample_m)
    part = np.clip((reach - np.abs(out)) / (_Face.taper * reach), 0.0, 1.0) * is_ground
    vertices[row, 2] += part * (np.where(out > 0, low, high) - z)
    # Vertices of faces that join both sides move towards the edge, so that these faces are upright.
    side = np.zeros(len(vertices), np.int8)
    side[row] = np.where(out > 0, 1, -1) * is_ground
    corners = side[mesh.faces]
    is_across = (corners.min(axis=1) < 0) & (corners.max(axis=1) > 0) & (corners != 0).all(axis=1)
    is_next = np.zeros(len(vertices), dtype=bool)
    is_next[mesh.faces[is_across]] = True
    moved = np.where(is_next[row], (_Face.gap - 1) * out, 0.0)
    vertices[row, :2] += moved[:, None] * normal
    return replace(mesh, vertices=vertices.astype(np.float32))


def with_edges(mesh: TriMesh, kerbs: Sequence[Kerb]) -> TriMesh:
    """Give upright faces of kerbs their own vertices, so that normals change at edges.

    It must run before colours are known.
    """
    if not kerbs or not len(mesh.faces):
        return mesh
    middle = mesh.vertices[mesh.faces][..., :2].mean(axis=1).astype(np.float64)
    tree = KDTree(_samples(kerbs)[:, :2])
    is_face = np.isfinite(tree.query(middle, distance_upper_bound=_Face.face_m)[0])
    is_face &= np.abs(mesh.face_normals()[:, 2]) < _Face.max_up
    own, corner = np.unique(mesh.faces[is_face], return_inverse=True)
    faces = mesh.faces.copy()
    faces[is_face] = (len(mesh.vertices) + corner.reshape(-1, 3)).astype(np.int32)
    return replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, mesh.vertices[own]]),
        base_colour=np.concatenate([mesh.base_colour, mesh.base_colour[own]]),
        faces=faces,
    )


def _samples(kerbs: Sequence[Kerb]) -> Float64[np.ndarray, "n 6"]:
    """Return points along edges: x, y, low z, high z, and the direction to the lower side."""
    lines = [np.column_stack([k.edge_m, k.low_m, k.high_m, k.towards_low]) for k in kerbs]
    return np.concatenate(
        [_at(line, np.arange(0.0, _length_m(line[:, :2])[-1], _Face.sample_m)) for line in lines]
    )
