"""Base colour of ground and house fronts that nobody saw, such as under parked cars and behind
them: ground goes on as it does further along the street, a front downward (shift_map).
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
from lightsim.appearance.config import FRONT_FACING, HIDDEN_REACH_M, LEVEL_NORMAL
from lightsim.appearance.intrinsic.divide import HIGHEST_BASE_COLOUR, LOWEST_BASE_COLOUR
from lightsim.appearance.intrinsic.shift_map import Samples, ShiftMap
from lightsim.core.fields import GroundMap
from lightsim.core.mesh import Texture, TriMesh

# Chosen while looking at streets 0 and 1; what they do: docs/benchmarks/leaderboard.md (edits).

# The path is smoothed over this length, and goes straight on at its ends.
_SMOOTH_M, _ONWARD_M, _STEP_M = 4.0, 60.0, 0.1
# Ground lies this near its level.
_LEVEL_M = 0.3
# Places are known from the first trust on, and hidden below the second.
_KNOWN, _HIDDEN = 0.99, 0.5
# A front stands upright (cosine).
_UPRIGHT = 0.3
# Of all that faces the path on one side, the front is where most of its surface stands within the
# first width across the path (and the second along it); it takes in what lies this near.
_ACROSS_M, _ALONG_M, _FRONT_M = 0.25, 1.0, 0.6
_TEXELS = 1 << 18


@dataclass(frozen=True, eq=False)
class Road:
    """Where a recording drove.

    Args:
        path_m: its positions, in order, frame world.
        ground: height of the ground.
    """

    path_m: Float64[np.ndarray, "k 3"]
    ground: GroundMap

    @cached_property
    def _line(self) -> tuple[KDTree, Float64[np.ndarray, "n 2"]]:
        """Points of the smoothed path, evenly spaced, and its direction there."""
        kept = [self.path_m[0, :2].astype(np.float64)]
        for point in self.path_m[1:, :2]:
            if np.linalg.norm(point - kept[-1]) > _SMOOTH_M / 2:
                kept.append(point.astype(np.float64))
        if len(kept) == 1:
            kept.append(kept[0] + [_SMOOTH_M, 0.0])
        ends = [
            a + _ONWARD_M * (a - b) / np.linalg.norm(a - b) for a, b in (kept[:2], kept[:-3:-1])
        ]
        corners = np.array([ends[0], *kept, ends[1]])
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
        """Metres along the road and to the left of it."""
        tree, way = self._line
        nearest = np.asarray(tree.query(xy)[1])
        offset, way = xy - tree.data[nearest], way[nearest]
        along = _STEP_M * nearest + (offset * way).sum(axis=1)
        return np.stack([along, offset[:, 1] * way[:, 0] - offset[:, 0] * way[:, 1]], axis=1)

    def left(self, xy: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        """Unit direction to the left of the road where it is nearest."""
        tree, way = self._line
        way = way[np.asarray(tree.query(xy)[1])]
        return np.stack([-way[:, 1], way[:, 0]], axis=1)

    def height_m(self, points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Above the ground."""
        return points[:, 2] - self.ground.look_up(points[:, :2])


def with_hidden_surfaces(mesh: TriMesh, trust: Float64[np.ndarray, " n"], road: Road) -> TriMesh:
    """The mesh with the base colour of its ground and of the fronts beside the path completed, at
    vertices and texels; as it is where the street tells nothing, or without a texture.

    Args:
        mesh: frame world; its texture was packed by `appearance.atlas`.
        trust: in the vertices' colours, 0 where nobody saw them.
        road: along which the street goes on.
    """
    texture = mesh.texture
    if texture is None:
        return mesh
    image, base_colour = texture.image.reshape(-1, 3), mesh.base_colour
    has_changed = False
    for surface in (_ground(mesh, road), *_fronts(mesh, road)):
        texels = _Texels.of(mesh, texture, surface, trust)
        if not texels.samples.is_hidden.any() or not texels.samples.is_known.any():
            continue
        if not has_changed:
            image, base_colour, has_changed = image.copy(), base_colour.copy(), True
        completed = ShiftMap.of(texels.samples)
        if surface.is_ground:
            completed.complete_along()
        else:
            completed.complete_down()
        for colours, index, places in (
            (image, texels.pixel, texels.samples.places),
            (base_colour, *surface.vertices(mesh)),
        ):
            colour, is_told = completed.at(places)
            colours[index[is_told]] = np.clip(
                colour[is_told], LOWEST_BASE_COLOUR, HIGHEST_BASE_COLOUR
            )
    if not has_changed:
        return mesh
    completed_texture = replace(texture, image=image.reshape(texture.image.shape))
    return replace(mesh, base_colour=base_colour, texture=completed_texture)


