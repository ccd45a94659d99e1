"""Surfels: a mesh's surface in even patches, with what cameras and the LiDAR saw of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from scipy.spatial import KDTree

from lightsim.core.mesh import TriMesh

_NEAR, _FAR = 8, 5
"""Nearest patches that each is compared with, and random ones, to see past thin things."""
_MIN_RETURNS = 3
_RANGE_EDGES_M = (0.0, 4.0, 6.0, 8.0, 11.0, 15.0, 20.0, 27.0, 36.0, 50.0, 70.0, 1e9)
_COSINE_BINS = 8


@dataclass(frozen=True, eq=False)
class Surfels:
    """Patches of a surface, frame of the mesh.

    Args:
        position: centre, metres.
        normal: unit.
        radiance: mean observed linear RGB.
        area_m2: surface that each stands for.
        confidence: 0 (colour filled in) to 1 (seen).
    """

    position: Float64[np.ndarray, "n 3"]
    normal: Float64[np.ndarray, "n 3"]
    radiance: Float64[np.ndarray, "n 3"]
    area_m2: Float64[np.ndarray, " n"]
    confidence: Float64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.position)


@dataclass(frozen=True, eq=False)
class Samples:
    """Points on a mesh: face and barycentric weights."""

    face: Int64[np.ndarray, " n"]
    barycentric: Float64[np.ndarray, "n 3"]


def sample_surface(mesh: TriMesh, spacing_m: float, rng: np.random.Generator) -> Samples:
    """Random points, one for each `spacing_m` squared of area on average."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    wanted = area / spacing_m**2
    count = np.floor(wanted + rng.random(len(area))).astype(np.int64)
    face = np.repeat(np.arange(len(area), dtype=np.int64), count)
    root, v = np.sqrt(rng.random(len(face))), rng.random(len(face))
    return Samples(face, np.stack([1 - root, root * (1 - v), root * v], axis=1))


def make_surfels(mesh: TriMesh, size_m: float, rng: np.random.Generator) -> Surfels:
    """Cells of a grid of `size_m`, apart by the six sides a surface can face.

    Colour is the mean over the patch of the texture where there is one, else of the vertices.
    """
    spacing = size_m / 2.5
    samples = sample_surface(mesh, spacing, rng)
    corners = mesh.faces[samples.face]
    weight = samples.barycentric[:, :, None]
    position = (weight * mesh.vertices[corners]).sum(axis=1)
    normal = (weight * mesh.vertex_normals()[corners]).sum(axis=1)
    colour = mesh.colour_at(samples.face, samples.barycentric)
    known = np.ones(len(mesh.vertices)) if mesh.confidence is None else mesh.confidence
    seen = (samples.barycentric * known[corners]).sum(axis=1)
    axis = np.abs(normal).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(normal, axis[:, None], 1)[:, 0] < 0)
    cell = np.floor(position / size_m).astype(np.int64)
    key = np.concatenate([cell - cell.min(axis=0, initial=0), side[:, None]], axis=1)
    _, index, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    seen3 = np.repeat(seen[:, None], 3, axis=1)
    mean = [_mean(values, index.ravel(), count) for values in (position, normal, colour, seen3)]
    length = np.linalg.norm(mean[1], axis=1, keepdims=True)
    is_good = length[:, 0] > 0.3
    normal = (mean[1] / np.maximum(length, 1e-9))[is_good]
    area = count[is_good] * spacing**2
    return Surfels(mean[0][is_good], normal, mean[2][is_good], area, mean[3][is_good, 0])


def _mean(
    values: Float[np.ndarray, "n 3"], index: Int64[np.ndarray, " n"], count: Int64[np.ndarray, " m"]
) -> Float64[np.ndarray, "m 3"]:
    sums = [np.bincount(index, values[:, c], minlength=len(count)) for c in range(3)]
    return np.stack(sums, axis=1) / count[:, None]


@dataclass(frozen=True, eq=False)
class LidarReturns:
    """Returns from what does not move, in the frame of the mesh.

    Args:
        points: where the beams ended.
        origins: where the sensor stood.
        intensity: in [0, 1].
    """

    points: Float32[np.ndarray, "n 3"]
    origins: Float32[np.ndarray, "n 3"]
    intensity: Float32[np.ndarray, " n"]


