"""Area-exact image resizing."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32


def resize_area(
    image: Float[np.ndarray, "a b c"], height_px: int, width_px: int
) -> Float32[np.ndarray, "h w c"]:
    """Mean over the area that each new pixel covers (box filter); the mean is kept.

    Whole factors are plain block means; others go through the summed rows and columns.
    """
    height, width, channels = image.shape
    if height % height_px == 0 and width % width_px == 0:
        fy, fx = height // height_px, width // width_px
        blocks = image.reshape(height_px, fy, width_px, fx, channels)
        return blocks.mean(axis=(1, 3), dtype=np.float32)
    rows = _average_axis(image.astype(np.float32), height_px, 0)
    return _average_axis(rows, width_px, 1)


def _average_axis(
    image: Float32[np.ndarray, "a b c"], size: int, axis: int
) -> Float32[np.ndarray, "h w c"]:
    """Box average along one axis by differences of the interpolated running sum."""
    old = image.shape[axis]
    running = np.concatenate(
        [
            np.zeros_like(image.take([0], axis), dtype=np.float64),
            np.cumsum(image, axis, np.float64),
        ],
        axis,
    )
    edges = np.linspace(0.0, old, size + 1)
    low = np.minimum(edges.astype(np.int64), old - 1)
    part = (edges - low).reshape([-1 if k == axis else 1 for k in range(3)])
    at_edges = running.take(low, axis) * (1 - part) + running.take(low + 1, axis) * part
    return (np.diff(at_edges, axis=axis) * (size / old)).astype(np.float32)
