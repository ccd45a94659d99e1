"""Remaining contrast of source shadows in relit pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from scipy import ndimage

from lightsim.build.quality.frames import FrameTask
from lightsim.core.colour import linear_from_srgb8, luminance
from lightsim_lab.metrics.shadows import CLEAR, TrueShadows

# Width of the compared band on either side of a shadow edge, in pixels: material and other light
# are similar on both sides. Sensitivity not measured.
_BAND_PX = 8
# Smallest number of pixels on either side for which a contrast is reported.
_FEWEST = 200


@dataclass(frozen=True)
class LeftShadowRow:
    """Remaining source shadows of one method under one sky, over all frames.

    Args:
        pixels: number of pixels near the edges of true source shadows.
        contrast: fraction by which pixels in source shadow are too dark, relative to lit pixels
            beyond the edge; negative if they are too bright.
    """

    condition: str
    method: str
    pixels: int
    contrast: float


def score_left_shadows(
    tasks: Sequence[FrameTask], load_source_shadows: Callable[[FrameTask], TrueShadows | None]
) -> tuple[LeftShadowRow, ...]:
    """Score every method under every sky; without a source sun there are no rows."""
    sums: dict[tuple[str, str], np.ndarray] = {}
    for task in tasks:
        true = load_source_shadows(task)
        if true is None:
            continue
        truth = task.load_truth()
        for method, load in task.load_prediction_by_method.items():
            key = (task.condition, method)
            sums[key] = sums.get(key, np.zeros((2, 2))) + _sum_logs(load(), truth, true)
    return tuple(
        LeftShadowRow(*key, int(counts.sum()), _contrast(np.stack([counts, logs])))
        for key, (counts, logs) in sums.items()
    )


def _sum_logs(
    predicted: UInt8[np.ndarray, "h w 3"], truth: UInt8[np.ndarray, "h w 3"], source: TrueShadows
) -> np.ndarray:
    """Return [[counts], [sums]] of log (predicted / true luminance) near shadow edges, for shadowed
    and for lit pixels."""
    is_clear = source.is_decided & (source.rest < CLEAR)
    sides = [is_clear & source.is_shadowed, is_clear & ~source.is_shadowed]
    square = np.ones((2 * _BAND_PX + 1,) * 2, dtype=bool)
    near = [np.asarray(ndimage.binary_dilation(side, square), dtype=bool) for side in sides]
    here, there = (
        np.log(np.maximum(luminance(linear_from_srgb8(x)), 1 / 255)) for x in (predicted, truth)
    )
    # Pixels of one side that are near the other side form the band at the edge.
    chosen = [own & other for own, other in zip(sides, reversed(near), strict=True)]
    counts = [np.count_nonzero(side) for side in chosen]
    return np.array([counts, [(here - there)[side].sum() for side in chosen]], dtype=np.float64)


def _contrast(sums: np.ndarray) -> float:
    """Return the contrast from the sums of `_sum_logs`; NaN for too few pixels."""
    counts, logs = sums
    if counts.min() < _FEWEST:
        return float("nan")
    shadowed, lit = logs / counts
    # Errors common to both sides, such as exposure, cancel.
    return float(1 - np.exp(shadowed - lit))
