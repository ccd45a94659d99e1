"""Reader and writer of 8-bit pictures (PNG, JPEG, WebP); HDR functions are in `hdr` and `exr`."""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16

from lightsim.errors import InputError
from lightsim.store.atomic import whole_file
from lightsim.store.exr import read_exr, write_exr
from lightsim.store.hdr import SkyFile, read_hdr, read_sky
from lightsim.store.reading import open_regular, read_bytes

__all__ = [
    "SkyFile",
    "decode_texture",
    "read_exr",
    "read_grey8",
    "read_grey8_alpha",
    "read_hdr",
    "read_orientation",
    "read_png16",
    "read_size",
    "read_sky",
    "read_srgb8",
    "read_srgb8_alpha",
    "write_exr",
    "write_jpeg",
    "write_png",
]
# Names of formats and pixel modes in Pillow: of pictures, and of textures of models.
_READABLE = ("PNG", "JPEG", "WEBP")
_TEXTURES = (*_READABLE, "BMP", "TGA")
_EIGHT_BIT_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr")
_GREY16 = "I;16"
_TEXTURE_MODES = (*_EIGHT_BIT_MODES, _GREY16)
_PIL_ERRORS = (OSError, ValueError, SyntaxError, EOFError, LookupError, TypeError, struct.error)
_MAX_PIXELS = 1 << 27
"""Largest number of pixels of a picture: a 16k panorama, 16384x8192, which takes a gigabyte when
Pillow decodes it."""
_MAX_BYTES = 512 << 20
"""Largest size of a picture file, in bytes: as many pixels without compression."""
_PNG_END = b"IEND\xaeB`\x82"
"""Type and checksum of the last chunk of a PNG file (ISO 15948, 11.2.5)."""
_ORIENTATION = 0x0112
"""EXIF tag of the orientation."""
_PNG_DEPTH_AT = 24
"""Position of the byte in a PNG file with the bit depth of a channel (ISO 15948, 11.2.2)."""


class _PixelFormatError(ValueError):
    """A whole picture has pixels of another kind."""


def read_srgb8(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Return 8-bit sRGB of a PNG, JPEG or WebP picture; grey is repeated, alpha is ignored.

    Raises:
        InputError: the file is missing, damaged, truncated, or not 8 bits a channel.
    """
    return _read_pil(path, "RGB")


def read_srgb8_alpha(
    path: Path,
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """Return 8-bit sRGB, and alpha (255 everywhere for a picture without alpha).

    Raises:
        InputError: as `read_srgb8`.
    """
    rgba = _read_pil(path, "RGBA")
    return np.ascontiguousarray(rgba[..., :3]), np.ascontiguousarray(rgba[..., 3])


def read_grey8(path: Path) -> UInt8[np.ndarray, "h w"]:
    """Return 8-bit grey of a picture, such as a mask.

    Raises:
        InputError: as `read_srgb8`.
    """
    return _read_pil(path, "L")


def read_grey8_alpha(path: Path) -> UInt8[np.ndarray, "h w 2"]:
    """Return 8-bit grey and alpha (255 everywhere for a picture without alpha).

    Raises:
        InputError: as `read_srgb8`.
    """
    return _read_pil(path, "LA")


def read_png16(path: Path) -> UInt16[np.ndarray, "h w"]:
    """Return the whole numbers of a 16-bit grey PNG, such as a mask of ids.

    Raises:
        InputError: the file is missing, damaged or of another depth.
    """
    data = read_bytes(path, "picture", _MAX_BYTES)
    try:
        return _decode_grey16(data)
    except ValueError as error:
        raise InputError(
            "the picture cannot be read",
            where=path,
            got=error,
            expected="a whole 16-bit grey PNG file",
            remedy="Make the file again.",
        ) from error


def write_png(path: Path, picture: UInt8[np.ndarray, "h w *c"]) -> None:
    """Write a PNG of 8-bit grey [h, w] or sRGB [h, w, 3], or with alpha last [h, w, 2 or 4]."""
    _write_pil(path, picture, "PNG", compress_level=4)


def write_png16(path: Path, numbers: UInt16[np.ndarray, "h w"]) -> None:
    """Write a 16-bit grey PNG of whole numbers, such as a mask of ids."""
    _write_pil(path, numbers, "PNG", compress_level=4)


def write_jpeg(path: Path, srgb8: UInt8[np.ndarray, "h w 3"], quality: int = 92) -> None:
    """Write a JPEG of 8-bit sRGB, without chroma subsampling."""
    _write_pil(path, srgb8, "JPEG", quality=quality, subsampling=0)


def decode_texture(data: bytes, *, is_of_obj: bool = False) -> UInt8[np.ndarray, "h w _"]:
    """Decode a PNG, JPEG or WebP picture to 8-bit sRGB, with alpha if any alpha is below 255.

    PNG pictures of 16 bits per channel are rounded to 8.

    Args:
        is_of_obj: read BMP and TGA too, which OBJ files use.

    Raises:
        ValueError: the bytes are damaged, truncated, or of another depth.
    """
    formats = _TEXTURES if is_of_obj else _READABLE
    rgba = _decode_pil(data, "RGBA", formats, _TEXTURE_MODES, 16)
    return rgba if (rgba[..., 3] < 255).any() else np.ascontiguousarray(rgba[..., :3])


def read_size(
    path: Path,
    formats: tuple[str, ...] = _READABLE,
    modes: tuple[str, ...] = _EIGHT_BIT_MODES,
) -> tuple[int, int]:
    """Return width and height of a picture from its header, without decoding pixels.

    Args:
        formats, modes: Pillow's names of the accepted formats and pixel modes.

    Raises:
        InputError: as `read_srgb8`, for errors that the header shows.
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


def read_orientation(path: Path) -> int:
    """Return the EXIF orientation of a picture, 1 to 8; 1, upright, if it has none.

    Raises:
        InputError: as `read_srgb8`, for errors that the header shows.
    """
    from PIL import Image

    try:
        with (
            open_regular(path, "picture", _MAX_BYTES) as handle,
            _pillow_errors(),
            Image.open(handle, formats=_READABLE) as image,
        ):
            # Not getexif, which decodes PNG pictures.
            exif = Image.Exif()
            try:
                exif.load(image.info.get("exif", b""))
            except _PIL_ERRORS:
                # Other programs ignore a damaged header, too.
                return 1
            value = exif.get(_ORIENTATION, 1)
            return value if value in range(1, 9) else 1
    except ValueError as error:
        raise _unreadable(path, error) from error


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
        remedy="Convert it to RGB of 8 bits without alpha."
        if isinstance(error, _PixelFormatError)
        else "Download it again, or export it with 8 bits a channel.",
    )


