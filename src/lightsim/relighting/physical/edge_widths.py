"""Widths of isolated edges in a picture, from which the camera's blur is estimated.

A second blur of known width reduces the gradient of a blurred step edge by a factor that depends on
the ratio of both widths (Zhuo & Sim 2011, doi:10.1016/j.patcog.2011.03.009).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy import ndimage

# Standard deviations of the Gaussian gradient filters, in pixels. The ratio of the first two
# gradients gives the width of an edge; the third verifies that it is an edge and no line or corner.
SCALES_PX = (0.7, 1.4, 2.0)
# Variance of a pixel's square, in px^2: the width of a rendered edge.
PIXEL_PX2 = 1 / 12
# Variance that central differences add, in px^2: 1/3 along rows and columns, 1/6 diagonally.
_DIFFERENCE_PX2 = 1 / 3
# Height of an edge in sRGB, at least, as a fraction of the clipping value: ten times the noise of
# log 002.
_MIN_STEP = 0.1
# Difference of the variances from both pairs of filters, at most, in px^2. Half of the accepted
# edges on ideal pictures of the synthetic street are within 0.1.
_SAME_WIDTH_PX2 = 0.25
# Fraction of the edges whose mean is the mode. Edges in the scene only add blur to that of the
# camera, so the sharpest edges have a mode at the camera's width.
_MODE_FRACTION = 0.25
# Distance of edges to the picture's border, at least, in pixels; sensitivity not measured.
_BORDER_PX = 8


@dataclass(frozen=True, eq=False)
class Edges:
    """Points on single edges.

    Args:
        pixel: row and column.
        across: unit (row, column) direction across the edge.
        spread_px2: variance of the blur there, beyond a pixel's square; negative if the camera
            sharpens.
    """

    pixel: Int64[np.ndarray, "n 2"]
    across: Float64[np.ndarray, "n 2"]
    spread_px2: Float64[np.ndarray, " n"]


def find_edges(codes: Float64[np.ndarray, "h w"], is_left_out: Bool[np.ndarray, "h w"]) -> Edges:
    """Find the single edges of a picture.

    Args:
        codes: sRGB in [0, 1], in which cameras sharpen; the width of a blur of linear light is also
            measured correctly in codes (tested).
        is_left_out: pixels that may not lie within 4 pixels of an edge.
    """
    smooth = [ndimage.gaussian_filter(codes, scale, truncate=5.0) for scale in SCALES_PX]
    rise, run = (np.stack(g) for g in zip(*(np.gradient(s) for s in smooth), strict=True))
    size = np.hypot(rise, run)
    height = size[-1] * np.sqrt(2 * np.pi * (SCALES_PX[-1] ** 2 + _DIFFERENCE_PX2))
    is_candidate = np.logical_not(ndimage.maximum_filter(is_left_out, _BORDER_PX + 1))
    is_candidate &= (height > _MIN_STEP) & (size[1] > 0)
    inner = np.zeros_like(is_candidate)
    inner[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = True
    pixel = np.argwhere(is_candidate & inner)
    i, j = pixel.T
    # The direction is taken from the middle filter: less noise than the finest, less mixing of
    # neighbouring edges than the widest.
    across = np.stack([rise[1, i, j], run[1, i, j]], axis=1) / size[1, i, j][:, None]
    tops, is_ridge = zip(*(_ridge(gradient, pixel, across) for gradient in size), strict=True)
    keep = np.flatnonzero(np.all(is_ridge, axis=0))
    added = _DIFFERENCE_PX2 * (across[keep] ** 4).sum(axis=1)
    scales = [scale**2 + added for scale in SCALES_PX]
    logs = [top[keep] for top in tops]
    fine, coarse = (_variance(scales[k : k + 2], logs[k : k + 2]) for k in (0, 1))
    is_single = np.abs(fine - coarse) < _SAME_WIDTH_PX2
    keep = keep[is_single]
    return Edges(pixel[keep], across[keep], fine[is_single] - PIXEL_PX2)


def _ridge(
    gradient: Float64[np.ndarray, "h w"],
    pixel: Int64[np.ndarray, "n 2"],
    across: Float64[np.ndarray, "n 2"],
) -> tuple[Float64[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Return the log gradient at the edge's subpixel position, and whether that is less than a
    pixel away.

    The logarithm of a Gaussian is a parabola, which three samples across the edge determine.
    """
    steps = [(pixel + t * across).T for t in (-1, 0, 1)]
    values = [ndimage.map_coordinates(gradient, at, order=3, mode="nearest") for at in steps]
    before, here, after = np.log(np.maximum(values, 1e-9))
    slope = (after - before) / 2
    bend = np.minimum((before + after) / 2 - here, -1e-9)
    return here - slope**2 / (4 * bend), np.abs(slope) < -2 * bend


def _variance(
    scales_px2: list[Float64[np.ndarray, " n"]], log_gradients: list[Float64[np.ndarray, " n"]]
) -> Float64[np.ndarray, " n"]:
    """Variances of edges in px^2, from their gradients under two filters."""
    fall = np.expm1(np.clip(2 * (log_gradients[0] - log_gradients[1]), 1e-6, 50.0))
    return (scales_px2[1] - scales_px2[0]) / fall - scales_px2[0]


def half_sample_mode(values: Float64[np.ndarray, " n"]) -> float:
    """Mode of the values: mean of the closest values, a fixed fraction of all (half-sample mode;
    Bickel 2002, doi:10.1016/S0167-9473(01)00057-3, one step)."""
    ordered = np.sort(values)
    count = max(2, int(_MODE_FRACTION * len(ordered)))
    first = int(np.argmin(ordered[count - 1 :] - ordered[: len(ordered) - count + 1]))
    return float(ordered[first : first + count].mean())
