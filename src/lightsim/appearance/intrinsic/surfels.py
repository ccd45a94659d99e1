"""Surfels: a mesh's surface in patches of one size, with their radiance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64
from scipy.spatial import KDTree

from lightsim.appearance.intrinsic.light import ObservedPoints
from lightsim.core.mesh import TriMesh

# Number of nearest surfels that each is compared with. Chosen by inspection, as `_RANDOM_COUNT`.
_NEAREST_COUNT = 8
# Number of random surfels that each is compared with, to bridge thin shadows.
_RANDOM_COUNT = 5
# Columns of a sample: position, normal, colour (3 each), confidence, direction (3), roughness.
_COLUMNS = 14
# Samples processed together: some 50 MB of intermediate results for any log.
_CHUNK = 1 << 17
# Number of surfels processed together, to limit memory.
_CHUNK_SURFELS = 1 << 14


@dataclass(frozen=True, eq=False)
class Surfels:
    """Patches of a surface, frame of the mesh.

    Args:
        position: centre, metres.
        normal: unit normals.
        radiance: mean observed linear RGB.
        area_m2: area of each patch.
        confidence: 0 (interpolated colour) to 1 (observed).
        towards_camera: mean direction to the cameras, unit; 0 where unobserved.
        roughness: of the material.
    """

    position: Float64[np.ndarray, "n 3"]
    normal: Float64[np.ndarray, "n 3"]
    radiance: Float64[np.ndarray, "n 3"]
    area_m2: Float64[np.ndarray, " n"]
    confidence: Float64[np.ndarray, " n"]
    towards_camera: Float64[np.ndarray, "n 3"]
    roughness: Float64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.position)

    def points(self, lift_m: float) -> ObservedPoints:
        """Return points `lift_m` above the centres, at which light is evaluated.

        The centre of a bent patch lies below its surface, in the dark.
        """
        lifted = self.position + lift_m * self.normal
        return ObservedPoints(lifted, self.normal, self.towards_camera, self.roughness)


@dataclass(frozen=True, eq=False)
class Samples:
    """Points on a mesh: face indices and barycentric coordinates."""

    face: Int64[np.ndarray, " n"]
    barycentric: Float64[np.ndarray, "n 3"]


def sample_surface(
    mesh: TriMesh, faces: Int64[np.ndarray, " k"], spacing_m: float, rng: np.random.Generator
) -> Iterator[Samples]:
    """Yield uniform random points of some faces in parts of at most `_CHUNK`, to limit memory.

    The mean density is one point per square of side `spacing_m`.
    """
    a, b, c = (mesh.vertices[mesh.faces[faces, i]].astype(np.float64) for i in range(3))
    wanted = np.linalg.norm(np.cross(b - a, c - a), axis=1) / (2 * spacing_m**2)
    end = np.cumsum(np.floor(wanted + rng.random(len(wanted))).astype(np.int64))
    total = int(end[-1]) if len(end) else 0
    for start in range(0, total, _CHUNK):
        number = np.arange(start, min(start + _CHUNK, total))
        face = faces[np.searchsorted(end, number, side="right")]
        # The square root makes points uniform in the triangle (Turk 1990).
        root, v = np.sqrt(rng.random(len(face))), rng.random(len(face))
        yield Samples(face, np.stack([1 - root, root * (1 - v), root * v], axis=1))


@dataclass(frozen=True, eq=False)
class _Cells:
    """Sums over the samples in each cell of space and each facing side.

    Args:
        key: unique index of cell and side, ascending.
        count: number of samples.
        sums: sums of the columns of `_values_at`.
    """

    key: Int64[np.ndarray, " c"]
    count: Int64[np.ndarray, " c"]
    sums: Float64[np.ndarray, "c 14"]

    @staticmethod
    def joined(parts: Sequence[_Cells]) -> _Cells:
        """Merge parts that may have common cells."""
        key, index = np.unique(np.concatenate([part.key for part in parts]), return_inverse=True)
        count = np.zeros(len(key), np.int64)
        sums = np.zeros((len(key), _COLUMNS))
        start = 0
        for part in parts:
            rows = index[start : start + len(part.key)]
            count[rows] += part.count
            sums[rows] += part.sums
            start += len(part.key)
        return _Cells(key, count, sums)


def make_surfels(
    mesh: TriMesh, faces: Int64[np.ndarray, " k"], size_m: float, rng: np.random.Generator
) -> Surfels:
    """Divide some faces into the cells of a grid of `size_m`, and each cell into six facing sides.

    The radiance of a surfel is the mean over its texture, or over vertex colours without a texture.
    """
    spacing = size_m / 2.5
    vertices = ObservedPoints.vertices_of(mesh)
    corners = mesh.vertices[mesh.faces[faces]].reshape(-1, 3)
    low = np.floor(corners.min(axis=0, initial=np.inf).astype(np.float64) / size_m)
    size = np.floor(corners.max(axis=0, initial=-np.inf).astype(np.float64) / size_m) - low + 1
    del corners
    parts = [_Cells(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, _COLUMNS)))]
    for samples in sample_surface(mesh, faces, spacing, rng):
        values = _values_at(mesh, vertices, samples)
        cell = np.clip(np.floor(values[:, :3] / size_m) - low, 0, size - 1).astype(np.int64)
        place = (*cell.T, _side(values[:, 3:6]))
        key = np.ravel_multi_index(place, (*size.astype(np.int64), 6))
        parts.append(_summed(np.asarray(key), values))
    cells = _Cells.joined(parts)
    mean = cells.sums / cells.count[:, None]
    length = np.linalg.norm(mean[:, 3:6], axis=1, keepdims=True)
    # Opposed normals in one cell cancel; such a surfel has no orientation.
    is_good = length[:, 0] > 0.3
    normal = mean[is_good, 3:6] / length[is_good]
    area = cells.count[is_good] * spacing**2
    mean = mean[is_good]
    towards = mean[:, 10:13] / np.maximum(np.linalg.norm(mean[:, 10:13], axis=1), 1e-9)[:, None]
    return Surfels(mean[:, :3], normal, mean[:, 6:9], area, mean[:, 9], towards, mean[:, 13])


def _values_at(
    mesh: TriMesh, vertices: ObservedPoints, samples: Samples
) -> Float64[np.ndarray, "n 14"]:
    """Position, normal, colour, confidence, direction to the cameras and roughness."""
    corners = mesh.faces[samples.face]
    weight = samples.barycentric[:, :, None]
    seen = np.ones((len(corners), 1))
    if mesh.confidence is not None:
        seen = (weight[:, :, 0] * mesh.confidence[corners]).sum(axis=1, keepdims=True)
    colour = mesh.colour_at(samples.face, samples.barycentric)
    position, normal, towards = (
        (weight * vectors[corners]).sum(axis=1)
        for vectors in (mesh.vertices, vertices.normal, vertices.towards_camera)
    )
    roughness = (weight[:, :, 0] * vertices.roughness[corners]).sum(axis=1, keepdims=True)
    return np.concatenate([position, normal, colour, seen, towards, roughness], axis=1)


def _side(normal: Float64[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """Index of the axis direction (+x, -x, +y, -y, +z, -z) nearest to each normal."""
    axis = np.abs(normal).argmax(axis=1)
    return 2 * axis + (np.take_along_axis(normal, axis[:, None], 1)[:, 0] < 0)


def _summed(keys: Int64[np.ndarray, " n"], values: Float64[np.ndarray, "n 14"]) -> _Cells:
    key, index, count = np.unique(keys, return_inverse=True, return_counts=True)
    sums = [np.bincount(index, column, minlength=len(key)) for column in values.T]
    return _Cells(key, count.astype(np.int64), np.stack(sums, axis=1))


@dataclass(frozen=True, eq=False)
class Graph:
    """Unique pairs of surfels of one surface.

    Args:
        pairs: indices of the two surfels, the smaller first.
        distance_m: between the two.
        weight: of the pair; the weights of one surfel's pairs sum to about 2.
    """

    pairs: Int32[np.ndarray, "e 2"]
    distance_m: Float32[np.ndarray, " e"]
    weight: Float32[np.ndarray, " e"]


def connect(surfels: Surfels, reach_m: float, rng: np.random.Generator) -> Graph:
    """Connect each surfel with its nearest and with random surfels within `reach_m`.

    Two surfels of one surface have similar normals and little offset from each other's plane; other
    pairs are dropped.
    """
    tree, count = KDTree(surfels.position), len(surfels)
    keys = [np.zeros(0, np.int64)]
    for start in range(0, count, _CHUNK_SURFELS):
        rows = np.arange(start, min(start + _CHUNK_SURFELS, count))
        found = [_nearest(tree, surfels, rows), _random(tree, surfels, rows, reach_m, rng)]
        others = np.concatenate(found, axis=1)
        pairs = np.stack([np.repeat(rows, others.shape[1]), others.ravel()], axis=1)
        keys.append(_keys_of_one_surface(surfels, pairs, reach_m))
    joined = np.concatenate(keys)
    keys.clear()
    return _graph(surfels, _distinct(joined))


def _graph(surfels: Surfels, keys: Int64[np.ndarray, " e"]) -> Graph:
    """Decode the pairs of keys (`_keys_of_one_surface`), and compute distances and weights."""
    graph = Graph(
        np.empty((len(keys), 2), np.int32),
        np.empty(len(keys), np.float32),
        np.empty(len(keys), np.float32),
    )
    graph.pairs[:, 0], graph.pairs[:, 1] = np.divmod(keys, max(len(surfels), 1))
    degree = np.bincount(graph.pairs.ravel(), minlength=len(surfels)).astype(np.float64)
    strength = surfels.confidence / np.sqrt(np.maximum(degree, 1.0))
    for start in range(0, len(keys), _CHUNK):
        part = slice(start, start + _CHUNK)
        first, second = graph.pairs[part].T
        delta = surfels.position[first] - surfels.position[second]
        graph.distance_m[part] = np.linalg.norm(delta, axis=1)
        graph.weight[part] = 2.0 * strength[first] * strength[second]
    return graph


def _nearest(
    tree: KDTree, surfels: Surfels, rows: Int64[np.ndarray, " n"]
) -> Int64[np.ndarray, "n k"]:
    k = min(_NEAREST_COUNT + 1, len(surfels))
    _, index = tree.query(surfels.position[rows], k=k)
    return np.asarray(index).reshape(len(rows), k)


def _random(
    tree: KDTree,
    surfels: Surfels,
    rows: Int64[np.ndarray, " n"],
    reach_m: float,
    rng: np.random.Generator,
) -> Int64[np.ndarray, "n k"]:
    """Surfels nearest to random points of each surfel's plane."""
    normal = surfels.normal[rows][:, None]
    offset = rng.normal(size=(len(rows), _RANDOM_COUNT, 3))
    offset -= (offset * normal).sum(axis=2, keepdims=True) * normal
    offset /= np.maximum(np.linalg.norm(offset, axis=2, keepdims=True), 1e-9)
    offset *= reach_m * np.sqrt(rng.random((len(rows), _RANDOM_COUNT, 1)))
    _, index = tree.query(surfels.position[rows][:, None] + offset)
    return np.asarray(index)


