"""Kerbs along the path as upright faces.

A kerb is about as high as the distance between the field's samples, so extraction turns it into a
ramp with the light of level ground. Returns give its edge to a few centimetres: the height profile
across the path has a step, and steps of successive profiles are linked to chains.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, Int64
from scipy.ndimage import median_filter
from scipy.spatial import KDTree

from lightsim.core.fields import GroundMap
from lightsim.core.mesh import TriMesh
from lightsim.geometry.completion.ground import GROUND_BAND_M

# The values below were chosen on streets 0 and 1 of the benchmark; only their joint effect was
# measured.

# Distance between samples of the path and of an edge, in metres.
_SAMPLE_M = 0.1


class _Profile:
    """Height profiles across the path, and limits of their steps."""

    station_m = 0.5  # Distance between profiles along the path.
    along_m = 0.75  # Half the length along the path from which a profile has its returns.
    beyond_m = 25.0  # Extension of the path beyond its ends.
    aside_m = 15.0  # Half the width of a profile.
    bin_m = 0.02  # Width of a bin.
    sides_m = (0.1, 0.45)  # Distances from a step between which heights count.
    least_returns = 6  # Least number of returns on each side.
    most_std_m = 0.03  # Greatest standard deviation of the heights of a side.
    heights_m = (0.05, 0.3)  # Least and greatest height of a step.
    apart_m = 0.5  # Least distance between steps of one profile.
    noise_m = 0.01  # Added to the standard deviations when steps are ranked.


class _Chain:
    """Limits of chains of steps."""

    next_m = 0.1  # Greatest sideways distance from the last step of the chain,
    moved_m = 0.04  # and its increase for each profile since.
    hidden = 12  # Greatest number of profiles without a step, behind a parked car (6 m).
    least_stations = 8  # Least number of steps of a kerb.
    smooth_stations = 5  # Width of the running median along a chain, in profiles.


class _Face:
    """Changes of the mesh around a kerb."""

    most_voxel_m = 0.2  # Levels with samples further apart are unchanged: they show no kerb.
    reach_m = 0.4  # Distance from a kerb up to which vertices are moved, at least;
    reach_voxels = 3.0  # the same in samples.
    taper = 0.2  # Outer fraction of the reach over which the movement decreases to 0.
    gap = 0.08  # Remaining fraction of a vertex's distance to the edge: faces need an area.
    face_m = 0.05  # Greatest distance of a kerb face's centre from the edge.
    most_up = 0.5  # Greatest vertical component of a kerb face's normal.


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
    way = _Way.of(path_m)
    if way is None:
        return []
    height = returns_world[:, 2] - ground.look_up(returns_world[:, :2].astype(np.float64))
    points = returns_world[np.abs(height) < GROUND_BAND_M].astype(np.float64)
    along, aside = way.place(points[:, :2])
    is_near = np.abs(aside) < _Profile.aside_m
    order = np.flatnonzero(is_near)[np.argsort(along[is_near])]
    along, aside, z = along[order], aside[order], points[order, 2]
    steps = []
    for station in way.stations_m:
        part = slice(
            *np.searchsorted(along, (station - _Profile.along_m, station + _Profile.along_m))
        )
        steps.append(list(_steps(aside[part], z[part])))
    return [_kerb(way, chain) for chain in _chains(steps) if len(chain) >= _Chain.least_stations]


@dataclass(frozen=True, eq=False)
class _Way:
    """The path, extended straight at both ends, with coordinates along it and to its left.

    Args:
        points_m: x and y, `_SAMPLE_M` apart.
        ahead: unit directions at these points.
        stations_m: positions of the profiles along the path.
    """

    points_m: Float64[np.ndarray, "n 2"]
    ahead: Float64[np.ndarray, "n 2"]
    stations_m: Float64[np.ndarray, " s"]

    @staticmethod
    def of(path_m: Float64[np.ndarray, "k 3"]) -> _Way | None:
        """Return the extended path, or None for a path shorter than a profile."""
        xy = path_m[:, :2]
        moved = np.r_[True, np.linalg.norm(np.diff(xy, axis=0), axis=1) > 1e-3]
        xy = xy[moved]
        length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))]
        if length[-1] < 2 * _Profile.along_m:
            return None
        s = np.arange(-_Profile.beyond_m, length[-1] + _Profile.beyond_m, _SAMPLE_M)
        inner = np.stack([np.interp(s, length, xy[:, k]) for k in (0, 1)], axis=1)
        # The path is extended along the mean direction of its first and its last 2 m.
        first, last = (
            _unit(np.array([np.interp(b, length, xy[:, k]) - np.interp(a, length, xy[:, k])
                            for k in (0, 1)]))
            for a, b in ((0.0, min(2.0, length[-1])), (max(length[-1] - 2.0, 0.0), length[-1]))
        )  # fmt: skip
        inner += np.minimum(s, 0.0)[:, None] * first
        inner += np.maximum(s - length[-1], 0.0)[:, None] * last
        ahead = np.gradient(inner, axis=0)
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        return _Way(inner, ahead, np.arange(s[0], s[-1], _Profile.station_m))

    @property
    def left(self) -> Float64[np.ndarray, "n 2"]:
        return np.stack([-self.ahead[:, 1], self.ahead[:, 0]], axis=1)

    def place(
        self, xy: Float64[np.ndarray, "m 2"]
    ) -> tuple[Float64[np.ndarray, " m"], Float64[np.ndarray, " m"]]:
        """Return the distance along the path from its start, and to its left, in metres."""
        nearest = KDTree(self.points_m).query(xy)[1]
        offset = xy - self.points_m[nearest]
        along = self.stations_m[0] + _SAMPLE_M * nearest + (offset * self.ahead[nearest]).sum(1)
        return along, (offset * self.left[nearest]).sum(axis=1)

    def at(
        self, station: Int64[np.ndarray, " m"], aside_m: Float64[np.ndarray, " m"]
    ) -> tuple[Float64[np.ndarray, "m 2"], Float64[np.ndarray, "m 2"]]:
        """Return points beside stations, and the directions to the left there."""
        index = np.minimum(
            np.round(station * (_Profile.station_m / _SAMPLE_M)).astype(np.int64),
            len(self.points_m) - 1,
        )
        return self.points_m[index] + aside_m[:, None] * self.left[index], self.left[index]


def _unit(vector: Float64[np.ndarray, "2"]) -> Float64[np.ndarray, "2"]:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


_Step = tuple[float, float, float]
"""Distance to the left of the path, height to its right, height to its left, in metres."""


def _steps(aside: Float64[np.ndarray, " n"], z: Float64[np.ndarray, " n"]) -> Iterator[_Step]:
    """Yield the steps of one profile, greatest ratio of height to standard deviation first."""
    count = round(2 * _Profile.aside_m / _Profile.bin_m)
    bin_ = np.clip(((aside + _Profile.aside_m) / _Profile.bin_m).astype(np.int64), 0, count - 1)
    middle = float(np.median(z)) if len(z) else 0.0
    sums = [np.r_[0.0, np.cumsum(np.bincount(bin_, w, count))]
            for w in (np.ones_like(z), z - middle, np.square(z - middle))]  # fmt: skip
    inner, outer = (
        round(_Profile.sides_m[0] / _Profile.bin_m),
        round(_Profile.sides_m[1] / _Profile.bin_m),
    )
    edge = np.arange(outer, count - outer)

    def sides(edge: Int64[np.ndarray, " e"], near: int) -> list[np.ndarray]:
        """Return number, mean and standard deviation of heights right and left of edges."""
        found = []
        for a, b in ((edge - outer, edge - near), (edge + near, edge + outer)):
            n, total, square = (s[b] - s[a] for s in sums)
            mean = total / np.maximum(n, 1)
            std = np.sqrt(np.maximum(square / np.maximum(n, 1) - mean**2, 0.0))
            found += [n, mean, std]
        return found

    n0, low, std0, n1, high, std1 = sides(edge, inner)
    step = np.abs(high - low)
    is_step = (
        (np.minimum(n0, n1) >= _Profile.least_returns)
        & (step > _Profile.heights_m[0])
        & (step < _Profile.heights_m[1])
    )
    is_step &= np.maximum(std0, std1) < _Profile.most_std_m
    clear = np.where(is_step, step / (_Profile.noise_m + std0 + std1), 0.0)
    while clear.max(initial=0.0) > 0:
        best = int(clear.argmax())
        near = edge[best] + np.arange(-2 * inner, 2 * inner + 1)
        near = near[(near >= outer) & (near < count - outer)]
        m0, _, s0, m1, _, s1 = sides(near, 0)
        # The split with the least variance about two levels, which includes returns on the face.
        split = near[int((m0 * s0**2 + m1 * s1**2).argmin())]
        yield (
            split * _Profile.bin_m - _Profile.aside_m,
            float(low[best]) + middle,
            float(high[best]) + middle,
        )
        clear[np.abs(edge - edge[best]) < _Profile.apart_m / _Profile.bin_m] = 0.0


def _chains(steps: Sequence[Sequence[_Step]]) -> list[list[tuple[int, _Step]]]:
    """Link steps of successive profiles that continue each other."""
    done: list[list[tuple[int, _Step]]] = []
    open_: list[list[tuple[int, _Step]]] = []
    for station, found in enumerate(steps):
        left = list(found)
        for chain in open_:
            last, (aside, right, other) = chain[-1]
            same = [s for s in left if (s[2] > s[1]) == (other > right)]
            nearest = min(same, key=lambda s: abs(s[0] - aside), default=None)
            if nearest is not None and abs(nearest[0] - aside) < _Chain.next_m + _Chain.moved_m * (
                station - last
            ):
                chain.append((station, nearest))
                left.remove(nearest)
        done += [c for c in open_ if station - c[-1][0] > _Chain.hidden]
        open_ = [c for c in open_ if station - c[-1][0] <= _Chain.hidden] + [
            [(station, s)] for s in left
        ]
    return done + open_


def _kerb(way: _Way, chain: Sequence[tuple[int, _Step]]) -> Kerb:
    known = np.array([station for station, _ in chain])
    values = np.array([step for _, step in chain])
    station = np.arange(known[0], known[-1] + 1)
    aside, right, left = (
        median_filter(
            np.interp(station, known, values[:, k]), _Chain.smooth_stations, mode="mirror"
        )
        for k in range(3)
    )
    edge, to_left = way.at(station, aside)
    is_low_left = left.mean() < right.mean()
    low, high = (left, right) if is_low_left else (right, left)
    return Kerb(edge, low, high, to_left if is_low_left else -to_left)


def with_kerbs(mesh: TriMesh, kerbs: Sequence[Kerb], voxel_m: float) -> TriMesh:
    """Move the vertices of a background level around kerbs to the heights of both sides.

    Vertices next to an edge also move towards it, so that faces across it are upright.

    Args:
        mesh: one level of the background, frame world.
        kerbs: edges.
        voxel_m: distance between the level's samples.
    """
    if voxel_m > _Face.most_voxel_m or not len(mesh.vertices):
        return mesh
    vertices = mesh.vertices.astype(np.float64)
    for kerb in kerbs:
        _put_on(vertices, mesh.faces, kerb, voxel_m)
    return replace(mesh, vertices=vertices.astype(np.float32))


def _put_on(
    vertices: Float64[np.ndarray, "v 3"],
    faces: Int32[np.ndarray, "f 3"],
    kerb: Kerb,
    voxel_m: float,
) -> None:
    reach = max(_Face.reach_m, _Face.reach_voxels * voxel_m)
    place, low, high, normal = _sampled(kerb)
    is_near = _is_within(vertices, place, reach)
    row = np.flatnonzero(is_near)
    distance, nearest = KDTree(place).query(vertices[row, :2], distance_upper_bound=reach)
    k = np.asarray(nearest)
    row, k = row[np.isfinite(distance)], k[np.isfinite(distance)]
    offset = vertices[row, :2] - place[k]
    out = (offset * normal[k]).sum(axis=1)
    beside = np.linalg.norm(offset - out[:, None] * normal[k], axis=1)
    z = vertices[row, 2]
    is_ground = (z > low[k] - voxel_m) & (z < high[k] + voxel_m) & (beside < _SAMPLE_M)
    row, k, out = row[is_ground], k[is_ground], out[is_ground]
    part = np.clip((reach - np.abs(out)) / (_Face.taper * reach), 0.0, 1.0)
    vertices[row, 2] += part * (np.where(out > 0, low[k], high[k]) - vertices[row, 2])
    # Vertices of faces that join both sides move towards the edge, so that these faces are upright.
    side = np.zeros(len(vertices), np.int8)
    side[row] = np.where(out > 0, 1, -1)
    corners = side[faces]
    is_across = (corners.min(axis=1) < 0) & (corners.max(axis=1) > 0) & (corners != 0).all(axis=1)
    is_next = np.zeros(len(vertices), dtype=bool)
    is_next[faces[is_across]] = True
    moved = np.where(is_next[row], (_Face.gap - 1) * out, 0.0)
    vertices[row, :2] += moved[:, None] * normal[k]


def with_edges(mesh: TriMesh, kerbs: Sequence[Kerb]) -> TriMesh:
    """Give upright faces of kerbs their own vertices, so that normals change at edges.

    It must run before colours are known.
    """
    if not kerbs or not len(mesh.faces):
        return mesh
    middle = mesh.vertices[mesh.faces].mean(axis=1).astype(np.float64)
    is_face = np.zeros(len(mesh.faces), dtype=bool)
    for kerb in kerbs:
        row = np.flatnonzero(_is_within(middle, kerb.edge_m, _Face.face_m))
        place = _sampled(kerb)[0]
        is_face[row] |= KDTree(place).query(middle[row, :2])[0] < _Face.face_m + _SAMPLE_M / 2
    is_face &= np.abs(mesh.face_normals()[:, 2]) < _Face.most_up
    own, corner = np.unique(mesh.faces[is_face], return_inverse=True)
    faces = mesh.faces.copy()
    faces[is_face] = (len(mesh.vertices) + corner.reshape(-1, 3)).astype(np.int32)
    return replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, mesh.vertices[own]]),
        base_colour=np.concatenate([mesh.base_colour, mesh.base_colour[own]]),
        faces=faces,
    )


def _sampled(kerb: Kerb) -> tuple[np.ndarray, ...]:
    """Return points along the edge, `_SAMPLE_M` apart: xy, low z, high z, direction to low."""
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(kerb.edge_m, axis=0), axis=1))]
    at = np.arange(0.0, length[-1], _SAMPLE_M)
    columns = [*kerb.edge_m.T, kerb.low_m, kerb.high_m, *kerb.towards_low.T]
    x, y, low, high, *towards = (np.interp(at, length, column) for column in columns)
    return np.stack([x, y], axis=1), low, high, np.stack(towards, axis=1)


def _is_within(
    vertices: Float64[np.ndarray, "v 3"], place: Float64[np.ndarray, "n 2"], reach_m: float
) -> Bool[np.ndarray, " v"]:
    """Return whether vertices lie in the bounding box of places, extended by `reach_m`."""
    low, high = place.min(axis=0) - reach_m, place.max(axis=0) + reach_m
    return ((vertices[:, :2] > low) & (vertices[:, :2] < high)).all(axis=1)
