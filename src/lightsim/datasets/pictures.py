"""Recorded pictures: size and pixels, of formats and sizes that cameras have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from lightsim.errors import InputError
from lightsim.store.images import read_orientation, read_size, read_srgb8
from lightsim.store.reading import is_file

MAX_PIXELS = 80_000_000
"""Largest picture, in pixels: more than any vehicle camera; bounds the memory of twelve
pictures."""
# Accepted formats. Other decoders of Pillow run programs (EPS) or are poorly maintained.
_FORMATS = ("JPEG", "PNG")
# Accepted pixel formats: grey or RGB of 8 bits.
_MODES = ("L", "RGB")
# Largest ratio of the longer to the shorter side; the widest vehicle cameras crop to 3 to 1.
_MAX_ASPECT = 8


def load_image(path: Path, width_px: int, height_px: int) -> UInt8[np.ndarray, "h w 3"]:
    """Load a picture as 8-bit sRGB.

    Raises:
        InputError: it is damaged, or its size has changed.
    """
    if read_size(path, _FORMATS, _MODES) != (width_px, height_px):
        raise InputError(
            "the picture changed its size since the log was read",
            where=path,
            expected=f"{width_px}x{height_px} px",
        )
    return read_srgb8(path)


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of a picture, from its header.

    Raises:
        InputError: it cannot be read, is too large, or too wide or high for a camera.
    """
    size = read_size(path, _FORMATS, _MODES)
    orientation = read_orientation(path)
    if orientation != 1:
        raise InputError(
            "the picture is marked as turned or mirrored",
            where=path,
            got=f"EXIF orientation {orientation}",
            expected="pixels in the order that the intrinsics describe, without this mark",
            remedy="If the intrinsics are of the pixels as stored, remove it: exiftool"
            " -Orientation= FILE; if of the turned picture: mogrify -auto-orient FILE.",
        )
    if size[0] * size[1] > MAX_PIXELS:
        raise InputError(
            "the picture is too large",
            where=path,
            got=f"{size[0]}x{size[1]} px",
            expected=f"at most {MAX_PIXELS} pixels",
        )
    if max(size) > _MAX_ASPECT * min(size):
        raise InputError(
            "the picture's aspect ratio is too large for a camera",
            where=path,
            got=f"{size[0]}x{size[1]} px",
            expected=f"at most {_MAX_ASPECT} to 1",
        )
    return size


def stored_picture(path: Path) -> Path:
    """Return the file of a picture that a table names, or one beside it that was converted to
    another format, or whose suffix has another case."""
    if is_file(path):
        return path
    others = (path.with_suffix(s) for s in (".jpg", ".png", ".jpeg", ".JPG", ".PNG", ".JPEG"))
    return next(filter(is_file, others), path)


def check_size(path: Path, size_px: tuple[int, int], expected_by: str) -> None:
    """Check the size of a picture, from its header.

    Args:
        expected_by: source of the expected size, in words.

    Raises:
        InputError: it differs, or as `image_size`.
    """
    found = image_size(path)
    if found != size_px:
        raise InputError(
            f"the picture's size differs from {expected_by}",
            where=path,
            got=f"{found[0]}x{found[1]} px",
            expected=f"{size_px[0]}x{size_px[1]} px",
        )
