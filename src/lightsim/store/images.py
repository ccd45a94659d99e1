"""Pictures on disk: 8-bit sRGB (PNG, JPEG) and linear HDR (Radiance .hdr, OpenEXR)."""

from __future__ import annotations

import io
import logging
import struct
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt16

from lightsim.core.resample import resize_area
from lightsim.errors import InputError
from lightsim.store.atomic import whole_file
from lightsim.store.exr import EXR_MAGIC, read_exr, write_exr
from lightsim.store.radiance import decode_radiance, encode_radiance, radiance_size
from lightsim.store.reading import MAX_PICTURE_BYTES, open_regular, read_bytes

__all__ = [
    "SkyFile",
    "decode_texture",
    "read_exr",
    "read_grey8",
    "read_grey8_alpha",
    "read_hdr",
    "read_size",
    "read_sky",
    "read_srgb8",
    "read_srgb8_alpha",
    "write_exr",
    "write_hdr",
    "write_jpeg",
    "write_png",
]
_LOGGER = logging.getLogger(__name__)
_READABLE = ("PNG", "JPEG", "WEBP")
_TEXTURES = (*_READABLE, "BMP", "TGA")
_EIGHT_BIT_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr")
_PIL_ERRORS = (OSError, ValueError, SyntaxError, EOFError, LookupError, TypeError, struct.error)
_MAX_PIXELS = 1 << 27
"""A 16k panorama, 16384x8192; decoded by Pillow it takes a gigabyte."""
_MAX_BYTES = 512 << 20
"""As many pixels, stored without compression."""
_MAX_SKY_ROWS = 2048
"""Pixels of 0.09 degrees: a sun spans six, and what follows holds some hundred bytes a pixel."""
_ASPECT_TOLERANCE = 0.02
_PNG_END = b"IEND\xaeB`\x82"
"""Type and check sum of a PNG's last chunk."""
_PNG_DEPTH_AT = 24
"""Of the byte in a PNG file that holds the bits of a channel (ISO 15948, 11.2.2)."""
_NEGATIVE_TOLERANCE = 0.01


