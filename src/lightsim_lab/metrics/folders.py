"""Scoring tasks from folders of frames (<camera>/<frame>.png)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from lightsim.build.quality.frame_report import Region
from lightsim.build.quality.frames import FrameTask, LoadImage, LoadMask, unit_srgb
from lightsim.errors import InputError
from lightsim.store.images import read_srgb8

# Arguments: source, truth, valid pixels or None (all). Result: sRGB image in [0, 1].
Baseline = Callable[
    [
        Float32[np.ndarray, "h w 3"],
        Float32[np.ndarray, "h w 3"],
        Bool[np.ndarray, "h w"] | None,
    ],
    Float32[np.ndarray, "h w 3"],
]


def folder_tasks(
    condition: str,
    methods: Sequence[str],
    folders: Mapping[str, Path],
    is_valid: Callable[[str, str], Bool[np.ndarray, "h w"]] | None = None,
    baselines: Mapping[str, Baseline] | None = None,
    load_classes: Callable[[str, str], Mapping[Region, Bool[np.ndarray, "h w"]]] | None = None,
) -> list[FrameTask]:
    """Return the scoring tasks of folders of frames (<camera>/<frame>.png).

    Args:
        methods: names of the folders that are compared with "truth".
        is_valid: (camera, frame stem) -> mask of scored pixels; None: all pixels.
        baselines: functions by name; they require the folder "source".
        load_classes: (camera, frame stem) -> masks of further regions.

    Raises:
        InputError: a folder or all its frames are missing.
    """
    tasks = []
    for camera, stem, files in pair_folders(folders):
        load = {name: partial(read_srgb8, path) for name, path in files.items()}
        valid = None if is_valid is None else partial(is_valid, camera, stem)
        shown: dict[str, LoadImage] = {method: load[method] for method in methods}
        for name, baseline in (baselines or {}).items():
            shown[name] = partial(_apply_baseline, baseline, load["source"], load["truth"], valid)
        classes = None if load_classes is None else partial(load_classes, camera, stem)
        tasks.append(FrameTask(condition, camera, stem, load["truth"], shown, valid, classes))
    return tasks


def pair_folders(folders: Mapping[str, Path]) -> list[tuple[str, str, dict[str, Path]]]:
    """Return (camera, stem, file by folder name) of the frames that all folders contain.

    Raises:
        InputError: a folder is missing, or the folders have no frame in common.
    """
    found = {name: _images_under(folder) for name, folder in folders.items()}
    common = set.intersection(*(set(files) for files in found.values()))
    if not common:
        raise InputError(
            "the folders have no frame in common",
            where=", ".join(str(folder) for folder in folders.values()),
            expected="<camera>/<frame>.png or .jpg with equal names",
        )
    return [
        (camera, stem, {name: files[camera, stem] for name, files in found.items()})
        for camera, stem in sorted(common)
    ]


def _images_under(folder: Path) -> dict[tuple[str, str], Path]:
    if not folder.is_dir():
        raise InputError(
            "the folder of frames does not exist",
            where=folder,
            expected="a folder with <camera>/<frame>.png or .jpg",
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
    """Apply a baseline to the source frame, in 8 bits like every other method."""
    is_valid = load_is_valid() if load_is_valid is not None else None
    # A fit needs pixels; a frame without valid pixels is fitted on all and scored on none.
    if is_valid is not None and not is_valid.any():
        is_valid = None
    made = baseline(unit_srgb(load_source()), unit_srgb(load_truth()), is_valid)
    return np.round(np.clip(made, 0.0, 1.0) * 255.0).astype(np.uint8)
