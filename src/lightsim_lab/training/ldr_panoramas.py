"""LDR panoramas of streets, without known light; they train the inpainting (paper: HoliCity)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from lightsim.core.colour import linear_from_srgb8, srgb8_from_linear
from lightsim.core.resample import resize_area
from lightsim.errors import InputError
from lightsim.progress import Progress, SilentProgress
from lightsim.store.images import read_srgb8
from lightsim_lab.training.hdr_skies import Side, SplitEntry

_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")


@dataclass(frozen=True, eq=False)
class LdrPanorama:
    """Complete panorama (row 0 is up) and its side of the split."""

    side: Side
    srgb8: UInt8[np.ndarray, "h w 3"]


def read_ldr_pool(
    folder: Path,
    split: Mapping[str, SplitEntry] | None,
    height_px: int,
    progress: Progress | None = None,
) -> tuple[LdrPanorama, ...]:
    """Read the panoramas of a folder and its subfolders; those without a line in the split train.

    Raises:
        InputError: there is no panorama, or one is not twice as wide as high.
    """
    paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in _SUFFIXES)
    if not paths:
        raise InputError(
            "the folder contains no images",
            where=folder,
            expected=f"files {', '.join(_SUFFIXES)}",
            remedy="Give the folder with the panoramas as --ldr.",
        )
    found = []
    for path in (progress or SilentProgress()).track(paths, "LDR panoramas"):
        entry = None if split is None else split.get(path.stem)
        side = "train" if entry is None else entry.split
        if side != "out":
            found.append(LdrPanorama(side, _read(path, height_px)))
    return tuple(found)


def _read(path: Path, height_px: int) -> UInt8[np.ndarray, "h w 3"]:
    picture = read_srgb8(path)
    height, width = picture.shape[:2]
    if width != 2 * height:
        raise InputError(
            "a panorama must be twice as wide as high",
            where=path,
            got=f"{width}x{height} px",
            expected=f"{2 * height}x{height} px",
        )
    # Resized in linear light, so that mean radiances are preserved.
    return srgb8_from_linear(resize_area(linear_from_srgb8(picture), height_px, 2 * height_px))
