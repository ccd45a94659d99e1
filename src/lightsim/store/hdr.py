"""Reader of linear HDR pictures (Radiance .hdr, OpenEXR) and of panoramas for sky domes."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from lightsim.core.primaries import (
    SRGB,
    Primaries,
    are_srgb,
    name_of_primaries,
    srgb_from_primaries,
)
from lightsim.core.resample import resize_area
from lightsim.errors import InputError
from lightsim.store.exr import read_number
from lightsim.store.exr_file import EXR_MAGIC
from lightsim.store.exr_picture import read_exr_picture, unusable_primaries
from lightsim.store.foreign import foreign_content
from lightsim.store.radiance import decode_radiance
from lightsim.store.radiance_header import is_radiance, read_header
from lightsim.store.reading import MAX_PICTURE_BYTES, open_regular, read_bytes

_LOGGER = logging.getLogger(__name__)
HEADING = "headingDeg"
"""Attribute of a dome's EXR header: azimuth of world +x, in degrees clockwise from true north."""
# Largest number of rows of a sky. Its pixels have 0.09 degrees, so the sun spans six of them, and
# the later steps need some hundred bytes per pixel.
_MAX_SKY_ROWS = 2048
# Largest relative deviation of width from twice the height that is resampled. Chosen; sensitivity
# not measured.
_ASPECT_TOLERANCE = 0.02
# Largest negative light, as a fraction of the positive light, that is clipped: rounding and
# resampling filters cause some 0.1 %, wrong primaries or subtraction more.
_NEGATIVE_TOLERANCE = 0.01
# Values this close to the largest one are equal: codes of .hdr files have 7 bits or more.
_SAME_VALUE = 0.995
# Fractions of the sphere that the largest value covers in a clipped picture. The sun's disc covers
# 5e-6; in 69 measured panoramas the largest value covers 3e-5 at most. A uniform dome is not
# clipped. Fewer pixels than `_CLIPPED_PX` may be a sun that was drawn into a small picture.
_CLIPPED = (1e-4, 0.5)
_CLIPPED_PX = 16
# Number of rows that are converted at once: 12 MB as floats in a panorama of 4096 columns.
_ROWS_AT_ONCE = 256
# First bytes of PNG, JPEG, WebP, GIF and BMP.
_LDR_MAGIC = (b"\x89PNG", b"\xff\xd8\xff", b"RIFF", b"GIF8", b"BM")


