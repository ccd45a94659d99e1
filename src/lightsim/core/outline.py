"""What things hide in a picture, whose reconstruction lacks a little."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from scipy import ndimage

# A recorded actor reaches this far beyond its reconstruction (mirrors, what the mesh lacks), and
# its outline in the picture is this soft.
_OUTLINE_M, _OUTLINE_PX = 0.12, 1.5

# Walls and roofs reach this far beyond theirs before the sky: cornices, signs, corners.
_EDGE_M = 0.5


def grown_outline(
    is_inside: Bool[np.ndarray, "h w"], depth_z_m: Float[np.ndarray, "h w"], focal_px: float
) -> Float32[np.ndarray, "h w"]:
    """How much of each pixel actors hide: their reconstruction, grown by what it may lack, soft at
    the edge.

    Args:
        is_inside: pixels that show their reconstruction.
        depth_z_m: there; not looked at elsewhere.
        focal_px: of the camera, in these pixels.
    """
    if not is_inside.any():
        return np.zeros(is_inside.shape, np.float32)
    distance_px, nearest = nearest_of(is_inside)
    reach_px = focal_px * _OUTLINE_M / depth_z_m[nearest] + _OUTLINE_PX
    return np.clip((reach_px - distance_px) / _OUTLINE_PX + 1, 0.0, 1.0).astype(np.float32)


def surface_beside(
    is_surface: Bool[np.ndarray, "h w"], distance_m: Float32[np.ndarray, "h w"], focal_px: float
) -> Float32[np.ndarray, "h w"]:
    """Distance of the surface beside which pixels show nothing of the twin, inf elsewhere: it may
    go on there.

    Args:
        is_surface: pixels that show a surface that may.
        distance_m: of all that the twin shows, inf where that is nothing.
    """
    if not is_surface.any():
        return np.full(is_surface.shape, np.inf, dtype=np.float32)
    away_px, nearest = nearest_of(is_surface)
    surface_m = distance_m[nearest]
    is_beside = np.isinf(distance_m) & (away_px < focal_px * _EDGE_M / surface_m + _OUTLINE_PX)
    return np.where(is_beside, surface_m, np.float32(np.inf)).astype(np.float32)


def goes_on(
    is_surface: Bool[np.ndarray, "h w"], is_matter: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Pixels from which matter alone leads straight to the nearest surface, and those around them,
    which are partly matter: walls go on there, wires that pass by do not count.

    Args:
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
    """Distance to the mask's nearest pixel, and its rows and columns; one is set, or more."""
    found = ndimage.distance_transform_edt(~mask, return_indices=True)
    assert isinstance(found, tuple)
    return found[0], (found[1][0], found[1][1])
