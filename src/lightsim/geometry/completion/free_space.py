"""Voxels that are free because a camera looks through them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import RayCaster
from lightsim.core.mesh import TriMesh
from lightsim.core.resample import resize_area
from lightsim.geometry.completion.free_space_kernels import walk_rays
from lightsim.geometry.completion.view_evidence import DENSE_BASELINE_M, View, ViewEvidence

# The values below were chosen on log 002 and street 0; only their joint effect was measured
# (docs/benchmarks/reconstruction.md).

# Least vertical component of a ray that is used; steeper rays would only carve the road.
_LOWEST_RAY = -0.2
# Greatest number of voxels, to limit memory; larger scenes have coarser voxels.
_LARGEST_GRID = 100_000_000
# Edge of a voxel, in metres.
_VOXEL_M = 0.5
# Number of rays across an image.
_RAY_WIDTH_PX = 320
# Margin around pixels that are not sky in which rays do not carve, in rays.
_ERODE_PX = 1
# Distance before a measured surface at which free space ends, in metres.
_SURFACE_MARGIN_M = 0.75


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """A box of cubic voxels aligned with frame world.

    Args:
        low_m: lowest corner of the box.
        voxel_m: edge of a voxel.
        is_free: 1 where a ray passed to the sky or to a farther surface.
    """

    low_m: Float[np.ndarray, "3"]
    voxel_m: float
    is_free: UInt8[np.ndarray, "x y z"]

    def at(self, points_world: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Return whether points lie in free voxels; False outside the box."""
        cells = np.floor((points_world - self.low_m) / self.voxel_m).astype(np.int64)
        is_inside = np.all((cells >= 0) & (cells < self.is_free.shape), axis=-1)
        cells = np.where(is_inside[..., None], cells, 0)
        return is_inside & (self.is_free[cells[..., 0], cells[..., 1], cells[..., 2]] > 0)


def find_free_space(
    background: TriMesh, evidence: ViewEvidence, caster: RayCaster, height_m: float
) -> FreeSpace:
    """Mark the voxels that rays crossed before they reached a surface or the sky.

    This is silhouette carving (Laurentini 1994, doi:10.1109/34.273735).

    Args:
        background: mesh whose extent, without its outermost 0.2 %, is the box in plan.
        evidence: the views of the log.
        caster: over the background.
        height_m: height of the box.

    Raises:
        InputError: a matte does not fit its camera.
    """
    space = _empty(background, height_m)
    for view in evidence.views(DENSE_BASELINE_M):
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
    small, is_sky, is_solid = _classified(view)
    frame = view.frame
    rays = frame.world_from_camera.rotate(small.directions(small.pixel_centres()))
    directions = np.ascontiguousarray(rays.reshape(-1, 3))
    eye = frame.world_from_camera.translation_m
    hits = caster.intersect(np.broadcast_to(eye, directions.shape).copy(), directions)
    # A sky pixel whose ray hits a surface shows a reflection, so the ray ends at the surface.
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


def _classified(
    view: View,
) -> tuple[PinholeCamera, Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return the camera at ray resolution, and whether each of its rays shows sky or a surface."""
    from scipy.ndimage import minimum_filter

    small = view.camera.scaled(min(1.0, _RAY_WIDTH_PX / view.camera.width_px))
    masks = np.stack([view.has_sky, view.has_surface], axis=-1)
    fractions = resize_area(masks.astype(np.float32), small.height_px, small.width_px) > 0.999
    is_sky = np.asarray(minimum_filter(fractions[..., 0], 2 * _ERODE_PX + 1), bool)
    return small, is_sky.ravel(), (fractions[..., 1] & ~is_sky).ravel()