def _keys_of_one_surface(
    surfels: Surfels, pairs: Int64[np.ndarray, "m 2"], reach_m: float
) -> Int64[np.ndarray, " k"]:
    """Unique keys (smaller index x count + larger index) of the pairs on one surface.

    Unique integers require a tenth of the memory of unique rows.
    """
    low, high = pairs.min(axis=1), pairs.max(axis=1)
    key = _distinct((low * len(surfels) + high)[low != high])
    low, high = np.divmod(key, len(surfels))
    delta = surfels.position[high] - surfels.position[low]
    distance = np.linalg.norm(delta, axis=1)
    turn = (surfels.normal[low] * surfels.normal[high]).sum(axis=1)
    lift = np.maximum(*(np.abs((delta * surfels.normal[i]).sum(axis=1)) for i in (low, high)))
    # Normals within 32 degrees; the offset from the planes may grow with the distance.
    keep = (turn > 0.85) & (lift < 0.08 + 0.12 * distance) & (distance < 1.5 * reach_m)
    return key[keep]


def _distinct(keys: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " k"]:
    """Sorted unique keys. `np.unique` of NumPy 2.4 hashes integers and takes 80 times as long."""
    ordered = np.sort(keys)
    return ordered[np.diff(ordered, prepend=-1) > 0]
