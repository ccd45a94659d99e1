"""Pictures of KITTI and KITTI-360: of one size, which the calibration states."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from lightsim.core.frames import RigidTransform
from lightsim.datasets.kitti.text import read_times_ns, stamped_files
from lightsim.datasets.layout import has_file, has_folder
from lightsim.datasets.lenses import Lens
from lightsim.datasets.pictures import image_size
from lightsim.datasets.recorded import RecordedCamera, RecordedPicture
from lightsim.errors import InputError
from lightsim.store.images import read_srgb8

_SUFFIXES = (".png", ".jpg", ".jpeg")
MAX_PIXELS = 8_000_000
"""Most pixels of a picture: four times those of KITTI-360's fisheyes."""


def read_camera(
    folder: Path, data: str, lens: Lens, ego_from_camera: RigidTransform
) -> tuple[RecordedCamera, list[str]]:
    """Return the camera of a folder image_0x, and notes; without the folder it has no pictures.

    Shutters are global, of 2 ms at most, and triggered by the scanner (Geiger et al. 2013).

    Args:
        data: name of the folder of its pictures.

    Raises:
        InputError: the first picture does not have the size of the lens.
    """
    name, times = folder.name, folder / "timestamps.txt"
    if not has_folder(folder):
        return RecordedCamera(name, lens, ego_from_camera, ()), [f"{name}: no such folder"]
    times_ns = read_times_ns(times) if has_file(times) else {}
    files, notes = stamped_files(folder / data, _SUFFIXES, times_ns, name)
    if files:
        _check_size(files[0].path, lens)
    pictures = tuple(
        RecordedPicture(file.time_ns, file.path, partial(_load, file.path, lens)) for file in files
    )
    return RecordedCamera(name, lens, ego_from_camera, pictures), notes


def _check_size(path: Path, lens: Lens) -> None:
    size, expected = image_size(path), (lens.width_px, lens.height_px)
    if size != expected:
        raise InputError(
            "the picture's size differs from the calibration's",
            where=path,
            got=f"{size[0]}x{size[1]} px",
            expected=f"{expected[0]}x{expected[1]} px",
            remedy="Use the rectified (_sync) drive, and the calibration of its date.",
        )


def _load(path: Path, lens: Lens) -> UInt8[np.ndarray, "h w 3"]:
    _check_size(path, lens)
    return read_srgb8(path)


def check_pixels(size_px: Float64[np.ndarray, "2"], where: object) -> tuple[int, int]:
    """Return width and height of pictures as integers.

    Raises:
        InputError: it is not positive or too large.
    """
    width_px, height_px = size_px.tolist()
    if not (min(width_px, height_px) >= 1 and width_px * height_px <= MAX_PIXELS):
        raise InputError(
            "the size of the pictures is out of range",
            where=where,
            got=f"{width_px:g}x{height_px:g} px",
            expected=f"at least 1x1 and at most {MAX_PIXELS} pixels",
        )
    return round(width_px), round(height_px)
