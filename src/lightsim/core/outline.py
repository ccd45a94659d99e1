"""Outlines of objects in pictures, beyond their slightly too small reconstruction."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from scipy import ndimage

# Distance by which a recorded actor extends beyond its reconstruction (mirrors, missing surface),
# in metres. Chosen with the next two by the look of removed actors; sensitivity not measured.
_OUTLINE_M = 0.12
# Width of the soft edge of its outline, in pixels.
_OUTLINE_PX = 1.5
# Distance by which walls and roofs extend beyond their reconstruction before the sky (cornices,
# signs), in metres.
_EDGE_M = 0.5


def grown_outline(
    is_inside: Bool[np.ndarray, "h w"], depth_z_m: Float[np.ndarray, "h w"], focal_px: float
) -> Float32[np.ndarray, "h w"]:
    """Return the fraction of each pixel that actors hide. Their reconstruction is grown by the
    margin that it may lack, with a soft edge.

    Args:
        is_inside: pixels that show their reconstruction.
        depth_z_m: depth in these pixels; not read elsewhere.
        focal_px: of the camera, in these pixels.
    """
    if not is_inside.any():
        return np.zeros(is_inside.shape, np.float32)
    distance_px, nearest = nearest_of(is_inside)
    # Metres become pixels at the depth of the nearest pixel of the actor. Beyond the reach,
    # coverage falls to 0 over the width of the soft edge.
    reach_px = focal_px * _OUTLINE_M / depth_z_m[nearest] + _OUTLINE_PX
    return np.clip((reach_px - distance_px) / _OUTLINE_PX + 1, 0.0, 1.0).astype(np.float32)


def surface_beside(
    is_surface: Bool[np.ndarray, "h w"], distance_m: Float32[np.ndarray, "h w"], focal_px: float
) -> Float32[np.ndarray, "h w"]:
    """Return the distance of the adjacent surface for pixels where the twin has none, else inf: the
    real surface may extend there.

    Args:
        is_surface: pixels that show a surface which may extend.
        distance_m: of the twin's surface, inf where there is none.
    """
    if not is_surface.any():
        return np.full(is_surface.shape, np.inf, dtype=np.float32)
    away_px, nearest = nearest_of(is_surface)
    surface_m = distance_m[nearest]
    is_beside = np.isinf(distance_m) & (away_px < focal_px * _EDGE_M / surface_m + _OUTLINE_PX)
    return np.where(is_beside, surface_m, np.float32(np.inf)).astype(np.float32)


def continued_surface(
    is_surface: Bool[np.ndarray, "h w"], is_matter: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels to which the nearest surface extends. Neither such a pixel nor three points
    on the straight line to that surface show sky. Neighbours are included, because they may be
    partly covered. Wires before the sky are excluded: their line to the surface crosses sky.

    Args:
        is_surface: pixels of the surfaces.
        is_matter: pixels that show no sky.
    """
    if not is_surface.any():
        return np.zeros(is_surface.shape, dtype=bool)
    _, nearest = nearest_of(is_surface)
    here = np.indices(is_surface.shape)
    is_led = is_matter.copy()
    for part in (0.25, 0.5, 0.75):
        i, j = np.rint(here + part * (np.stack(nearest) - here)).astype(np.int64)
        is_led &= (is_matter | is_surface)[i, j]
    return np.asarray(ndimage.maximum_filter(is_led, 3))


def nearest_of(
    mask: Bool[np.ndarray, "h w"],
) -> tuple[Float64[np.ndarray, "h w"], tuple[np.ndarray, np.ndarray]]:
    """Return the distance to the nearest pixel of a non-empty mask, and its row and column."""
    found = ndimage.distance_transform_edt(~mask, return_indices=True)
    assert isinstance(found, tuple)
    return found[0], (found[1][0], found[1][1])
