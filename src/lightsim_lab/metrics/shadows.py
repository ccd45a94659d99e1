"""Agreement of shadows in relit pictures with true shadows, for any relighting method.

Shadows cannot be read from a relit picture alone. The true picture, sun visibility and light give
the expected luminance of a pixel with and without sun. A pixel counts as shadowed if its luminance
is nearer, as a ratio, to the expected luminance without sun.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from lightsim.build.quality.frame_report import FramesReport
from lightsim.build.quality.frames import FrameTask
from lightsim.core.colour import linear_from_srgb8, luminance

# Remaining fraction of light above which a shadow is not distinguishable from texture. Sensitivity
# not measured.
CLEAR = 0.6


@dataclass(frozen=True, eq=False)
class TrueShadows:
    """True shadows of one frame under one sky.

    Args:
        is_shadowed: the sun is occluded, or the surface is turned away from it.
        is_decided: the sun is completely visible or completely occluded.
        rest: light without sun over light with unoccluded sun; 1 on surfaces turned away.
    """

    is_shadowed: Bool[np.ndarray, "h w"]
    is_decided: Bool[np.ndarray, "h w"]
    rest: Float32[np.ndarray, "h w"]


@dataclass(frozen=True)
class ShadowRow:
    """Shadow scores of one method under one sky, over all frames.

    Args:
        pixels: number of scored pixels, on which a shadow would be distinguishable.
        iou: intersection over union of the shadowed pixels.
        precision, recall: of the shadowed pixels.
    """

    condition: str
    method: str
    pixels: int
    iou: float
    precision: float
    recall: float


def score_shadows(
    tasks: Sequence[FrameTask],
    load_shadows: Callable[[FrameTask], TrueShadows | None],
    report: FramesReport,
) -> tuple[ShadowRow, ...]:
    """Score every method under every sky with a sun, at the exposure that `report` fitted to each
    sequence (1 if none was fitted)."""
    exposures = {
        (row.condition, row.camera_name, row.method): row.exposure_factor for row in report.rows
    }
    counts: dict[tuple[str, str], np.ndarray] = {}
    for task in tasks:
        true = load_shadows(task)
        if true is None:
            continue
        truth = task.load_truth()
        for method, load in task.load_prediction_by_method.items():
            exposure = exposures.get((task.condition, task.camera_name, method), 1.0)
            found = count_shadows(load(), truth, true, exposure)
            key = (task.condition, method)
            counts[key] = counts.get(key, np.zeros(4, dtype=np.int64)) + found
    return tuple(_row(*key, counted) for key, counted in counts.items())


def count_shadows(
    predicted: UInt8[np.ndarray, "h w 3"],
    truth: UInt8[np.ndarray, "h w 3"],
    true: TrueShadows,
    exposure: float = 1.0,
) -> np.ndarray:
    """Count the scored pixels, and those shadowed in both pictures, the prediction, the truth."""
    is_clear = true.is_decided & (true.rest < CLEAR)
    # Fitted exposure: a picture that is too dark as a whole has no additional shadows.
    here = luminance(linear_from_srgb8(predicted))[is_clear] * exposure
    there = luminance(linear_from_srgb8(truth))[is_clear]
    # Threshold: geometric mean of the true luminance and the luminance in the opposite state.
    half = np.sqrt(true.rest[is_clear])
    is_true = true.is_shadowed[is_clear]
    is_found = here < np.where(is_true, there / np.maximum(half, 1e-6), there * half)
    values = (is_clear, is_true & is_found, is_found, is_true)
    return np.array([np.count_nonzero(x) for x in values], dtype=np.int64)


def _row(condition: str, method: str, counted: np.ndarray) -> ShadowRow:
    pixels, both, found, true = (int(x) for x in counted)

    def part(whole: int) -> float:
        return both / whole if whole else float("nan")

    return ShadowRow(condition, method, pixels, part(found + true - both), part(found), part(true))
