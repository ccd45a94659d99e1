"""Base colour of unobserved ground and house fronts, such as under and behind parked cars.

Colours are copied from ground elsewhere along the street, and on fronts from above (`shift_map`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, Int64
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree

from lightsim.appearance.atlas import texel_parts
from lightsim.appearance.config import HIDDEN_REACH_M, MIN_FRONT_COSINE, MIN_GROUND_NORMAL_Z
from lightsim.appearance.intrinsic.divide import HIGHEST_BASE_COLOUR, LOWEST_BASE_COLOUR
from lightsim.appearance.intrinsic.shift_map import Samples, ShiftMap
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import Texture, TriMesh

# The values below were chosen on synthetic streets 0 and 1. Only their joint effect is measured
# (docs/benchmarks/leaderboard.md, edits).

# Length over which the path is smoothed, in metres.
_SMOOTH_M = 4.0
# Length of the straight extension at both ends of the path, in metres.
_ONWARD_M = 60.0
# Spacing of the points of the path, in metres.
_STEP_M = 0.1
# Greatest distance of ground from the ground map, in metres.
_LEVEL_M = 0.3
# Minimum confidence of a sample.
_MIN_SAMPLE_CONFIDENCE = 0.99
# Confidence below which a texel is completed.
_HIDDEN_CONFIDENCE = 0.5
# Greatest absolute z component of the unit normal of a front.
_MAX_FRONT_NORMAL_Z = 0.3
# Width across the path, in metres, of the bins of the front's distance; the bin with the largest
# area wins.
_ACROSS_M = 0.25
# Greatest distance of a front's surface from its plane, in metres.
_FRONT_M = 0.6


@dataclass(frozen=True, eq=False)
class Road:
    """Driven path and ground, with coordinates along and across the path.

    Args:
        path_m: positions in order of time, metres, frame world.
        ground: height of the ground.
    """

    path_m: Float64[np.ndarray, "k 3"]
    ground: GroundMap

    @cached_property
    def _line(self) -> tuple[KDTree, Float64[np.ndarray, "n 2"]]:
        """Evenly spaced points of the smoothed path, and its unit directions there."""
        # Points are thinned, so that position noise of a stationary vehicle does not bend the path.
        sparse = [self.path_m[0, :2].astype(np.float64)]
        for point in self.path_m[1:, :2]:
            if np.linalg.norm(point - sparse[-1]) > _SMOOTH_M / 2:
                sparse.append(point.astype(np.float64))
        if len(sparse) == 1:
            sparse.append(sparse[0] + [_SMOOTH_M, 0.0])
        ends = [
            a + _ONWARD_M * (a - b) / np.linalg.norm(a - b) for a, b in (sparse[:2], sparse[:-3:-1])
        ]
        corners = np.array([ends[0], *sparse, ends[1]])
        length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))]
        at = np.arange(0.0, length[-1], _STEP_M)
        points = np.stack([np.interp(at, length, corners[:, k]) for k in (0, 1)], axis=1)
        half = round(_SMOOTH_M / _STEP_M)
        window = np.hanning(2 * half + 1)
        padded = np.pad(points, ((half, half), (0, 0)), mode="reflect", reflect_type="odd")
        smooth = [np.convolve(padded[:, k], window / window.sum(), "valid") for k in (0, 1)]
        points = np.stack(smooth, axis=1)
        way = np.gradient(points, axis=0)
        return KDTree(points), way / np.linalg.norm(way, axis=1, keepdims=True)

    def place(self, xy: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        """Return coordinates along the path and to the left of it, in metres."""
        tree, way = self._line
        nearest = np.asarray(tree.query(xy)[1])
        offset, way = xy - tree.data[nearest], way[nearest]
        along = _STEP_M * nearest + (offset * way).sum(axis=1)
        return np.stack([along, offset[:, 1] * way[:, 0] - offset[:, 0] * way[:, 1]], axis=1)

    def left(self, xy: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        """Return the unit direction to the left of the path at its nearest point."""
        tree, way = self._line
        way = way[np.asarray(tree.query(xy)[1])]
        return np.stack([-way[:, 1], way[:, 0]], axis=1)

    def height_m(self, points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Return heights above the ground."""
        return points[:, 2] - self.ground.look_up(points[:, :2])


def with_hidden_surfaces(
    mesh: TriMesh, confidence: Float64[np.ndarray, " n"], road: Road
) -> TriMesh:
    """Complete the base colour of ground and fronts beside the path, at vertices and texels.

    Colours remain unchanged if no similar surface exists along the street, or without a texture.

    Args:
        mesh: frame world; its texture is of the module `appearance.atlas`.
        confidence: of the vertices' colours, 0 where unobserved.
        road: path and ground of the log.
    """
    texture = mesh.texture
    if texture is None:
        return mesh
    image, base_colour = texture.image.reshape(-1, 3), mesh.base_colour
    has_changed = False
    for surface in (_ground(mesh, road), *_fronts(mesh, road)):
        texels = _Texels.of(mesh, texture, surface, confidence)
        if not texels.samples.is_hidden.any() or not texels.samples.is_known.any():
            continue
        if not has_changed:
            image, base_colour, has_changed = image.copy(), base_colour.copy(), True
        completed = ShiftMap.of(texels.samples)
        if surface.front_m is None:
            completed.complete_along()
        else:
            completed.complete_down()
        for colours, index, places in (
            (image, texels.pixel, texels.samples.places),
            (base_colour, *surface.vertices(mesh)),
        ):
            colour, is_filled = completed.at(places)
            colours[index[is_filled]] = np.clip(
                colour[is_filled], LOWEST_BASE_COLOUR, HIGHEST_BASE_COLOUR
            )
    if not has_changed:
        return mesh
    completed_texture = replace(texture, image=image.reshape(texture.image.shape))
    return replace(mesh, base_colour=base_colour, texture=completed_texture)


