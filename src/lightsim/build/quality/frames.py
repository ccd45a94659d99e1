"""Scores of predicted frames against true ones: per condition, camera, method and region."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import partial
from itertools import groupby
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from lightsim.build.quality.frame_report import FrameRow, FramesReport, Region
from lightsim.build.quality.metrics import (
    SSIM_BORDER_PX,
    ImageScores,
    expose,
    fill_invalid,
    fit_exposure,
    mean_ssim,
    psnr,
    ssim,
    ssim_map,
)
from lightsim.errors import InputError
from lightsim.progress import Progress, SilentProgress

LoadImage = Callable[[], UInt8[np.ndarray, "h w 3"]]
LoadMask = Callable[[], Bool[np.ndarray, "h w"]]
LoadClasses = Callable[[], Mapping[Region, Bool[np.ndarray, "h w"]]]
_INNER = np.s_[SSIM_BORDER_PX:-SSIM_BORDER_PX, SSIM_BORDER_PX:-SSIM_BORDER_PX]


@runtime_checkable
class PerceptualDistance(Protocol):
    """A learned distance between pictures in [0, 1], such as LPIPS.

    The features of a truth are computed once for all predictions of it.
    """

    def features(self, srgb: Float32[np.ndarray, "h w 3"]) -> Any:
        """Return the features of a picture."""
        ...

    def distances(
        self,
        srgb: Float32[np.ndarray, "h w 3"],
        truth_features: Any,
        is_valid: Bool[np.ndarray, "h w"] | None,
    ) -> tuple[float, ...]:
        """Return the distances of a picture from the truth, in the order of `ImageScores`."""
        ...


@dataclass(frozen=True)
class FramesConfig:
    """Measures of frames.

    Args:
        perceptual: learned distances of raw images, in the region `masked` where there is a mask;
            None leaves them out.
    """

    perceptual: PerceptualDistance | None = None
    with_exposure: bool = True
    """Also score with one exposure factor per sequence (condition, camera, method)."""


@dataclass(frozen=True, eq=False)
class FrameTask:
    """One true frame and the pictures of methods. Images are 8-bit sRGB.

    Args:
        condition: group in the table, such as the name of the target sky.
        load_prediction_by_method: image of each method, of the size of the truth.
        load_is_valid: valid pixels, the region `masked`; None: only `whole` is scored.
        load_classes: pixels of further regions, by name; scored without LPIPS.
    """

    condition: str
    camera_name: str
    stem: str
    load_truth: LoadImage
    load_prediction_by_method: Mapping[str, LoadImage]
    load_is_valid: LoadMask | None = None
    load_classes: LoadClasses | None = None


def score_frames(
    tasks: Sequence[FrameTask],
    config: FramesConfig,
    *,
    progress: Progress | None = None,
) -> FramesReport:
    """Score every sequence; frames are loaded one by one, twice if exposure is fitted.

    Raises:
        InputError: there is nothing to score, or an image has another size than its truth.
    """
    if not tasks:
        raise InputError(
            "there are no frames to score", expected="one frame or more with its truth"
        )
    progress = progress or SilentProgress()
    # Sorted, because groupby joins neighbours only; the sort is stable, so that frames stay
    # in order.
    ordered = sorted(tasks, key=_sequence_key)
    rows: list[FrameRow] = []
    groups = [list(group) for _, group in groupby(ordered, key=_sequence_key)]
    for group in progress.track(groups, "score sequences"):
        rows.extend(_score_sequence(group, config))
    return FramesReport(tuple(rows))


def _sequence_key(task: FrameTask) -> tuple[str, str]:
    return task.condition, task.camera_name


def _score_sequence(tasks: Sequence[FrameTask], config: FramesConfig) -> Iterator[FrameRow]:
    """Yield the rows of one condition and camera."""
    methods = tuple(tasks[0].load_prediction_by_method)
    factors = {(method, False): 1.0 for method in methods}
    if config.with_exposure:
        factors |= {(method, True): _sequence_exposure(tasks, method) for method in methods}
    scores: dict[tuple[str, Region, bool], dict[str, ImageScores]] = {}
    for task in tasks:
        # Images of one frame at a time: a sequence at full size takes gigabytes.
        truth = unit_srgb(task.load_truth())
        loaded = {method: _load_prediction(task, method, truth) for method in methods}
        truth_features = None if config.perceptual is None else config.perceptual.features(truth)
        is_valid = task.load_is_valid() if task.load_is_valid is not None else None
        classes = {} if task.load_classes is None else task.load_classes()
        for (method, is_exposed), factor in factors.items():
            predicted = loaded[method]
            predicted = expose(predicted, factor) if is_exposed else predicted
            # Learned distances are slow: raw images only.
            distance = None if is_exposed else partial(_distances, config, truth, truth_features)
            for region, one in _scores(predicted, truth, is_valid, classes, distance):
                scores.setdefault((method, region, is_exposed), {})[task.stem] = one
    for (method, region, is_exposed), by_stem in scores.items():
        yield FrameRow(
            tasks[0].condition,
            tasks[0].camera_name,
            method,
            region,
            is_exposed,
            factors[method, is_exposed],
            len(by_stem),
            _mean_scores(list(by_stem.values())),
            by_stem,
        )


def _sequence_exposure(tasks: Sequence[FrameTask], method: str) -> float:
    """Fit one exposure factor for a sequence on its valid pixels."""
    predicted, truths = [], []
    for task in tasks:
        truth = unit_srgb(task.load_truth())
        image = _load_prediction(task, method, truth)
        is_valid = np.ones(truth.shape[:2], bool)
        if task.load_is_valid is not None:
            is_valid = task.load_is_valid()
        # Every 7th pixel suffices for one number; 7 divides none of the usual image widths, so that
        # the pixels do not fall into a few columns.
        predicted.append(image[is_valid][::7])
        truths.append(truth[is_valid][::7])
    return fit_exposure(predicted, truths)


Distance = Callable[
    [Float32[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"] | None], tuple[float, ...]
]
"""(prediction, valid pixels) -> learned distances from the truth."""


def _scores(
    predicted: Float32[np.ndarray, "h w 3"],
    truth: Float32[np.ndarray, "h w 3"],
    is_valid: Bool[np.ndarray, "h w"] | None,
    classes: Mapping[Region, Bool[np.ndarray, "h w"]],
    distance: Distance | None,
) -> Iterator[tuple[Region, ImageScores]]:
    """Yield the scores of every region that the frame shows.

    A frame that is all sky has no masked score and does not enter the mean. The learned distance
    is measured in the region `masked` where there is a mask, else on the whole frame.
    """
    # One map serves `whole` and all classes; the region `masked` needs one of filled images.
    similarity = ssim_map(predicted, truth)
    distances = distance(predicted, None) if distance and is_valid is None else ()
    yield "whole", ImageScores(psnr(predicted, truth), mean_ssim(similarity), *distances)
    if is_valid is not None and is_valid[_INNER].any():
        distances = distance(predicted, is_valid) if distance else ()
        scores = psnr(predicted, truth, is_valid), ssim(predicted, truth, is_valid)
        yield "masked", ImageScores(*scores, *distances)
    for region, mask in classes.items():
        if mask[_INNER].any():
            # Windows reach across the class's border: classes are parts of one picture.
            yield region, ImageScores(psnr(predicted, truth, mask), mean_ssim(similarity, mask))


def _distances(
    config: FramesConfig,
    truth: Float32[np.ndarray, "h w 3"],
    truth_features: Any,
    predicted: Float32[np.ndarray, "h w 3"],
    is_valid: Bool[np.ndarray, "h w"] | None,
) -> tuple[float, ...]:
    """Return the learned distances of a prediction; empty where none are configured."""
    if config.perceptual is None:
        return ()
    filled = fill_invalid(predicted, truth, is_valid)
    return config.perceptual.distances(filled, truth_features, is_valid)


def _load_prediction(
    task: FrameTask, method: str, truth: Float32[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w 3"]:
    if method not in task.load_prediction_by_method:
        raise InputError(
            f"a frame lacks method '{method}'",
            where=f"{task.camera_name}/{task.stem}",
            got=", ".join(task.load_prediction_by_method),
            expected="the methods of the first frame of its camera",
        )
    image = task.load_prediction_by_method[method]()
    if image.shape != truth.shape:
        raise InputError(
            "a predicted frame has another size than its truth",
            where=f"{method}: {task.camera_name}/{task.stem}",
            got=f"{image.shape[1]}x{image.shape[0]} px",
            expected=f"{truth.shape[1]}x{truth.shape[0]} px",
            remedy="Relight at the image scale of the truth.",
        )
    return unit_srgb(image)


def unit_srgb(srgb8: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Return 8-bit sRGB as numbers in [0, 1]."""
    return srgb8.astype(np.float32) / np.float32(255)


def _mean_scores(scores: Sequence[ImageScores]) -> ImageScores:
    table = np.array([astuple(s) for s in scores], dtype=np.float64)
    return ImageScores(*table.mean(axis=0).tolist())
