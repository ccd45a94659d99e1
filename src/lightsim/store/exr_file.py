"""Low-level reading of OpenEXR files: headers of all parts, then channels of one part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int, Shaped

from lightsim.errors import InputError
from lightsim.store.reading import MAX_PICTURE_BYTES, open_regular

EXR_MAGIC = b"\x76\x2f\x31\x01"
# Largest number of values of a file: an 8k panorama, 8192x4096 pixels in four channels, takes 512
# MiB as floats, and as much again when channels are joined. The library reads all channels of all
# parts.
MAX_VALUES = 1 << 27
# Largest finite half float (IEEE 754 binary16).
HALF_MAX = 65504.0
_FLAT_TYPES = ("scanlineimage", "tiledimage")
# Exceptions that the OpenEXR library raises for damaged files.
LIBRARY_ERRORS = (RuntimeError, ValueError, TypeError, LookupError, MemoryError)


@dataclass(frozen=True, eq=False)
class Window:
    """Rectangle of pixels: columns from x to x + width, rows from y to y + height (exclusive)."""

    x: int
    y: int
    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.width}x{self.height}{self.x:+d}{self.y:+d}"

    def is_same(self, other: Window) -> bool:
        """Return whether both windows cover the same pixels."""
        return str(self) == str(other)


@dataclass(frozen=True, eq=False)
class ExrChannel:
    """Pixels of one channel; `sampling` is the step between samples in columns and rows."""

    pixels: Shaped[np.ndarray, "h w"]
    sampling: tuple[int, int]


def read_headers(path: Path) -> tuple[Mapping[str, Any], ...]:
    """Return the headers of all parts after a check that all pixels fit into memory.

    Raises:
        InputError: the file is missing, damaged, not OpenEXR, too large, or has deep pixels.
    """
    with open_regular(path, "picture", MAX_PICTURE_BYTES) as handle:
        if handle.read(len(EXR_MAGIC)) != EXR_MAGIC:
            raise InputError("not an OpenEXR file", where=path, expected="a .exr picture")
    import OpenEXR

    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            headers = tuple(dict(part.header) for part in file.parts)
        sizes = [_values(header) for header in headers]
        kinds = [header["type"].name for header in headers]
    except LIBRARY_ERRORS as error:
        raise _damaged(path, error) from error
    if not headers:
        raise _damaged(path, "no picture")
    # Headers may claim any size: refuse it before the library allocates pixels.
    for header, size, kind in zip(headers, sizes, kinds, strict=True):
        window = data_window(header)
        if min(window.width, window.height) < 1 or size > MAX_VALUES:
            _refuse_size(path, f"the size {window.width}x{window.height} px", header)
        if kind not in _FLAT_TYPES:
            raise InputError(
                "the OpenEXR file has deep pixels, which have no single colour",
                where=path,
                got=f"the type {kind}" + (f" of part {header['name']}" if len(headers) > 1 else ""),
                expected=" or ".join(_FLAT_TYPES),
                remedy="Flatten it, or save the flat part alone.",
            )
    if sum(sizes) > MAX_VALUES:
        _refuse_size(path, f"the size of all {len(headers)} parts", headers[0])
    return headers


def read_channels(
    path: Path, headers: Sequence[Mapping[str, Any]], part: int, names: Sequence[str]
) -> list[ExrChannel]:
    """Return channels of a part as stored.

    Args:
        headers: result of `read_headers`.
        part: index of the part.
        names: names of the channels.

    Raises:
        InputError: pixels of any part cannot be decoded.
    """
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            # The library omits a part whose pixels it cannot decode, without an error.
            if len(file.parts) != len(headers):
                raise _damaged(path, "pixels that cannot be decoded")
            by_name = file.parts[part].channels
            channels = [by_name[name] for name in names]
            found = [
                ExrChannel(c.pixels, (max(1, int(c.xSampling)), max(1, int(c.ySampling))))
                for c in channels
            ]
    except LIBRARY_ERRORS as error:
        raise _damaged(path, error) from error
    window = data_window(headers[part])
    for channel in found:
        columns, rows = channel.sampling
        expected = (-(-window.height // rows), -(-window.width // columns))
        if channel.pixels.shape != expected or channel.pixels.dtype.hasobject:
            raise _damaged(path, f"a channel of {list(channel.pixels.shape)} pixels")
    return found


def data_window(header: Mapping[str, Any]) -> Window:
    """Return the window of the pixels that a part stores."""
    return _window(header["dataWindow"])


def display_window(header: Mapping[str, Any]) -> Window:
    """Return the window of the whole picture; the data window may be smaller or larger."""
    return _window(header["displayWindow"])


def _window(corners: Sequence[Int[np.ndarray, "2"]]) -> Window:
    (left, top), (right, bottom) = (corner.astype(np.int64).tolist() for corner in corners)
    return Window(left, top, right - left + 1, bottom - top + 1)


def _values(header: Mapping[str, Any]) -> int:
    window = data_window(header)
    # Raises LookupError for a header without a display window.
    display_window(header)
    return max(0, window.width) * max(0, window.height) * len(header["channels"])


def _refuse_size(path: Path, what: str, header: Mapping[str, Any]) -> None:
    raise InputError(
        f"{what} in {len(header['channels'])} channels is out of range",
        where=path,
        expected=f"1 to {MAX_VALUES} values in all",
        remedy="Save the layer that is needed alone, or resize it to 4096x2048 px.",
    )


def _damaged(path: Path, got: object) -> InputError:
    return InputError(
        "the OpenEXR picture is truncated or damaged",
        where=path,
        got=f"{got}"[:200],
        remedy="Download or export the file again.",
    )
