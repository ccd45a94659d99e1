"""What actors hide in a picture, whose reconstruction lacks a little."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from scipy import ndimage

# A recorded actor reaches this far beyond its reconstruction (mirrors, what the mesh lacks), and
# its outline in the picture is this soft.
_OUTLINE_M, _OUTLINE_PX = 0.12, 1.5


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


def nearest_of(
    mask: Bool[np.ndarray, "h w"],
) -> tuple[Float64[np.ndarray, "h w"], tuple[np.ndarray, np.ndarray]]:
    """Distance to the mask's nearest pixel, and its rows and columns; one is set, or more."""
    found = ndimage.distance_transform_edt(~mask, return_indices=True)
    assert isinstance(found, tuple)
    return found[0], (found[1][0], found[1][1])
