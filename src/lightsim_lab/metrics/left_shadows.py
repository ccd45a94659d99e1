"""How much of the source's shadows is left in relit pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from scipy import ndimage

from lightsim.build.quality.frames import FrameTask
from lightsim.core.colour import linear_from_srgb8, luminance
from lightsim_lab.metrics.shadows import CLEAR, TrueShadows

_BAND_PX = 8
"""On both sides of a shadow's edge: material and other light are alike there."""
_DARKEST = 1 / 255
_FEWEST = 200
"""Fewer pixels on a side tell nothing."""


@dataclass(frozen=True)
class LeftShadowRow:
    """What one method left of the source's shadows under one sky, over all frames.

    Args:
        pixels: beside the edges of true source shadows.
        contrast: by which fraction what the source's sun did not reach is darker than it should be,
            beside what it reached; negative where it is brighter.
    """

    condition: str
    method: str
    pixels: int
    contrast: float


def score_left_shadows(
    tasks: Sequence[FrameTask], load_source_shadows: Callable[[FrameTask], TrueShadows | None]
) -> tuple[LeftShadowRow, ...]:
    """Of every method under every sky; none where the source had no sun."""
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
    """Number of pixels, and sum of the log of predicted over true luminance, each of shadowed and
    of lit pixels near shadows' edges: [2, 2]."""
    is_clear = source.is_decided & (source.rest < CLEAR)
    sides = [is_clear & source.is_shadowed, is_clear & ~source.is_shadowed]
    square = np.ones((2 * _BAND_PX + 1,) * 2, dtype=bool)
    near = [np.asarray(ndimage.binary_dilation(side, square), dtype=bool) for side in sides]
    here, there = (
        np.log(np.maximum(luminance(linear_from_srgb8(x)), _DARKEST)) for x in (predicted, truth)
    )
    chosen = [own & other for own, other in zip(sides, reversed(near), strict=True)]
    counts = [np.count_nonzero(side) for side in chosen]
    return np.array([counts, [(here - there)[side].sum() for side in chosen]], dtype=np.float64)


def _contrast(sums: np.ndarray) -> float:
    """Of sums as `_sum_logs` gives them; nan where there are too few pixels."""
    counts, logs = sums
    if counts.min() < _FEWEST:
        return float("nan")
    shadowed, lit = logs / counts
    return float(1 - np.exp(shadowed - lit))
