"""Cached pixel grids of panoramas, one for each size."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float32, Float64

from lightsim.core.equirect import pixel_directions, solid_angles_sr


@lru_cache(maxsize=8)
def directions(height_px: int) -> Float32[np.ndarray, "h w 3"]:
    """Return the read-only unit directions of the pixels of a panorama."""
    grid = pixel_directions(height_px).astype(np.float32)
    # The cached array is common to all callers: writing to it must fail.
    grid.setflags(write=False)
    return grid


@lru_cache(maxsize=8)
def level_weights(height_px: int) -> Float64[np.ndarray, " r"]:
    """Return cosine times solid angle, in sr, of a pixel of each row of the upper half."""
    half = height_px // 2
    weights = (pixel_directions(height_px)[:half, :1, 2] * solid_angles_sr(height_px)[:half])[:, 0]
    weights.setflags(write=False)
    return weights
