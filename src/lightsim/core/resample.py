"""Area-exact resizing of images and of equirectangular panoramas."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32
from scipy.sparse import csr_matrix


def resize_area(
    image: Float[np.ndarray, "a b c"], height_px: int, width_px: int
) -> Float32[np.ndarray, "h w c"]:
    """Average over the area of each new pixel (box filter); the mean of the image is unchanged.

    Whole factors are plain block means.
    """
    height, width, channels = image.shape
    if height % height_px == 0 and width % width_px == 0:
        fy, fx = height // height_px, width // width_px
        # Sums of strided views: five times faster than a mean over two axes of a block view.
        rows = _sum_of([image[k::fy] for k in range(fy)])
        return _sum_of([rows[:, k::fx] for k in range(fx)]) / np.float32(fy * fx)
    # Separable: rows first, then columns. Each new pixel overlaps few old ones, so that sparse
    # matrices cost far less than dense ones.
    rows, columns = (
        csr_matrix(area_weights(old, new)) for old, new in ((height, height_px), (width, width_px))
    )
    flat = rows @ image.reshape(height, -1)
    across = flat.reshape(height_px, width, channels).swapaxes(0, 1).reshape(width, -1)
    result = (columns @ across).reshape(width_px, height_px, channels).swapaxes(0, 1)
    return np.ascontiguousarray(result, dtype=np.float32)


def _sum_of(parts: Sequence[Float[np.ndarray, "a b c"]]) -> Float32[np.ndarray, "a b c"]:
    total = parts[0].astype(np.float32)
    for part in parts[1:]:
        total += part
    return total


def resize_sphere(
    radiance: Float[np.ndarray, "a b c"], height_px: int
) -> Float[np.ndarray, "h w c"]:
    """Return an equirectangular panorama with another number of rows.

    With fewer rows each pixel is the mean over its solid angle, which keeps the energy of every
    region; with more rows the mean of 4x4 bilinear look-ups, closed in azimuth.
    """
    height = len(radiance)
    if height_px > height:
        rows = _look_ups(height, height_px, is_around=False)
        columns = _look_ups(2 * height, 2 * height_px, is_around=True)
    else:
        # Solid angle is even in azimuth and in the cosine of the polar angle.
        old, new = (-np.cos(np.linspace(0, np.pi, n + 1)) for n in (height, height_px))
        rows = _overlaps(old, new)
        columns = area_weights(2 * height, 2 * height_px)
    wide = np.tensordot(rows, radiance.astype(np.float64), axes=(1, 0))
    return columns @ wide


def area_weights(old_px: int, new_px: int) -> Float[np.ndarray, "m k"]:
    """Return the fraction of each new pixel (rows) that each old pixel (columns) of a line covers;
    rows sum to 1."""
    return _overlaps(np.linspace(0, 1, old_px + 1), np.linspace(0, 1, new_px + 1))


def _overlaps(
    old: Float[np.ndarray, " o"], new: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "m k"]:
    """Return the fraction of each new interval (rows) that lies in each old one (columns)."""
    low = np.maximum(new[:-1, None], old[None, :-1])
    high = np.minimum(new[1:, None], old[None, 1:])
    fraction = np.clip(high - low, 0.0, None)
    return fraction / fraction.sum(axis=1, keepdims=True)


def _look_ups(old: int, new: int, is_around: bool) -> Float[np.ndarray, "n o"]:
    """Return the weights of old pixels in the mean of four linear look-ups in each new one, along
    an axis that closes (azimuth) or ends (polar angle)."""
    # Four positions in each new pixel; modulo closes the axis, and adds weight 0 where it ends.
    position = (np.arange(4 * new) + 0.5) / (4 * new) * old - 0.5
    if not is_around:
        position = np.clip(position, 0.0, old - 1.0)
    left = np.floor(position).astype(np.int64)
    part = position - left
    weights = np.zeros((new, old))
    row = np.arange(4 * new) // 4
    np.add.at(weights, (row, left % old), (1 - part) / 4)
    np.add.at(weights, (row, (left + 1) % old), part / 4)
    return weights