def _decode_pil(
    data: bytes,
    mode: str,
    formats: tuple[str, ...],
    modes: tuple[str, ...] = _EIGHT_BIT_MODES,
    most_bits: int = 8,
) -> UInt8[np.ndarray, "h w *c"]:
    from PIL import Image

    # Pillow accepts a PNG whose pixels are complete but whose end is cut off.
    if data.startswith(b"\x89PNG") and _PNG_END not in data:
        raise ValueError("the PNG is truncated")
    with _pillow_errors(), Image.open(io.BytesIO(data), formats=formats) as image:
        _check_header(image.size, image.mode, data, modes, most_bits)
        if image.mode == _GREY16:
            # Pillow would clip 16-bit grey to 255 (of 16-bit colour, it takes the upper byte).
            grey = np.rint(np.array(image) / 257).astype(np.uint8)
            return np.array(Image.fromarray(grey).convert(mode), dtype=np.uint8)
        return np.array(image.convert(mode), dtype=np.uint8)


def _decode_grey16(data: bytes) -> UInt16[np.ndarray, "h w"]:
    from PIL import Image

    if _PNG_END not in data:
        raise ValueError("the PNG is truncated")
    with _pillow_errors(), Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        _check_header(image.size, image.mode, data, (_GREY16,), 16)
        return np.array(image, dtype=np.uint16)


def _check_header(
    size: tuple[int, int],
    mode: str,
    data: bytes,
    modes: tuple[str, ...] = _EIGHT_BIT_MODES,
    most_bits: int = 8,
) -> None:
    """Reject a picture by its header, before pixels are allocated."""
    width, height = size
    if width < 1 or height < 1 or width * height > _MAX_PIXELS:
        raise ValueError(f"{width}x{height} px, more than {_MAX_PIXELS} pixels")
    if mode not in modes:
        raise _PixelFormatError(f"pixels of mode {mode}, not one of {', '.join(modes)}")
    # Pillow converts 16-bit RGB pictures to 8 bits silently.
    if data.startswith(b"\x89PNG") and data[_PNG_DEPTH_AT] > most_bits:
        raise _PixelFormatError(f"{data[_PNG_DEPTH_AT]} bits a channel instead of {most_bits}")


@contextmanager
def _pillow_errors() -> Generator[None]:
    """Convert Pillow's exceptions to ValueError, and suppress its warnings."""
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except UnidentifiedImageError as error:
        raise ValueError("an unknown format") from error
    except _PixelFormatError:
        raise
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