@dataclass(frozen=True, eq=False)
class SkyFile:
    """Radiance of a sky file, fit for a SkyDome.

    Args:
        radiance: linear RGB as stored in the file, non-negative and finite, exactly 2:1.
        notes: what was changed on the way in, one sentence each; empty for a clean file.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    notes: tuple[str, ...]


def read_srgb8(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """8-bit sRGB of a PNG, JPEG or WebP picture; grey is repeated, alpha is dropped.

    Raises:
        InputError: the file is missing, damaged, truncated, or not 8 bits a channel.
    """
    return _read_pil(path, "RGB")


def read_srgb8_alpha(
    path: Path,
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """8-bit sRGB, and alpha (255 everywhere in a picture without alpha).

    Raises:
        InputError: as `read_srgb8`.
    """
    rgba = _read_pil(path, "RGBA")
    return np.ascontiguousarray(rgba[..., :3]), np.ascontiguousarray(rgba[..., 3])


def read_grey8(path: Path) -> UInt8[np.ndarray, "h w"]:
    """8-bit grey of a picture (masks).

    Raises:
        InputError: as `read_srgb8`.
    """
    return _read_pil(path, "L")


def read_grey8_alpha(path: Path) -> UInt8[np.ndarray, "h w 2"]:
    """8-bit grey and alpha (255 everywhere in a picture without alpha).

    Raises:
        InputError: as `read_srgb8`.
    """
    return _read_pil(path, "LA")


def write_png(path: Path, picture: UInt8[np.ndarray, "h w *c"]) -> None:
    """Write a PNG of 8-bit grey [h, w] or sRGB [h, w, 3]; with alpha last [h, w, 2 or 4]."""
    _write_pil(path, picture, "PNG", compress_level=4)


def write_png16(path: Path, numbers: UInt16[np.ndarray, "h w"]) -> None:
    """Write a PNG of whole numbers, 16 bit grey: a mask of ids."""
    _write_pil(path, numbers, "PNG", compress_level=4)


def write_jpeg(path: Path, srgb8: UInt8[np.ndarray, "h w 3"], quality: int = 92) -> None:
    """Write a JPEG of 8-bit sRGB, without chroma subsampling."""
    _write_pil(path, srgb8, "JPEG", quality=quality, subsampling=0)


def read_hdr(path: Path) -> Float32[np.ndarray, "h w 3"]:
    """Linear RGB of a .hdr or .exr picture, row 0 up; grey is repeated, alpha is dropped.

    The content decides, not the suffix. Negative values are returned as they are.

    Raises:
        InputError: the file is missing, damaged, truncated, of another kind, or has NaN or inf.
    """
    return _decode_hdr(path, None, [])


def _finite_rgb(path: Path, image: Float32[np.ndarray, "h w *c"]) -> Float32[np.ndarray, "h w 3"]:
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    bad = image.size - sum(int(np.isfinite(row).sum()) for row in image)
    if bad:
        raise InputError(
            "the picture has NaN or infinite values",
            where=path,
            got=f"{bad} of {image.size}",
            remedy="Export it again as 32-bit float, or replace them in an image editor.",
        )
    return image


def write_hdr(path: Path, rgb: Float[np.ndarray, "h w 3"]) -> None:
    """Write linear RGB as a run-length coded Radiance picture (relative error <= 1/256).

    Raises:
        InputError: a value is negative, not finite or too large for RGBE.
    """
    try:
        data = encode_radiance(rgb)
    except ValueError as error:
        raise InputError(
            "cannot write this picture", where=path, got=error, expected="finite values from 0 up"
        ) from error
    with whole_file(path) as temporary:
        temporary.write_bytes(data)


def read_sky(path: Path) -> SkyFile:
    """Radiance of a .hdr or .exr sky, made fit for a SkyDome; every change is noted.

    A picture of more than 2048 rows is averaged over squares of pixels, negative values that hold
    less than 1 % of the light are clipped, a width within 2 % of twice the height is resampled
    to it.

    Raises:
        InputError: as `read_hdr`; or not about 2:1, without light, or too negative.
    """
    notes: list[str] = []
    radiance = _decode_hdr(path, _MAX_SKY_ROWS, notes)
    radiance = _clip_negatives(path, radiance, notes)
    if not (radiance > 0).any():
        raise InputError(
            "the sky is black everywhere", where=path, remedy="Export it again with its light."
        )
    radiance = _fit_aspect(path, radiance, notes)
    for note in notes:
        _LOGGER.warning("%s: %s", path, note)
    return SkyFile(radiance, tuple(notes))


def _clip_negatives(
    path: Path, radiance: Float32[np.ndarray, "h w 3"], notes: list[str]
) -> Float32[np.ndarray, "h w 3"]:
    count = int((radiance < 0).sum())
    if not count:
        return radiance
    negative = -float(np.minimum(radiance, 0).sum(dtype=np.float64))
    positive = float(np.maximum(radiance, 0).sum(dtype=np.float64))
    if negative > _NEGATIVE_TOLERANCE * positive:
        raise InputError(
            "the sky has negative radiance",
            where=path,
            got=f"{count} values that sum to {-negative:.3g} against {positive:.3g} of light",
            expected=f"at most {_NEGATIVE_TOLERANCE:.0%} of the light",
            remedy="Convert it to linear sRGB primaries and clip it at zero.",
        )
    notes.append(f"clipped {count} negative values ({negative / positive:.2g} of the light)")
    return np.maximum(radiance, np.float32(0.0))


def _fit_aspect(
    path: Path, radiance: Float32[np.ndarray, "h w 3"], notes: list[str]
) -> Float32[np.ndarray, "h v 3"]:
    height, width = radiance.shape[:2]
    if width == 2 * height:
        return radiance
    if height < 2 or abs(width / (2 * height) - 1) > _ASPECT_TOLERANCE:
        raise InputError(
            "a sky must be a full equirectangular panorama, twice as wide as high",
            where=path,
            got=f"{width}x{height} px",
            remedy="Convert light probes, cube maps or cropped panoramas to equirectangular.",
        )
    notes.append(f"resampled from {width}x{height} to {2 * height}x{height} px")
    position = (np.arange(2 * height) + 0.5) * width / (2 * height) - 0.5
    left = np.floor(position).astype(np.int64)
    part = (position - left).astype(np.float32)[None, :, None]
    mixed = radiance[:, left % width] * (1 - part) + radiance[:, (left + 1) % width] * part
    return mixed.astype(np.float32)


def _decode_hdr(
    path: Path, most_rows: int | None, notes: list[str]
) -> Float32[np.ndarray, "h w 3"]:
    with open_regular(path, "picture", MAX_PICTURE_BYTES) as handle:
        start = handle.read(8)
    if start.startswith(EXR_MAGIC):
        image = read_exr(path)
        height, width = image.shape[:2]
        factor = _reduction(path, height, width, most_rows, notes)
        if factor > 1:
            channels = image.reshape(height, width, -1)
            image = resize_area(channels, height // factor, width // factor)
        return _finite_rgb(path, image if image.shape[2:] != (1,) else image[..., 0])
    if not start.startswith(b"#?"):
        raise InputError(
            "not an HDR picture",
            where=path,
            got=f"a file that starts with {start!r}",
            expected="Radiance .hdr or OpenEXR .exr",
            remedy="LDR pictures hold too little light; export the panorama as .hdr or .exr.",
        )
    data = read_bytes(path, "picture", MAX_PICTURE_BYTES)
    try:
        factor = _reduction(path, *radiance_size(data), most_rows, notes)
        return _finite_rgb(path, decode_radiance(data, factor))
    except ValueError as error:
        raise InputError(
            "the Radiance picture cannot be read",
            where=path,
            got=error,
            remedy="Download or export the file again.",
        ) from error


def _reduction(path: Path, height: int, width: int, most_rows: int | None, notes: list[str]) -> int:
    """Edge in pixels of the squares that become one pixel; noted unless it is 1."""
    if most_rows is None or height <= most_rows:
        return 1
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


def decode_texture(data: bytes, *, is_of_obj: bool = False) -> UInt8[np.ndarray, "h w _"]:
    """8-bit sRGB of the bytes of a PNG, JPEG or WebP picture, and alpha where any is below 255.

    BMP and TGA, which OBJ files use, are read with `is_of_obj`.

    Raises:
        ValueError: the bytes are damaged, truncated, or not 8 bits a channel.
    """
    rgba = _decode_pil(data, "RGBA", _TEXTURES if is_of_obj else _READABLE)
    return rgba if (rgba[..., 3] < 255).any() else np.ascontiguousarray(rgba[..., :3])


def read_size(
    path: Path,
    formats: tuple[str, ...] = _READABLE,
    modes: tuple[str, ...] = _EIGHT_BIT_MODES,
) -> tuple[int, int]:
    """Width and height of a picture by its header; the pixels are not looked at.

    Args:
        formats, modes: Pillow's names of those that are welcome.

    Raises:
        InputError: as `read_srgb8`, as far as the header tells.
    """
    from PIL import Image

    try:
        with (
            open_regular(path, "picture", _MAX_BYTES) as handle,
            _pillow_errors(),
            Image.open(handle, formats=formats) as image,
        ):
            handle.seek(0)
            _check_header(image.size, image.mode, handle.read(_PNG_DEPTH_AT + 1), modes)
            return image.size
    except ValueError as error:
        raise _unreadable(path, error, formats) from error


def _read_pil(path: Path, mode: str) -> UInt8[np.ndarray, "h w *c"]:
    data = read_bytes(path, "picture", _MAX_BYTES)
    try:
        return _decode_pil(data, mode, _READABLE)
    except ValueError as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: ValueError, formats: tuple[str, ...] = _READABLE) -> InputError:
    return InputError(
        "the picture cannot be read",
        where=path,
        got=error,
        expected=f"a whole 8-bit {' or '.join(formats)} file",
        remedy="Download or export the file again.",
    )


def _decode_pil(data: bytes, mode: str, formats: tuple[str, ...]) -> UInt8[np.ndarray, "h w *c"]:
    from PIL import Image

    # Pillow takes a PNG whose pixels are whole but whose end is cut off.
    if data.startswith(b"\x89PNG") and _PNG_END not in data:
        raise ValueError("the PNG is truncated")
    with _pillow_errors(), Image.open(io.BytesIO(data), formats=formats) as image:
        _check_header(image.size, image.mode, data)
        return np.array(image.convert(mode), dtype=np.uint8)


def _check_header(
    size: tuple[int, int], mode: str, data: bytes, modes: tuple[str, ...] = _EIGHT_BIT_MODES
) -> None:
    """Refuse before pixels are allocated."""
    width, height = size
    if width < 1 or height < 1 or width * height > _MAX_PIXELS:
        raise ValueError(f"{width}x{height} px, more than {_MAX_PIXELS} pixels")
    if mode not in modes:
        raise ValueError(f"pixels of mode {mode}, not one of {', '.join(modes)}")
    # Pillow makes a 16-bit RGB picture one of 8 bits without a word.
    if data.startswith(b"\x89PNG") and data[_PNG_DEPTH_AT] > 8:
        raise ValueError(f"{data[_PNG_DEPTH_AT]} bits a channel instead of 8")


@contextmanager
def _pillow_errors() -> Generator[None]:
    """Whatever Pillow raises, as a ValueError; its warnings are not shown."""
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except UnidentifiedImageError as error:
        raise ValueError("an unknown format") from error
    except (*_PIL_ERRORS, Image.DecompressionBombError) as error:
        raise ValueError(f"{error}"[:200]) from error


def _write_pil(
    path: Path,
    pixels: UInt8[np.ndarray, "h w *c"] | UInt16[np.ndarray, "h w"],
    kind: str,
    **options: int,
) -> None:
    from PIL import Image

    if not pixels.size or (pixels.ndim == 3 and pixels.shape[2] not in (2, 3, 4)):
        raise InputError(
            "not a picture",
            where=path,
            got=f"an array {list(pixels.shape)}",
            expected="[h, w] or [h, w, 2 to 4], not empty",
        )
    with whole_file(path) as temporary, temporary.open("wb") as handle:
        Image.fromarray(np.ascontiguousarray(pixels)).save(handle, format=kind, **options)