@dataclass(frozen=True, eq=False)
class SkyFile:
    """Radiance of a sky file in the form that SkyDome requires.

    Args:
        radiance: linear sRGB in units of the file, non-negative and finite, twice as wide as high.
        notes: choices and changes made by the reader; empty if there were none.
        heading_deg: azimuth of the file's +x, degrees clockwise from true north; None if unknown.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    notes: tuple[str, ...]
    heading_deg: float | None


def read_hdr(path: Path) -> Float32[np.ndarray, "h w 3"]:
    """Return linear sRGB of a .hdr or .exr picture, row 0 at the top.

    The content decides the format, not the suffix. Grey is repeated in three channels, alpha is
    ignored. Negative values are returned unchanged.

    Raises:
        InputError: the file is missing, damaged, truncated, of another kind, or has NaN or inf.
    """
    pixels, primaries = _decode(path, "", None, [])
    return _in_srgb(path, pixels, primaries)


def read_sky(path: Path, layer: str = "", is_logged: bool = True) -> SkyFile:
    """Return the radiance of a .hdr or .exr sky in the form that SkyDome requires, with notes.

    Colours are converted from the file's primaries to linear sRGB. A picture of more than 2048 rows
    is averaged over squares of pixels. Negative values are clipped if they sum to less than 1 % of
    the light. A width within 2 % of twice the height is resampled to it.

    Args:
        layer: name of a layer of an OpenEXR file; empty selects the finished picture.
        is_logged: log each note as a warning.

    Raises:
        InputError: as `read_hdr`; or the picture is not about twice as wide as high, is black, or
            has too much negative light.
    """
    notes: list[str] = []
    radiance, primaries = _decode(path, layer, _MAX_SKY_ROWS, notes)
    _check_aspect(path, *radiance.shape[:2])
    # Negative values are checked before the conversion, after which colours outside sRGB have some.
    radiance = _clip_negatives(path, radiance, notes)
    if not (radiance > 0).any():
        raise InputError(
            "the sky is black everywhere", where=path, remedy="Export it again with its light."
        )
    _note_clipped(radiance, notes)
    if not are_srgb(primaries):
        radiance = _in_srgb(path, radiance, primaries)
        notes.append(f"converted from {name_of_primaries(primaries)} to linear sRGB")
        radiance = _clip_out_of_gamut(radiance, notes)
    radiance = _fit_aspect(radiance, notes)
    if is_logged:
        for note in notes:
            _LOGGER.warning("%s: %s", path, note)
    return SkyFile(radiance, tuple(notes), read_number(path, HEADING))


def _decode(
    path: Path, layer: str, most_rows: int | None, notes: list[str]
) -> tuple[Float32[np.ndarray, "h w 3"], Primaries]:
    """Return finite pixels as stored, reduced to at most `most_rows` rows, and their primaries."""
    with open_regular(path, "picture", MAX_PICTURE_BYTES) as handle:
        # Enough to identify the format: headers of Radiance's oldest programs have a few lines.
        start = handle.read(4096)
    if start.startswith(EXR_MAGIC):
        image, primaries = read_exr_picture(path, layer, notes)
        height, width = image.shape[:2]
        factor = _reduction(path, height, width, most_rows, notes)
        if factor > 1:
            image = resize_area(image, height // factor, width // factor)
        return _finite(path, image), primaries
    if not is_radiance(start):
        raise _other_kind(path, start)
    if layer:
        raise InputError(
            "a Radiance picture has no layers", where=path, got=layer, remedy="Leave #LAYER out."
        )
    data = read_bytes(path, "picture", MAX_PICTURE_BYTES)
    try:
        header = read_header(data)
        notes += header.notes
        factor = _reduction(path, header.height, header.width, most_rows, notes)
        image = decode_radiance(data, factor)
    except InputError as error:
        raise error.at(path) from error
    return _finite(path, image), header.primaries or SRGB


def _other_kind(path: Path, start: bytes) -> InputError:
    got, remedy = foreign_content(start) or (
        f"a file that starts with {start[:8]!r}",
        "Convert the panorama to .exr or .hdr.",
    )
    if start.startswith(_LDR_MAGIC):
        remedy = (
            "An LDR picture holds too little light: export the panorama as .exr or .hdr, or (8-bit"
            f" PNG, JPEG, WebP) estimate its sky with `lightsim sky estimate {path.name} --out DIR`"
            " and give DIR/sky.exr."
        )
    return InputError(
        "not an HDR picture",
        where=path,
        got=got,
        expected="Radiance .hdr or OpenEXR .exr",
        remedy=remedy,
    )


def _finite(path: Path, image: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    bad = image.size - sum(int(np.isfinite(row).sum()) for row in image)
    if bad:
        raise InputError(
            "the picture has NaN or infinite values",
            where=path,
            got=f"{bad} of {image.size}",
            remedy="Replace them by finite values in an image editor.",
        )
    return image


def _in_srgb(
    path: Path, pixels: Float32[np.ndarray, "h w 3"], primaries: Primaries
) -> Float32[np.ndarray, "h w 3"]:
    """Convert colours to linear sRGB; colours in sRGB primaries are returned unchanged."""
    try:
        if are_srgb(primaries):
            return pixels
        matrix = srgb_from_primaries(primaries).T
    except ValueError as error:
        raise unusable_primaries(path, error) from error
    converted = np.empty_like(pixels)
    for row in range(0, len(pixels), _ROWS_AT_ONCE):
        part = slice(row, row + _ROWS_AT_ONCE)
        with np.errstate(over="ignore", invalid="ignore"):
            converted[part] = pixels[part] @ matrix
    return _finite(path, converted)


def _clip_negatives(
    path: Path, radiance: Float32[np.ndarray, "h w 3"], notes: list[str]
) -> Float32[np.ndarray, "h w 3"]:
    count, negative, positive = _negatives(radiance)
    if not count:
        return radiance
    if negative > _NEGATIVE_TOLERANCE * positive:
        raise InputError(
            "the sky has negative radiance",
            where=path,
            got=f"{count} values that sum to {-negative:.3g} against {positive:.3g} of light",
            expected=f"at most {_NEGATIVE_TOLERANCE:.0%} of the light",
            remedy="Convert it to linear sRGB primaries and clip it at zero; resize it by averages,"
            " since sharp filters undershoot around the sun.",
        )
    notes.append(f"clipped {count} negative values ({negative / positive:.2g} of the light)")
    return np.maximum(radiance, np.float32(0.0))


def _note_clipped(radiance: Float32[np.ndarray, "h w 3"], notes: list[str]) -> None:
    """Note a largest value that covers more than the sun, as in 8-bit pictures saved as .hdr."""
    largest = radiance.max(axis=(0, 1))
    is_largest = (radiance >= _SAME_VALUE * largest).all(axis=2)
    height, width = is_largest.shape
    # The mean height of the sphere's rows is 2 / pi.
    weight = np.sin(np.pi * (np.arange(height) + 0.5) / height) * np.pi / (2 * height * width)
    part = float(weight @ is_largest.sum(axis=1))
    if is_largest.sum() >= _CLIPPED_PX and _CLIPPED[0] < part < _CLIPPED[1]:
        notes.append(
            f"the largest value, {largest.max():.3g}, covers {part:.2%} of the sphere: if it is"
            " clipped, the sun is too dark; lightsim sky estimate makes skies of LDR pictures"
        )


def _clip_out_of_gamut(
    radiance: Float32[np.ndarray, "h w 3"], notes: list[str]
) -> Float32[np.ndarray, "h w 3"]:
    """Clip negative components, which colours outside the sRGB gamut have, to 0."""
    count, negative, positive = _negatives(radiance)
    if not count:
        return radiance
    fraction = negative / max(positive, np.finfo(np.float64).tiny)
    notes.append(f"clipped {count} values of colours outside sRGB ({fraction:.2g} of the light)")
    return np.maximum(radiance, np.float32(0.0))


def _negatives(radiance: Float32[np.ndarray, "h w 3"]) -> tuple[int, float, float]:
    """Return the number of negative values, the absolute of their sum, and the positive sum."""
    count = int((radiance < 0).sum())
    if not count:
        return 0, 0.0, 0.0
    negative = -float(np.minimum(radiance, 0).sum(dtype=np.float64))
    return count, negative, float(np.maximum(radiance, 0).sum(dtype=np.float64))


def _check_aspect(path: Path, height: int, width: int) -> None:
    if height < 2 or abs(width / (2 * height) - 1) > _ASPECT_TOLERANCE:
        raise InputError(
            "a sky must be a full equirectangular panorama, twice as wide as high",
            where=path,
            got=f"{width}x{height} px",
            remedy="Convert light probes, cube maps or cropped panoramas to equirectangular; of two"
            " views in one picture keep one.",
        )


def _fit_aspect(
    radiance: Float32[np.ndarray, "h w 3"], notes: list[str]
) -> Float32[np.ndarray, "h v 3"]:
    height, width = radiance.shape[:2]
    if width == 2 * height:
        return radiance
    notes.append(f"resampled from {width}x{height} to {2 * height}x{height} px")
    # Bilinear in longitude; columns wrap around.
    position = (np.arange(2 * height) + 0.5) * width / (2 * height) - 0.5
    left = np.floor(position).astype(np.int64)
    part = (position - left).astype(np.float32)[None, :, None]
    mixed = radiance[:, left % width] * (1 - part) + radiance[:, (left + 1) % width] * part
    return mixed.astype(np.float32)


def _reduction(path: Path, height: int, width: int, most_rows: int | None, notes: list[str]) -> int:
    """Return the edge, in pixels, of the squares that are averaged to one pixel."""
    if most_rows is None or height <= most_rows:
        return 1
    # The smallest common divisor of both sides that suffices, but not a far smaller picture.
    least = -(-height // most_rows)
    for factor in range(least, 4 * least + 1):
        if height % factor == 0 and width % factor == 0:
            notes.append(
                f"reduced from {width}x{height} to {width // factor}x{height // factor} px"
            )
            return factor
    raise InputError(
        "the sky is too large, and its sides have no common factor to reduce it by",
        where=path,
        got=f"{width}x{height} px",
        expected=f"at most {most_rows} rows, or a multiple of them",
        remedy="Resize it to 4096x2048 px.",
    )
