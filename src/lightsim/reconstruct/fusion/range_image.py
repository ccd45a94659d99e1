"""Range images of views, closed between neighbouring beams where the surface is continuous."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from scipy.spatial import Delaunay

from lightsim.core.fields import GroundMap
from lightsim.reconstruct.fusion.config import FuseConfig
from lightsim.reconstruct.fusion.sweep_views import View
from lightsim.reconstruct.fusion.tsdf_kernels import (
    FREE_ONLY,
    NOTHING,
    accumulate_vertex_normals,
    rasterise_triangles,
    smooth_vertex_normals,
)

# The values below were chosen on log 002 and synthetic street 0. Only their joint effect is
# measured (docs/benchmarks/reconstruction.md, test street 1).

# Azimuth range that is repeated beyond the seam at +-180 degrees: wider than the largest gap.
_WRAP_RAD = np.radians(4.0)
# Greatest angle of incidence of a surface triangle; steeper ones are depth discontinuities.
_MAX_INCIDENCE_DEG = 82.0
# Length of a triangle's longest edge, in metres, below which any incidence is accepted.
_SHORT_EDGE_M = 0.25
# Greatest angle between the beams of a surface triangle, except on the ground.
_MAX_GAP_DEG = 2.5
# Greatest distance between the returns of a surface triangle, except on the ground.
_MAX_EDGE_M = 2.5
# Greatest distance between the returns of a triangle on the ground.
_MAX_GROUND_EDGE_M = 8.0
# Greatest angle between the beams of a triangle that indicates free space.
_MAX_FREE_GAP_DEG = 1.5
# Greatest distance of a ground return from the ground map, in metres.
_GROUND_BAND_M = 0.3
# Least distance of a return from the sensor, in metres.
_MIN_DISTANCE_M = 0.5


@dataclass(frozen=True, eq=False)
class RangeImage:
    """Surface or free space in every direction around one view's origin.

    Args:
        origin_world: position of the sensor, metres; directions have the axes of frame `world`.
        time_ns: time of the view.
        pixel: first elevation, first azimuth, elevation step, azimuth step; radians.
        image: distance, unit normal towards the sensor, and 1 on the ground, else 0.
        labels: 0 static, i + 1 actor i, FREE_ONLY or NOTHING.
    """

    origin_world: Float64[np.ndarray, "3"]
    time_ns: int
    pixel: tuple[float, float, float, float]
    image: Float32[np.ndarray, "h w 5"]
    labels: Int32[np.ndarray, "h w"]

    def surface_points(self) -> tuple[Float64[np.ndarray, "n 3"], Int32[np.ndarray, " n"]]:
        """Return points in frame `world` and labels of the pixels with a surface."""
        row, column = np.nonzero(self.labels >= 0)
        elevation = self.pixel[0] + row * self.pixel[2]
        azimuth = self.pixel[1] + column * self.pixel[3]
        directions = np.stack(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ],
            axis=1,
        )
        distance = self.image[row, column, 0].astype(np.float64)
        return self.origin_world + directions * distance[:, None], self.labels[row, column]


@dataclass(frozen=True, eq=False)
class _Rays:
    """Returns as rays from a view's origin, with repetitions beyond the azimuth seam."""

    relative: Float64[np.ndarray, "n 3"]
    distances: Float64[np.ndarray, " n"]
    azimuth: Float64[np.ndarray, " n"]
    elevation: Float64[np.ndarray, " n"]
    labels: Int64[np.ndarray, " n"]
    is_ground: Bool[np.ndarray, " n"]


def make_range_image(view: View, ground: GroundMap, config: FuseConfig) -> RangeImage:
    """Triangulate the returns in direction space and rasterise the triangles.

    Triangulation does not require ring numbers, so any scan pattern works. A triangle is surface if
    its corners have one label and it is not a depth discontinuity. Other triangles indicate only
    free space.
    """
    rays = _rays(view, ground)
    shape, pixel = _layout(rays, config)
    image = np.zeros((*shape, 5), dtype=np.float32)
    labels = np.full(shape, NOTHING, dtype=np.int32)
    if len(rays.distances) < 3 or np.ptp(rays.elevation) < 1e-9:
        return RangeImage(view.origin_world, view.time_ns, pixel, image, labels)
    faces = Delaunay(np.stack([rays.azimuth, rays.elevation], axis=1)).simplices.astype(np.int32)
    face_normals, cosine = _face_normals(rays, faces)
    face_labels = _classify(rays, faces, cosine)
    normals = _vertex_normals(faces, face_normals, face_labels >= 0, len(rays.distances))
    is_drawn = face_labels != NOTHING
    drawn = faces[is_drawn]
    corners_px = np.stack(
        [(rays.elevation - pixel[0]) / pixel[2], (rays.azimuth - pixel[1]) / pixel[3]], axis=1
    )
    rasterise_triangles(
        corners_px,
        rays.relative / rays.distances[:, None],
        rays.distances,
        normals,
        drawn,
        face_labels[is_drawn],
        np.stack([rays.distances[drawn].min(axis=1), rays.is_ground[drawn].all(axis=1)], axis=1),
        pixel,
        image,
        labels,
    )
    length = np.linalg.norm(image[..., 1:4], axis=-1, keepdims=True)
    image[..., 1:4] /= np.where(length > 0, length, 1)
    labels[(labels >= 0) & (length[..., 0] < 1e-6)] = FREE_ONLY
    return RangeImage(view.origin_world, view.time_ns, pixel, image, labels)