def lidar_tone(
    surfels: Surfels, returns: LidarReturns, reach_m: float
) -> Float64[np.ndarray, " n"]:
    """Log of the LiDAR intensity of each surfel, relative to that of all returns of its range and
    incidence; NaN where too few returns lie within `reach_m`.

    Intensity falls with range and incidence in ways that differ between sensors, so the
    compensation is the median of the log itself.
    """
    tree = KDTree(surfels.position)
    found = tree.query(returns.points, distance_upper_bound=reach_m)
    distance, index = (np.asarray(part) for part in found)
    near = np.isfinite(distance)
    if not near.any():
        return np.full(len(surfels), np.nan)
    row = index[near]
    beam = (returns.points[near] - returns.origins[near]).astype(np.float64)
    length = np.maximum(np.linalg.norm(beam, axis=1), 1e-6)
    cosine = np.abs((beam * surfels.normal[row]).sum(axis=1)) / length
    log = np.log(returns.intensity[near].astype(np.float64) + 0.5 / 255)
    log = log - _expected_log(log, length, cosine)
    count = np.bincount(row, minlength=len(surfels))
    total = np.bincount(row, log, minlength=len(surfels))
    return np.where(count >= _MIN_RETURNS, total / np.maximum(count, 1), np.nan)


def _expected_log(
    log: Float64[np.ndarray, " n"],
    distance_m: Float64[np.ndarray, " n"],
    cosine: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, " n"]:
    """Median of the log intensity over the returns of similar range and incidence."""
    bins = np.digitize(distance_m, _RANGE_EDGES_M) * _COSINE_BINS
    bins += np.minimum((cosine * _COSINE_BINS).astype(np.int64), _COSINE_BINS - 1)
    order = np.argsort(bins, kind="stable")
    starts = np.flatnonzero(np.diff(bins[order], prepend=-1))
    medians = [np.median(part) for part in np.split(log[order], starts[1:])]
    expected = np.empty(len(log))
    expected[order] = np.repeat(medians, np.diff(np.append(starts, len(log))))
    return expected


@dataclass(frozen=True, eq=False)
class Graph:
    """Pairs of surfels of one surface: each pair once.

    Args:
        pairs: surfel indices.
        distance_m: between the two.
        weight: of the pair; those of one surfel sum to about `2`.
    """

    pairs: Int64[np.ndarray, "e 2"]
    distance_m: Float64[np.ndarray, " e"]
    weight: Float64[np.ndarray, " e"]


def connect(surfels: Surfels, reach_m: float, rng: np.random.Generator) -> Graph:
    """Each surfel with its nearest, and random ones within `reach_m`, of the same surface:
    similar normal, little offset from the other's plane."""
    tree = KDTree(surfels.position)
    k = min(_NEAR + 1, len(surfels))
    _, index = tree.query(surfels.position, k=k)
    parts = [_pairs_of(index.reshape(len(surfels), k))]
    for _ in range(_FAR):
        offset = rng.normal(size=(len(surfels), 3))
        offset -= (offset * surfels.normal).sum(axis=1, keepdims=True) * surfels.normal
        offset /= np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-9)
        reach = reach_m * np.sqrt(rng.random((len(surfels), 1)))
        _, other = tree.query(surfels.position + offset * reach)
        parts.append(np.stack([np.arange(len(surfels)), other], axis=1))
    pairs = np.unique(np.sort(np.concatenate(parts).astype(np.int64), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    delta = surfels.position[pairs[:, 1]] - surfels.position[pairs[:, 0]]
    distance = np.linalg.norm(delta, axis=1)
    turn = (surfels.normal[pairs[:, 0]] * surfels.normal[pairs[:, 1]]).sum(axis=1)
    lift = np.maximum(*(np.abs((delta * surfels.normal[pairs[:, i]]).sum(axis=1)) for i in (0, 1)))
    keep = (turn > 0.85) & (lift < 0.08 + 0.12 * distance) & (distance < 1.5 * reach_m)
    pairs, distance = pairs[keep], distance[keep]
    degree = np.bincount(pairs.ravel(), minlength=len(surfels)).astype(np.float64)
    weight = 2.0 / np.sqrt(degree[pairs[:, 0]] * degree[pairs[:, 1]])
    weight *= surfels.confidence[pairs[:, 0]] * surfels.confidence[pairs[:, 1]]
    return Graph(pairs, distance, weight)


def _pairs_of(index: Int64[np.ndarray, "n k"]) -> Int64[np.ndarray, "m 2"]:
    """(row, neighbour) of a table of neighbours."""
    rows = np.repeat(np.arange(len(index)), index.shape[1])
    return np.stack([rows, index.ravel()], axis=1)
