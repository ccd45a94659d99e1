"""Voxels that some camera saw through."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import RayCaster
from lightsim.core.mesh import TriMesh
from lightsim.core.resample import resize_area
from lightsim.core.sensors import CameraFrame
from lightsim.geometry.completion.free_space_kernels import walk_rays
from lightsim.geometry.completion.silhouettes import (
    SKY_ALPHA,
    SOLID_ALPHA,
    View,
    check_matte,
    spaced_views,
)

_LOWEST_RAY = -0.2
"""Vertical part of the steepest ray that is walked: below, only the road gets carved."""
_LARGEST_GRID = 100_000_000
"""Larger scenes get coarser voxels."""

# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/reconstruction.md).

# Edge of a voxel.
_VOXEL_M = 0.5
# Rays across an image.
_RAY_WIDTH_PX = 320
# Rays this close to a pixel that is not sky do not carve.
_ERODE_PX = 1
# Free space ends this far in front of a reconstructed surface.
_SURFACE_MARGIN_M = 0.75
# Views of a camera that moved less than this since its last used view are skipped.
_MIN_BASELINE_M = 0.7


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """A box of cubes aligned with frame world; `low_m` is its lowest corner.

    Args:
        is_free: 1 where a ray passed on to the sky or to a farther surface.
    """

    low_m: Float[np.ndarray, "3"]
    voxel_m: float
    is_free: UInt8[np.ndarray, "x y z"]

    def at(self, points_world: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Whether points lie in free voxels; outside the box nothing is known to be free."""
        cells = np.floor((points_world - self.low_m) / self.voxel_m).astype(np.int64)
        is_inside = np.all((cells >= 0) & (cells < self.is_free.shape), axis=-1)
        cells = np.where(is_inside[..., None], cells, 0)
        return is_inside & (self.is_free[cells[..., 0], cells[..., 1], cells[..., 2]] > 0)


def find_free_space(
    background: TriMesh, silhouettes: Iterable[View], caster: RayCaster, height_m: float
) -> FreeSpace:
    """Voxels that rays crossed to reconstructed surfaces, and to sky where there is none
    (silhouette carving, Laurentini 1994, doi:10.1109/34.273735).

    Args:
        background: gives the box: all of it but its outermost 0.2 %, and `height_m` high.
        silhouettes: frames with their camera (of the matte's size) and sky matte.
        caster: over the background.
        height_m: of the box.

    Raises:
        InputError: a matte does not fit its camera.
    """
    space = _empty(background, height_m)
    for view in spaced_views(silhouettes, _MIN_BASELINE_M):
        _carve(space, view, caster)
    return space


def _empty(background: TriMesh, height_m: float) -> FreeSpace:
    low, high = (
        np.percentile(background.vertices, percent, axis=0).astype(np.float64)
        for percent in (0.2, 99.8)
    )
    high[2] = low[2] + height_m
    volume = float(np.prod(high - low))
    voxel = max(_VOXEL_M, (volume / _LARGEST_GRID) ** (1 / 3))
    counts: Int[np.ndarray, "3"] = np.ceil((high - low) / voxel).astype(np.int64) + 4
    return FreeSpace(low - 2 * voxel, voxel, np.zeros(tuple(counts), np.uint8))


def _carve(space: FreeSpace, view: View, caster: RayCaster) -> None:
    frame, camera, matte = view
    small, is_sky, is_solid = _classified(camera, matte)
    directions = _directions(frame, small)
    eye = frame.world_from_camera.translation_m
    hits = caster.intersect(np.broadcast_to(eye, directions.shape).copy(), directions)
    # Sky on a surface is mirrored by it.
    is_end = is_sky | (is_solid & hits.is_hit)
    ends_m = np.where(is_end, hits.distance_m, 0.0)
    ends_m -= _SURFACE_MARGIN_M
    used = (ends_m > 0) & (directions[:, 2] > _LOWEST_RAY)
    walk_rays(
        (eye - space.low_m) / space.voxel_m,
        np.ascontiguousarray(directions[used]),
        ends_m[used] / space.voxel_m,
        space.is_free,
    )


def _directions(frame: CameraFrame, camera: PinholeCamera) -> Float[np.ndarray, "n 3"]:
    rays = frame.world_from_camera.rotate(camera.directions(camera.pixel_centres()))
    return np.ascontiguousarray(rays.reshape(-1, 3))


def _classified(
    camera: PinholeCamera, matte: Float[np.ndarray, "h w"]
) -> tuple[PinholeCamera, Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """The camera at ray resolution, and which of its rays are sky and which matter."""
    from scipy.ndimage import minimum_filter

    check_matte(camera, matte)
    small = camera.scaled(min(1.0, _RAY_WIDTH_PX / camera.width_px))
    masks = np.stack([matte >= SKY_ALPHA, matte <= SOLID_ALPHA], axis=-1)
    fractions = resize_area(masks.astype(np.float32), small.height_px, small.width_px) > 0.999
    is_sky = np.asarray(minimum_filter(fractions[..., 0], 2 * _ERODE_PX + 1), bool)
    return small, is_sky.ravel(), (fractions[..., 1] & ~is_sky).ravel()
