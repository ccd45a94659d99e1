"""How wide single edges of a picture are: the camera's point spread, and what motion adds to it.

The gradient of a step that a Gaussian blurred, blurred once more, falls by the ratio of both widths
(Zhuo & Sim 2011, doi:10.1016/j.patcog.2011.03.009).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy import ndimage

SCALES_PX = (0.7, 1.4, 2.0)
"""Scales of the gradients whose ratio tells the width of an edge; the third one checks that it is
an edge, and no line or corner. In pixels."""
PIXEL_PX2 = 1 / 12
"""Variance of a pixel's square: of a rendered edge."""
# What differences of neighbours add to the variance: 1/3 along rows and columns, 1/6 between.
_DIFFERENCE_PX2 = 1 / 3
# An edge's least height in sRGB, of the clipping value: ten times the noise of log 002.
_LEAST_STEP = 0.1
# Width that two pairs of scales may see differently, px^2. Half of the edges that pass on ideal
# pictures of the synthetic street are within 0.1.
_SAME_WIDTH_PX2 = 0.25
# Edges of the scene are as sharp as the camera is, or softer: the sharp ones pile up at its width,
# and the closest of them, this part of all, are taken.
_PILE = 0.25
_BORDER_PX = 8


@dataclass(frozen=True, eq=False)
class Edges:
    """Points on single edges.

    Args:
        pixel: row and column.
        across: unit (row, column) direction across the edge.
        spread_px2: variance of the point spread there, beyond a pixel's square; below 0: sharpened.
    """

    pixel: Int64[np.ndarray, "n 2"]
    across: Float64[np.ndarray, "n 2"]
    spread_px2: Float64[np.ndarray, " n"]


def find_edges(codes: Float64[np.ndarray, "h w"], is_left_out: Bool[np.ndarray, "h w"]) -> Edges:
    """The single edges of a picture.

    Args:
        codes: sRGB in [0, 1], where cameras sharpen; how wide a blur of linear light is, they tell
            as well (tested).
        is_left_out: pixels that may not lie within 4 pixels of an edge.
    """
    smooth = [ndimage.gaussian_filter(codes, scale, truncate=5.0) for scale in SCALES_PX]
    rise, run = (np.stack(g) for g in zip(*(np.gradient(s) for s in smooth), strict=True))
    size = np.hypot(rise, run)
    height = size[-1] * np.sqrt(2 * np.pi * (SCALES_PX[-1] ** 2 + _DIFFERENCE_PX2))
    is_asked = np.logical_not(ndimage.maximum_filter(is_left_out, _BORDER_PX + 1))
    is_asked &= (height > _LEAST_STEP) & (size[1] > 0)
    inner = np.zeros_like(is_asked)
    inner[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = True
    pixel = np.argwhere(is_asked & inner)
    i, j = pixel.T
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
    """Log of the gradient on the edge's own line, which runs between pixels, and whether that is
    less than a pixel away: a Gaussian's logarithm is a parabola."""
    steps = [(pixel + t * across).T for t in (-1, 0, 1)]
    values = [ndimage.map_coordinates(gradient, at, order=3, mode="nearest") for at in steps]
    before, here, after = np.log(np.maximum(values, 1e-9))
    slope = (after - before) / 2
    bend = np.minimum((before + after) / 2 - here, -1e-9)
    return here - slope**2 / (4 * bend), np.abs(slope) < -2 * bend


def _variance(
    scales_px2: list[Float64[np.ndarray, " n"]], log_gradients: list[Float64[np.ndarray, " n"]]
) -> Float64[np.ndarray, " n"]:
    """Of edges, from their gradients at two scales."""
    fall = np.expm1(np.clip(2 * (log_gradients[0] - log_gradients[1]), 1e-6, 50.0))
    return (scales_px2[1] - scales_px2[0]) / fall - scales_px2[0]


def pile(values: Float64[np.ndarray, " n"]) -> float:
    """Mean of the values that lie closest together (half-sample mode; Bickel 2002,
    doi:10.1016/S0167-9473(01)00057-3, one step)."""
    ordered = np.sort(values)
    count = max(2, int(_PILE * len(ordered)))
    first = int(np.argmin(ordered[count - 1 :] - ordered[: len(ordered) - count + 1]))
    return float(ordered[first : first + count].mean())
