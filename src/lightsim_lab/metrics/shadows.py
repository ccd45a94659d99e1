"""Whether shadows fall where they should: read off relit pictures, whatever method made them.

No picture says of itself what is shadow. Beside the true picture it can be read: true visibility
and light tell what a pixel would show if the sun were, or were not, hidden from it. A pixel counts
as shadowed if it is nearer (as a ratio) to what the shadow would show.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from lightsim.build.quality.frame_report import FramesReport
from lightsim.build.quality.frames import FrameTask
from lightsim.core.colour import linear_from_srgb8, luminance

CLEAR = 0.6
"""A shadow that leaves more of the light than this cannot be told from texture. Not measured."""


@dataclass(frozen=True, eq=False)
class TrueShadows:
    """One frame under one sky.

    Args:
        is_shadowed: the sun is hidden, or behind the surface's own horizon.
        is_decided: surface that sees all of the sun or none.
        rest: light without the sun over light with it: what a shadow leaves; 1 where the sun
            cannot shine.
    """

    is_shadowed: Bool[np.ndarray, "h w"]
    is_decided: Bool[np.ndarray, "h w"]
    rest: Float32[np.ndarray, "h w"]


@dataclass(frozen=True)
class ShadowRow:
    """Shadows of one method under one sky, over all frames.

    Args:
        pixels: that were looked at: they face a sun whose shadow would show.
        iou: of the shadowed pixels, intersection over union.
        precision, recall: of shadowed pixels.
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
    """Every method's shadows under every sky with a sun, at the exposure that `report` found
    best for each sequence (1 where it looked for none)."""
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
    """Pixels that were looked at, that are shadowed in both, in the prediction, in the truth."""
    is_clear = true.is_decided & (true.rest < CLEAR)
    here = luminance(linear_from_srgb8(predicted))[is_clear] * exposure
    there = luminance(linear_from_srgb8(truth))[is_clear]
    # Half way, as a ratio, from what the truth shows to what it would show otherwise.
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
