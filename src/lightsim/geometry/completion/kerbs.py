"""Kerbs along the path: upright faces where a grid of samples leaves ramps.

A kerb is a hand's breadth high, about as much as the samples of a field are apart, which make a
ramp of it that is lit as level ground. Returns know its edge to a few centimetres: along the path,
the profile of their heights across it has steps, and successive steps are chained.
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

# Chosen while looking at streets 0 and 1 of the benchmark; what they bring is measured
# (docs/benchmarks/reconstruction.md).

# Profiles are so far apart along the path, hold the returns this near along it, and reach this far
# beyond its ends and to its sides.
_STATION_M, _ALONG_M, _BEYOND_M, _ASIDE_M = 0.5, 0.75, 25.0, 15.0
# Returns of the ground lie this near the ground map.
_NEAR_GROUND_M = 0.35
# Bins of a profile; to both sides of a step heights are taken from and up to here.
_BIN_M, _INNER_M, _OUTER_M = 0.02, 0.1, 0.45
# Of each side: returns, and spread of their heights; of the step: height.
_LEAST_RETURNS, _MOST_SPREAD_M = 6, 0.03
_LOWEST_M, _HIGHEST_M = 0.05, 0.3
# Steps of a profile are at least so far apart.
_APART_M = 0.5
# A kerb goes on this near to its last place, and so much further away for each profile since; a
# parked car hides it in no more than so many. Shorter ones are none.
_NEXT_M, _MOVED_M, _HIDDEN, _LEAST_STATIONS = 0.1, 0.04, 12, 8
_SMOOTH_STATIONS = 5
# Vertices this near a kerb, in metres or samples, take its heights; beyond four fifths less and
# less. Levels with samples further apart than this keep their ramps.
_REACH_M, _REACH_VOXELS, _MOST_VOXEL_M = 0.4, 3.0, 0.2
_KEPT = 0.08
"""Of the distances from the edge of vertices on both sides of it: faces keep an area."""
_SAMPLE_M = 0.1
# Faces of a kerb have their middles this near its edge, and look up no more than this (cosine).
_FACE_M, _MOST_UP = 0.05, 0.5


@dataclass(frozen=True, eq=False)
class Kerb:
    """An edge along the path, from station to station, frame world.

    Args:
        edge_m: x and y.
        low_m, high_m: z of the ground before it and behind it.
        towards_low: unit, level, across the edge.
    """

    edge_m: Float64[np.ndarray, "n 2"]
    low_m: Float64[np.ndarray, " n"]
    high_m: Float64[np.ndarray, " n"]
    towards_low: Float64[np.ndarray, "n 2"]


def find_kerbs(
    returns_world: Float[np.ndarray, "r 3"], ground: GroundMap, path_m: Float64[np.ndarray, "k 3"]
) -> list[Kerb]:
    """Steps of the ground that go along the path.

    Args:
        returns_world: of what stands still.
        ground: returns near it are of the ground.
        path_m: of the recording.
    """
    way = _Way.of(path_m)
    if way is None:
        return []
    height = returns_world[:, 2] - ground.look_up(returns_world[:, :2].astype(np.float64))
    points = returns_world[np.abs(height) < _NEAR_GROUND_M].astype(np.float64)
    along, aside = way.place(points[:, :2])
    is_near = np.abs(aside) < _ASIDE_M
    order = np.flatnonzero(is_near)[np.argsort(along[is_near])]
    along, aside, z = along[order], aside[order], points[order, 2]
    steps = []
    for station in way.stations_m:
        part = slice(*np.searchsorted(along, (station - _ALONG_M, station + _ALONG_M)))
        steps.append(list(_steps(aside[part], z[part])))
    return [_kerb(way, chain) for chain in _chains(steps) if len(chain) >= _LEAST_STATIONS]


@dataclass(frozen=True, eq=False)
class _Way:
    """The path, straightened beyond its ends: places along it and to its left.

    Args:
        points_m: x and y, `_SAMPLE_M` apart.
        ahead: unit directions there.
        stations_m: along it, where profiles are taken.
    """

    points_m: Float64[np.ndarray, "n 2"]
    ahead: Float64[np.ndarray, "n 2"]
    stations_m: Float64[np.ndarray, " s"]

    @staticmethod
    def of(path_m: Float64[np.ndarray, "k 3"]) -> _Way | None:
        """None where the path leads nowhere."""
        xy = path_m[:, :2]
        moved = np.r_[True, np.linalg.norm(np.diff(xy, axis=0), axis=1) > 1e-3]
        xy = xy[moved]
        length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))]
        if length[-1] < 2 * _ALONG_M:
            return None
        s = np.arange(-_BEYOND_M, length[-1] + _BEYOND_M, _SAMPLE_M)
        inner = np.stack([np.interp(s, length, xy[:, k]) for k in (0, 1)], axis=1)
        first, last = (
            _unit(np.array([np.interp(b, length, xy[:, k]) - np.interp(a, length, xy[:, k])
                            for k in (0, 1)]))
            for a, b in ((0.0, min(2.0, length[-1])), (max(length[-1] - 2.0, 0.0), length[-1]))
        )  # fmt: skip
        inner += np.minimum(s, 0.0)[:, None] * first
        inner += np.maximum(s - length[-1], 0.0)[:, None] * last
        ahead = np.gradient(inner, axis=0)
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        return _Way(inner, ahead, np.arange(s[0], s[-1], _STATION_M))

    @property
    def left(self) -> Float64[np.ndarray, "n 2"]:
        return np.stack([-self.ahead[:, 1], self.ahead[:, 0]], axis=1)

    def place(
        self, xy: Float64[np.ndarray, "m 2"]
    ) -> tuple[Float64[np.ndarray, " m"], Float64[np.ndarray, " m"]]:
        """Along the path from its start, and to its left, metres."""
        nearest = KDTree(self.points_m).query(xy)[1]
        offset = xy - self.points_m[nearest]
        along = self.stations_m[0] + _SAMPLE_M * nearest + (offset * self.ahead[nearest]).sum(1)
        return along, (offset * self.left[nearest]).sum(axis=1)

    def at(
        self, station: Int64[np.ndarray, " m"], aside_m: Float64[np.ndarray, " m"]
    ) -> tuple[Float64[np.ndarray, "m 2"], Float64[np.ndarray, "m 2"]]:
        """Points beside stations, and the directions to the left there."""
        index = np.minimum(
            np.round(station * (_STATION_M / _SAMPLE_M)).astype(np.int64), len(self.points_m) - 1
        )
        return self.points_m[index] + aside_m[:, None] * self.left[index], self.left[index]


def _unit(vector: Float64[np.ndarray, "2"]) -> Float64[np.ndarray, "2"]:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


_Step = tuple[float, float, float]
"""Place to the left of the path, height to its right and to its left."""


def _steps(aside: Float64[np.ndarray, " n"], z: Float64[np.ndarray, " n"]) -> Iterator[_Step]:
    """Steps of one profile, the clearest first."""
    count = round(2 * _ASIDE_M / _BIN_M)
    bin_ = np.clip(((aside + _ASIDE_M) / _BIN_M).astype(np.int64), 0, count - 1)
    middle = float(np.median(z)) if len(z) else 0.0
    sums = [np.r_[0.0, np.cumsum(np.bincount(bin_, w, count))]
            for w in (np.ones_like(z), z - middle, np.square(z - middle))]  # fmt: skip
    inner, outer = round(_INNER_M / _BIN_M), round(_OUTER_M / _BIN_M)
    edge = np.arange(outer, count - outer)

    def sides(edge: Int64[np.ndarray, " e"], near: int) -> list[np.ndarray]:
        """Returns, mean height and spread to the right and to the left of edges."""
        found = []
        for a, b in ((edge - outer, edge - near), (edge + near, edge + outer)):
            n, total, square = (s[b] - s[a] for s in sums)
            mean = total / np.maximum(n, 1)
            spread = np.sqrt(np.maximum(square / np.maximum(n, 1) - mean**2, 0.0))
            found += [n, mean, spread]
        return found

    n0, low, spread0, n1, high, spread1 = sides(edge, inner)
    step = np.abs(high - low)
    is_step = (np.minimum(n0, n1) >= _LEAST_RETURNS) & (step > _LOWEST_M) & (step < _HIGHEST_M)
    is_step &= np.maximum(spread0, spread1) < _MOST_SPREAD_M
    clear = np.where(is_step, step / (0.01 + spread0 + spread1), 0.0)
    while clear.max(initial=0.0) > 0:
        best = int(clear.argmax())
        near = edge[best] + np.arange(-2 * inner, 2 * inner + 1)
        near = near[(near >= outer) & (near < count - outer)]
        m0, _, s0, m1, _, s1 = sides(near, 0)
        # Where two levels explain all returns best, those on the face among them.
        split = near[int((m0 * s0**2 + m1 * s1**2).argmin())]
        yield split * _BIN_M - _ASIDE_M, float(low[best]) + middle, float(high[best]) + middle
        clear[np.abs(edge - edge[best]) < _APART_M / _BIN_M] = 0.0


def _chains(steps: Sequence[Sequence[_Step]]) -> list[list[tuple[int, _Step]]]:
    """Steps of successive stations that go on in each other."""
    done: list[list[tuple[int, _Step]]] = []
    open_: list[list[tuple[int, _Step]]] = []
    for station, found in enumerate(steps):
        left = list(found)
        for chain in open_:
            last, (aside, right, other) = chain[-1]
            same = [s for s in left if (s[2] > s[1]) == (other > right)]
            nearest = min(same, key=lambda s: abs(s[0] - aside), default=None)
            if nearest is not None and abs(nearest[0] - aside) < _NEXT_M + _MOVED_M * (
                station - last
            ):
                chain.append((station, nearest))
                left.remove(nearest)
        done += [c for c in open_ if station - c[-1][0] > _HIDDEN]
        open_ = [c for c in open_ if station - c[-1][0] <= _HIDDEN] + [[(station, s)] for s in left]
    return done + open_


def _kerb(way: _Way, chain: Sequence[tuple[int, _Step]]) -> Kerb:
    known = np.array([station for station, _ in chain])
    values = np.array([step for _, step in chain])
    station = np.arange(known[0], known[-1] + 1)
    aside, right, left = (
        median_filter(np.interp(station, known, values[:, k]), _SMOOTH_STATIONS, mode="mirror")
        for k in range(3)
    )
    edge, to_left = way.at(station, aside)
    is_low_left = left.mean() < right.mean()
    low, high = (left, right) if is_low_left else (right, left)
    return Kerb(edge, low, high, to_left if is_low_left else -to_left)


def with_kerbs(mesh: TriMesh, kerbs: Sequence[Kerb], voxel_m: float) -> TriMesh:
    """A level of the background with vertices around kerbs on their two heights, and those next to
    an edge on it: what joins both sides is upright.

    Args:
        voxel_m: distance between the level's samples.
    """
    if voxel_m > _MOST_VOXEL_M or not len(mesh.vertices):
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
    reach = max(_REACH_M, _REACH_VOXELS * voxel_m)
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
    part = np.clip((reach - np.abs(out)) / (0.2 * reach), 0.0, 1.0)
    vertices[row, 2] += part * (np.where(out > 0, low[k], high[k]) - vertices[row, 2])
    # What joins both sides becomes upright.
    side = np.zeros(len(vertices), np.int8)
    side[row] = np.where(out > 0, 1, -1)
    corners = side[faces]
    is_across = (corners.min(axis=1) < 0) & (corners.max(axis=1) > 0) & (corners != 0).all(axis=1)
    is_next = np.zeros(len(vertices), dtype=bool)
    is_next[faces[is_across]] = True
    moved = np.where(is_next[row], (_KEPT - 1) * out, 0.0)
    vertices[row, :2] += moved[:, None] * normal[k]


def with_edges(mesh: TriMesh, kerbs: Sequence[Kerb]) -> TriMesh:
    """Upright faces of kerbs with vertices of their own: between those that they share with the
    ground, normals would be round. Before colours are known.
    """
    if not kerbs or not len(mesh.faces):
        return mesh
    middle = mesh.vertices[mesh.faces].mean(axis=1).astype(np.float64)
    is_face = np.zeros(len(mesh.faces), dtype=bool)
    for kerb in kerbs:
        row = np.flatnonzero(_is_within(middle, kerb.edge_m, _FACE_M))
        place = _sampled(kerb)[0]
        is_face[row] |= KDTree(place).query(middle[row, :2])[0] < _FACE_M + _SAMPLE_M / 2
    is_face &= np.abs(mesh.face_normals()[:, 2]) < _MOST_UP
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
    """Places along the edge, `_SAMPLE_M` apart, with low, high and direction towards the low."""
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(kerb.edge_m, axis=0), axis=1))]
    at = np.arange(0.0, length[-1], _SAMPLE_M)
    columns = [*kerb.edge_m.T, kerb.low_m, kerb.high_m, *kerb.towards_low.T]
    x, y, low, high, *towards = (np.interp(at, length, column) for column in columns)
    return np.stack([x, y], axis=1), low, high, np.stack(towards, axis=1)


def _is_within(
    vertices: Float64[np.ndarray, "v 3"], place: Float64[np.ndarray, "n 2"], reach_m: float
) -> Bool[np.ndarray, " v"]:
    """Vertices in the box around places."""
    low, high = place.min(axis=0) - reach_m, place.max(axis=0) + reach_m
    return ((vertices[:, :2] > low) & (vertices[:, :2] < high)).all(axis=1)
