"""Scores of predicted frames against true ones: per condition, camera, method and region."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import groupby
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from lightsim.errors import InputError
from lightsim.evaluate.metrics import ImageScores, expose, fill_invalid, fit_exposure, psnr, ssim
from lightsim.progress import Progress, SilentProgress
from lightsim.store.images import read_srgb8

LoadImage = Callable[[], UInt8[np.ndarray, "h w 3"]]
LoadMask = Callable[[], Bool[np.ndarray, "h w"]]
Baseline = Callable[
    [
        Float32[np.ndarray, "h w 3"],
        Float32[np.ndarray, "h w 3"],
        Bool[np.ndarray, "h w"] | None,
    ],
    Float32[np.ndarray, "h w 3"],
]
"""(source, truth, valid pixels or None) -> sRGB image in [0, 1]; see lightsim.baselines."""
Region = str
"""`whole` or `masked`: everywhere, or where the mask says that a pixel counts."""


@dataclass(frozen=True)
class FramesConfig:
    """What is measured."""

    with_lpips: bool = True
    """LPIPS of raw images, in the region `masked` where there is a mask; about one second per half
    megapixel and image on two cores."""
    with_exposure: bool = True
    """Also score with one exposure factor per sequence (condition, camera, method)."""


@dataclass(frozen=True, eq=False)
class FrameTask:
    """One true frame and what the methods made of it. Images are 8-bit sRGB.

    Args:
        condition: what is grouped in the table, such as the name of the target sky.
        load_prediction_by_method: each method's image of the size of the truth.
        load_is_valid: pixels that count in the region `masked`; None measures `whole` only.
    """

    condition: str
    camera_name: str
    stem: str
    load_truth: LoadImage
    load_prediction_by_method: Mapping[str, LoadImage]
    load_is_valid: LoadMask | None = None


@dataclass(frozen=True)
class FrameRow:
    """Mean scores over the frames of one sequence. The exposure factor of raw rows is 1."""

    condition: str
    camera_name: str
    method: str
    region: Region
    is_exposed: bool
    exposure_factor: float
    count: int
    scores: ImageScores


@dataclass(frozen=True)
class FramesReport:
    """All rows, in the order of the tasks."""

    rows: tuple[FrameRow, ...]

    def mean(
        self, condition: str, method: str, region: Region, is_exposed: bool = False
    ) -> ImageScores:
        """Mean over all frames of all cameras of a condition.

        Raises:
            InputError: nothing was measured under these names.
        """
        rows = [
            row
            for row in self.rows
            if (row.condition, row.method, row.region, row.is_exposed)
            == (condition, method, region, is_exposed)
        ]
        if not rows:
            raise InputError(
                "no such row in the report",
                got=(condition, method, region, is_exposed),
                expected=f"conditions {self.conditions}, methods {self.methods}",
            )
        weights = np.array([row.count for row in rows], dtype=np.float64)
        table = np.array([(r.scores.psnr_db, r.scores.ssim, r.scores.lpips) for r in rows])
        psnr_db, similarity, distance = (table * weights[:, None]).sum(0) / weights.sum()
        return ImageScores(float(psnr_db), float(similarity), float(distance))

    @property
    def conditions(self) -> tuple[str, ...]:
        """Each condition once, in the order of the rows."""
        return tuple(dict.fromkeys(row.condition for row in self.rows))

    @property
    def methods(self) -> tuple[str, ...]:
        """Each method once, in the order of the rows."""
        return tuple(dict.fromkeys(row.method for row in self.rows))

    def to_table(self) -> str:
        """Markdown: a line per condition, region, exposure and method, all cameras together."""
        keys = dict.fromkeys(
            (row.condition, row.region, row.is_exposed, row.method) for row in self.rows
        )
        lines = [
            "| condition | region | exposure | method | PSNR dB | SSIM | LPIPS |",
            "|---|---|---|---|---:|---:|---:|",
        ]
        for condition, region, is_exposed, method in sorted(keys, key=lambda k: k[:3]):
            s = self.mean(condition, method, region, is_exposed)
            exposure = "fitted" if is_exposed else "raw"
            distance = "-" if np.isnan(s.lpips) else f"{s.lpips:.3f}"
            lines.append(
                f"| {condition} | {region} | {exposure} | {method} "
                f"| {s.psnr_db:.2f} | {s.ssim:.3f} | {distance} |"
            )
        return "\n".join(lines)

    def to_json(self) -> str:
        """All rows, cameras apart; scores without a value are null."""
        rows = [asdict(row) for row in self.rows]
        for row in rows:
            row["scores"] = {k: _finite_or_none(v) for k, v in row["scores"].items()}
        return json.dumps({"rows": rows}, indent=2, allow_nan=False)


def score_frames(
    tasks: Sequence[FrameTask],
    config: FramesConfig,
    *,
    progress: Progress | None = None,
) -> FramesReport:
    """Scores of every sequence; frames are loaded one by one, twice if exposure is fitted.

    Raises:
        InputError: there is nothing to score, or an image has another size than its truth.
    """
    if not tasks:
        raise InputError(
            "there are no frames to score", expected="one frame or more with its truth"
        )
    progress = progress or SilentProgress()
    ordered = sorted(tasks, key=_sequence_key)
    rows: list[FrameRow] = []
    groups = [list(group) for _, group in groupby(ordered, key=_sequence_key)]
    for group in progress.track(groups, "score sequences"):
        rows.extend(_score_sequence(group, config))
    return FramesReport(tuple(rows))


def _sequence_key(task: FrameTask) -> tuple[str, str]:
    return task.condition, task.camera_name


def _score_sequence(tasks: Sequence[FrameTask], config: FramesConfig) -> Iterator[FrameRow]:
    """Rows of one condition and camera."""
    methods = tuple(tasks[0].load_prediction_by_method)
    factors = {(method, False): 1.0 for method in methods}
    if config.with_exposure:
        factors |= {(method, True): _sequence_exposure(tasks, method) for method in methods}
    scores: dict[tuple[str, Region, bool], list[ImageScores]] = {}
    for task in tasks:
        truth = _unit(task.load_truth())
        loaded = {method: _load_prediction(task, method, truth) for method in methods}
        truth_features = _features(truth, config)
        for region, is_valid in _regions(task):
            for (method, is_exposed), factor in factors.items():
                predicted = loaded[method]
                predicted = expose(predicted, factor) if is_exposed else predicted
                # LPIPS is slow: asked for raw images only, and where a mask says what counts,
                # for what counts only.
                is_extra = is_exposed or (region == "whole" and task.load_is_valid is not None)
                features = None if is_extra else truth_features
                one = _score(predicted, truth, is_valid, features)
                scores.setdefault((method, region, is_exposed), []).append(one)
    for (method, region, is_exposed), list_of_scores in scores.items():
        yield FrameRow(
            tasks[0].condition,
            tasks[0].camera_name,
            method,
            region,
            is_exposed,
            factors[method, is_exposed],
            len(list_of_scores),
            _mean_scores(list_of_scores),
        )


def _sequence_exposure(tasks: Sequence[FrameTask], method: str) -> float:
    """Fitted on the pixels that count (all of them where there is no mask)."""
    predicted, truths = [], []
    for task in tasks:
        truth = _unit(task.load_truth())
        image = _load_prediction(task, method, truth)
        is_valid = np.ones(truth.shape[:2], bool)
        if task.load_is_valid is not None:
            is_valid = task.load_is_valid()
        # Every 7th pixel is plenty for one number, and coprime with image widths.
        predicted.append(image[is_valid][::7])
        truths.append(truth[is_valid][::7])
    return fit_exposure(predicted, truths)


def _regions(task: FrameTask) -> Iterator[tuple[Region, Bool[np.ndarray, "h w"] | None]]:
    if task.load_is_valid is not None:
        is_valid = task.load_is_valid()
        # A frame that is all sky has no masked score, and takes no part in the mean.
        if is_valid.any():
            yield "masked", is_valid
    yield "whole", None


def _score(
    predicted: Float32[np.ndarray, "h w 3"],
    truth: Float32[np.ndarray, "h w 3"],
    is_valid: Bool[np.ndarray, "h w"] | None,
    truth_features: list | None,
) -> ImageScores:
    distance = float("nan")
    if truth_features is not None:
        from lightsim.evaluate.lpips import lpips_features, lpips_of_features

        filled = fill_invalid(predicted, truth, is_valid)
        distance = lpips_of_features(lpips_features(filled), truth_features, is_valid)
    return ImageScores(psnr(predicted, truth, is_valid), ssim(predicted, truth, is_valid), distance)


def _features(truth: Float32[np.ndarray, "h w 3"], config: FramesConfig) -> list | None:
    if not config.with_lpips:
        return None
    from lightsim.evaluate.lpips import lpips_features

    return lpips_features(truth)


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
    return _unit(image)


def _unit(srgb8: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    return srgb8.astype(np.float32) / np.float32(255)


def _mean_scores(scores: Sequence[ImageScores]) -> ImageScores:
    table = np.array([(s.psnr_db, s.ssim, s.lpips) for s in scores], dtype=np.float64)
    return ImageScores(*(float(value) for value in table.mean(axis=0)))


def _finite_or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None


def folder_tasks(
    condition: str,
    method: str,
    folders: Mapping[str, Path],
    is_valid: Callable[[str, str], Bool[np.ndarray, "h w"]] | None = None,
    baselines: Mapping[str, Baseline] | None = None,
) -> list[FrameTask]:
    """What there is to score in folders of frames (<camera>/<frame>.png).

    Args:
        method: what made the frames of the folder "predicted"; compared with those of "truth".
        is_valid: (camera, frame stem) -> pixels that count; all where it is None.
        baselines: (source, truth, valid pixels) -> image, by name; need the folder "source".

    Raises:
        InputError: a folder or all its frames are missing.
    """
    tasks = []
    for camera, stem, files in _pair_folders(folders):
        load = {name: partial(read_srgb8, path) for name, path in files.items()}
        valid = None if is_valid is None else partial(is_valid, camera, stem)
        methods: dict[str, LoadImage] = {method: load["predicted"]}
        for name, baseline in (baselines or {}).items():
            methods[name] = partial(_apply_baseline, baseline, load["source"], load["truth"], valid)
        tasks.append(FrameTask(condition, camera, stem, load["truth"], methods, valid))
    return tasks


def _pair_folders(folders: Mapping[str, Path]) -> list[tuple[str, str, dict[str, Path]]]:
    """(camera, stem, file by folder name) of all <camera>/<stem>.<png|jpg> that every folder has.

    Raises:
        InputError: a folder is missing, or they share no frame.
    """
    found = {name: _images_under(folder) for name, folder in folders.items()}
    shared = set.intersection(*(set(files) for files in found.values()))
    if not shared:
        raise InputError(
            "the folders share no frame",
            where=", ".join(str(folder) for folder in folders.values()),
            expected="<camera>/<frame>.png or .jpg with equal names",
        )
    return [
        (camera, stem, {name: files[camera, stem] for name, files in found.items()})
        for camera, stem in sorted(shared)
    ]


def _images_under(folder: Path) -> dict[tuple[str, str], Path]:
    if not folder.is_dir():
        raise InputError(
            "no such folder of frames", where=folder, expected="<camera>/<frame>.png or .jpg in it"
        )
    suffixes = {".png", ".jpg", ".jpeg"}
    paths = sorted(p for p in folder.glob("*/*") if p.suffix.lower() in suffixes)
    return {(path.parent.name, path.stem): path for path in paths}


def _apply_baseline(
    baseline: Baseline,
    load_source: LoadImage,
    load_truth: LoadImage,
    load_is_valid: LoadMask | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """What a baseline makes of the source frame, in 8 bits like every other method."""
    is_valid = load_is_valid() if load_is_valid is not None else None
    if is_valid is not None and not is_valid.any():
        is_valid = None
    made = baseline(_unit(load_source()), _unit(load_truth()), is_valid)
    return np.round(np.clip(made, 0.0, 1.0) * 255.0).astype(np.uint8)