def _rays(view: View, ground: GroundMap) -> _Rays:
    relative = view.points_world - view.origin_world
    distance = np.linalg.norm(relative, axis=1)
    is_far = distance > _MIN_DISTANCE_M
    relative, distance, labels = relative[is_far], distance[is_far], view.labels[is_far]
    points = view.points_world[is_far]
    height = points[:, 2] - ground.look_up(points[:, :2])
    azimuth = np.arctan2(relative[:, 1], relative[:, 0])
    elevation = np.arcsin(np.clip(relative[:, 2] / distance, -1, 1))
    below, above = azimuth < -np.pi + _WRAP_RAD, azimuth > np.pi - _WRAP_RAD
    index = np.concatenate([np.arange(len(distance)), np.flatnonzero(below), np.flatnonzero(above)])
    turn = np.zeros(len(index))
    turn[len(distance) :] = 2 * np.pi
    turn[len(distance) + int(below.sum()) :] = -2 * np.pi
    is_ground = np.abs(height) < _GROUND_BAND_M
    return _Rays(
        relative[index],
        distance[index],
        azimuth[index] + turn,
        elevation[index],
        labels[index],
        is_ground[index],
    )


def _layout(
    rays: _Rays, config: FuseConfig
) -> tuple[tuple[int, int], tuple[float, float, float, float]]:
    width = round(360.0 / config.azimuth_step_deg)
    step = float(np.radians(config.elevation_step_deg))
    low = float(rays.elevation.min(initial=0.0))
    height = int((float(rays.elevation.max(initial=0.0)) - low) / step) + 2
    return (height, width), (low, -float(np.pi), step, 2 * float(np.pi) / width)


def _face_normals(
    rays: _Rays, faces: Int32[np.ndarray, "m 3"]
) -> tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, " m"]]:
    """Unit normals towards the sensor, and the cosine of incidence at the face's middle."""
    a, b, c = (rays.relative[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals /= np.where(length > 0, length, 1)[:, None]
    middle = (a + b + c) / 3
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    cosine = -(normals * middle).sum(axis=1)
    return normals * np.where(cosine < 0, -1.0, 1.0)[:, None], np.abs(cosine)


def _classify(
    rays: _Rays, faces: Int32[np.ndarray, "m 3"], cosine: Float64[np.ndarray, " m"]
) -> Int32[np.ndarray, " m"]:
    """Label of each triangle: that of its corners if it is surface, else FREE_ONLY or NOTHING."""
    edge, gap = np.zeros(len(faces)), np.zeros(len(faces))
    for i, j in ((0, 1), (1, 2), (2, 0)):
        a, b = faces[:, i], faces[:, j]
        edge = np.maximum(edge, np.linalg.norm(rays.relative[a] - rays.relative[b], axis=1))
        across = (rays.azimuth[a] - rays.azimuth[b]) * np.cos(rays.elevation[a])
        gap = np.maximum(gap, np.hypot(across, rays.elevation[a] - rays.elevation[b]))
    gap = np.degrees(gap)
    labels = rays.labels[faces]
    is_one = (labels == labels[:, :1]).all(axis=1)
    is_ground = rays.is_ground[faces].all(axis=1) & (labels[:, 0] == 0)
    is_ground &= edge < _MAX_GROUND_EDGE_M
    is_smooth = (cosine > np.cos(np.radians(_MAX_INCIDENCE_DEG))) | (edge < _SHORT_EDGE_M)
    is_close = (gap < _MAX_GAP_DEG) & (edge < _MAX_EDGE_M)
    is_surface = is_one & (is_ground | (is_smooth & is_close))
    result = np.where(gap < _MAX_FREE_GAP_DEG, FREE_ONLY, NOTHING)
    return np.where(is_surface, labels[:, 0], result).astype(np.int32)


def _vertex_normals(
    faces: Int32[np.ndarray, "m 3"],
    face_normals: Float64[np.ndarray, "m 3"],
    is_surface: Bool[np.ndarray, " m"],
    count: int,
) -> Float64[np.ndarray, "count 3"]:
    """Mean normal of the adjacent surface faces, smoothed against the range noise."""
    normals = np.zeros((count, 3))
    accumulate_vertex_normals(faces, face_normals, is_surface, normals)
    for _ in range(2):
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals /= np.where(length > 0, length, 1)
        smoothed = np.zeros_like(normals)
        smooth_vertex_normals(faces, is_surface, normals, smoothed)
        normals = smoothed
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1)