@dataclass(frozen=True, eq=False)
class _Surface:
    """What goes on along the path.

    Args:
        is_face: of the mesh's faces, those that may belong to it.
        front_m: how far from the path it stands for each metre along; None: it is the ground.
    """

    road: Road
    is_face: Bool[np.ndarray, " m"]
    front_m: Float64[np.ndarray, " k"] | None = None

    @property
    def is_ground(self) -> bool:
        """A front otherwise."""
        return self.front_m is None

    def place(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float64[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
        """Metres along the path and across it (of a front: above the ground), and which points lie
        on the surface."""
        places = self.road.place(points[:, :2])
        height = self.road.height_m(points)
        is_near = np.abs(places[:, 1]) < HIDDEN_REACH_M
        if self.front_m is None:
            return places, is_near & (np.abs(height) < _LEVEL_M)
        front = self.front_m[np.clip(_metre(places), 0, len(self.front_m) - 1)]
        is_on = is_near & (np.abs(places[:, 1] - front) < _FRONT_M)
        return np.stack([places[:, 0], height], axis=1), is_on

    def vertices(self, mesh: TriMesh) -> tuple[Int64[np.ndarray, " v"], Float64[np.ndarray, "v 2"]]:
        """Those of its faces, and their places."""
        vertex = np.unique(mesh.faces[self.is_face]).astype(np.int64)
        places, is_on = self.place(mesh.vertices[vertex])
        return vertex[is_on], places[is_on]


def _ground(mesh: TriMesh, road: Road) -> _Surface:
    is_level = mesh.vertex_normals()[:, 2] > LEVEL_NORMAL
    return _Surface(road, np.asarray(is_level[mesh.faces].all(axis=1)))


def _fronts(mesh: TriMesh, road: Road) -> Iterator[_Surface]:
    """Those on the left of the path, and those on the right."""
    normals = mesh.face_normals()
    upright = np.flatnonzero(np.abs(normals[:, 2]) < _UPRIGHT)
    normals, area_m2 = normals[upright], mesh.face_areas_m2()[upright]
    middle = mesh.vertices[mesh.faces[upright]].astype(np.float64).mean(axis=1)
    places, left = road.place(middle[:, :2]), road.left(middle[:, :2])
    facing_right = -(normals[:, :2] * left).sum(axis=1)
    away_m = np.abs(places[:, 1])
    rows, columns = _metre(places), (away_m / _ACROSS_M).astype(np.int64)
    shape = (max(int(rows.max(initial=0)), 0) + 1, round(HIDDEN_REACH_M / _ACROSS_M))
    for side in (1.0, -1.0):
        is_front = (side * facing_right > FRONT_FACING) & (side * places[:, 1] > 0)
        is_front &= (away_m < HIDDEN_REACH_M) & (rows >= 0)
        area = np.zeros(shape)
        np.add.at(area, (rows[is_front], columns[is_front]), area_m2[is_front])
        dense = np.asarray(gaussian_filter(area, (_ALONG_M, 1.0)))
        is_face = np.zeros(len(mesh.faces), dtype=bool)
        is_face[upright[is_front]] = True
        yield _Surface(road, is_face, side * (dense.argmax(axis=1) + 0.5) * _ACROSS_M)


@dataclass(frozen=True, eq=False)
class _Texels:
    """Of a surface; `pixel`: of the texture."""

    pixel: Int64[np.ndarray, " t"]
    samples: Samples

    @classmethod
    def of(
        cls, mesh: TriMesh, texture: Texture, surface: _Surface, trust: Float64[np.ndarray, " n"]
    ) -> _Texels:
        image, found = texture.image.reshape(-1, 3), []
        for texels in texel_parts(texture, _TEXELS):
            rows = np.flatnonzero(surface.is_face[texels.face])
            corners, weight = mesh.faces[texels.face[rows]], texels.barycentric[rows]
            places, is_on = surface.place((weight[:, :, None] * mesh.vertices[corners]).sum(axis=1))
            trusted = (weight * trust[corners]).sum(axis=1)
            found.append((texels.pixel[rows][is_on], places[is_on], trusted[is_on]))
        pixel, places, trusted = (np.concatenate(part) for part in zip(*found, strict=True))
        return cls(pixel, Samples(places, image[pixel], trusted >= _KNOWN, trusted < _HIDDEN))


def _metre(places: Float64[np.ndarray, "n 2"]) -> Int32[np.ndarray, " n"]:
    """Whole metres along the path."""
    return np.floor(places[:, 0]).astype(np.int32)