@dataclass(frozen=True, eq=False)
class _Surface:
    """Ground, or the front on one side of the path.

    Args:
        is_face: mask of the mesh's faces that may belong to the surface.
        front_m: signed distance of a front from the path for each metre along it; None for ground.
    """

    road: Road
    is_face: Bool[np.ndarray, " m"]
    front_m: Float64[np.ndarray, " k"] | None = None

    def place(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float64[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
        """Return surface coordinates in metres, and the mask of points on the surface.

        Coordinates are along the path and across it, or for a front above the ground.
        """
        places = self.road.place(points[:, :2])
        height = self.road.height_m(points)
        is_near = np.abs(places[:, 1]) < HIDDEN_REACH_M
        if self.front_m is None:
            return places, is_near & (np.abs(height) < _LEVEL_M)
        front = self.front_m[np.clip(_metre(places), 0, len(self.front_m) - 1)]
        is_on = is_near & (np.abs(places[:, 1] - front) < _FRONT_M)
        return np.stack([places[:, 0], height], axis=1), is_on

    def vertices(self, mesh: TriMesh) -> tuple[Int64[np.ndarray, " v"], Float64[np.ndarray, "v 2"]]:
        """Return the indices and surface coordinates of the vertices on the surface."""
        vertex = np.unique(mesh.faces[self.is_face]).astype(np.int64)
        places, is_on = self.place(mesh.vertices[vertex])
        return vertex[is_on], places[is_on]


def _ground(mesh: TriMesh, road: Road) -> _Surface:
    is_level = mesh.vertex_normals()[:, 2] > MIN_GROUND_NORMAL_Z
    return _Surface(road, np.asarray(is_level[mesh.faces].all(axis=1)))


def _fronts(mesh: TriMesh, road: Road) -> Iterator[_Surface]:
    """Yield the front on the left of the path and the one on the right."""
    normals = mesh.face_normals()
    upright = np.flatnonzero(np.abs(normals[:, 2]) < _MAX_FRONT_NORMAL_Z)
    normals, area_m2 = normals[upright], mesh.face_areas_m2()[upright]
    middle = mesh.vertices[mesh.faces[upright]].astype(np.float64).mean(axis=1)
    places, left = road.place(middle[:, :2]), road.left(middle[:, :2])
    facing_right = -(normals[:, :2] * left).sum(axis=1)
    away_m = np.abs(places[:, 1])
    rows, columns = _metre(places), (away_m / _ACROSS_M).astype(np.int64)
    shape = (max(int(rows.max(initial=0)), 0) + 1, round(HIDDEN_REACH_M / _ACROSS_M))
    for side in (1.0, -1.0):
        is_front = (side * facing_right > MIN_FRONT_COSINE) & (side * places[:, 1] > 0)
        is_front &= (away_m < HIDDEN_REACH_M) & (rows >= 0)
        area = np.zeros(shape)
        np.add.at(area, (rows[is_front], columns[is_front]), area_m2[is_front])
        # One bin is a metre along the path; both widths of the filter are one bin.
        dense = np.asarray(gaussian_filter(area, (1.0, 1.0)))
        is_face = np.zeros(len(mesh.faces), dtype=bool)
        is_face[upright[is_front]] = True
        yield _Surface(road, is_face, side * (dense.argmax(axis=1) + 0.5) * _ACROSS_M)


@dataclass(frozen=True, eq=False)
class _Texels:
    """Samples of one surface at the texels of a texture.

    Args:
        pixel: index of each texel in the image's pixels.
        samples: their colours, in the same order.
    """

    pixel: Int64[np.ndarray, " t"]
    samples: Samples

    @classmethod
    def of(
        cls,
        mesh: TriMesh,
        texture: Texture,
        surface: _Surface,
        confidence: Float64[np.ndarray, " n"],
    ) -> _Texels:
        image, found = texture.image.reshape(-1, 3), []
        for texels in texel_parts(texture, 1 << 18):
            rows = np.flatnonzero(surface.is_face[texels.face])
            corners, weight = mesh.faces[texels.face[rows]], texels.barycentric[rows]
            places, is_on = surface.place((weight[:, :, None] * mesh.vertices[corners]).sum(axis=1))
            sampled = (weight * confidence[corners]).sum(axis=1)
            found.append((texels.pixel[rows][is_on], places[is_on], sampled[is_on]))
        pixel, places, sampled = (np.concatenate(part) for part in zip(*found, strict=True))
        return cls(
            pixel,
            Samples(
                places,
                image[pixel],
                sampled >= _MIN_SAMPLE_CONFIDENCE,
                sampled < _HIDDEN_CONFIDENCE,
            ),
        )


def _metre(places: Float64[np.ndarray, "n 2"]) -> Int32[np.ndarray, " n"]:
    """Whole metres along the path."""
    return np.floor(places[:, 0]).astype(np.int32)
