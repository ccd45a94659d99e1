"""OpenEXR buffers of LightSim: one channel or R, G, B, in half or float, with header attributes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from lightsim.errors import InputError
from lightsim.store.atomic import whole_file
from lightsim.store.exr_file import (
    HALF_MAX,
    LIBRARY_ERRORS,
    data_window,
    display_window,
    read_channels,
    read_headers,
)

# Header attribute with the mark of the run that wrote the picture.
_MARK = "lightsim"


def read_exr(path: Path) -> Float32[np.ndarray, "h w *c"]:
    """Read an OpenEXR buffer: [h, w] of one channel or [h, w, 3] of R, G, B; inf and NaN are kept.

    Raises:
        InputError: the file is missing, damaged, truncated, not OpenEXR, or has other channels,
            several parts, or a data window that is not its display window.
    """
    headers = read_headers(path)
    names = [channel.name for channel in headers[0]["channels"]]
    # The library lists channels in alphabetical order; alpha is ignored.
    names = list("RGB") if set(names) in (set("RGB"), set("RGBA")) else names
    is_whole = data_window(headers[0]).is_same(display_window(headers[0]))
    if len(headers) > 1 or not is_whole or (len(names) != 1 and names != list("RGB")):
        raise _no_buffer(path, names)
    channels = read_channels(path, headers, 0, names)
    if len(names) == 1:
        return channels[0].pixels.astype(np.float32)
    return np.stack([channel.pixels for channel in channels], axis=-1).astype(np.float32)


def _no_buffer(path: Path, names: list[str]) -> InputError:
    return InputError(
        "the OpenEXR picture is not a buffer of LightSim",
        where=path,
        got=f"channels {', '.join(sorted(names)[:12])}",
        expected="one part with R, G, B or a single channel, without a crop",
        remedy="Write it again with the command that made it.",
    )


def read_mark(path: Path) -> str | None:
    """Return the mark that `write_exr` wrote into the header; None if missing or incomplete."""
    mark = _attribute(path, _MARK)
    return mark if isinstance(mark, str) else None


def read_number(path: Path, name: str) -> float | None:
    """Return a number that `write_exr` put into the header; None if the file has none."""
    number = _attribute(path, name)
    return number if isinstance(number, float) and np.isfinite(number) else None


def _attribute(path: Path, name: str) -> Any:
    import OpenEXR

    try:
        # A smaller file cannot be an OpenEXR picture, and is not passed to the library.
        if path.stat().st_size < 64:
            return None
        with OpenEXR.File(str(path), header_only=True) as file:
            return file.header().get(name)
    except (OSError, *LIBRARY_ERRORS):
        return None


def write_exr(
    path: Path,
    array: Float[np.ndarray, "h w *c"],
    half: bool = False,
    mark: str = "",
    numbers: Mapping[str, float] = MappingProxyType({}),
) -> None:
    """Write [h, w] as channel Y, or [h, w, 3] as R, G, B, with ZIP compression.

    Args:
        half: store half floats instead of 32-bit floats.
        mark: text for the header that identifies the run, for `read_mark`.
        numbers: attributes for the header, stored as 32-bit floats, for `read_number`.

    Raises:
        InputError: the array has another shape or no pixel, or finite values exceed the largest
            half float (65504).
    """
    if array.ndim not in (2, 3) or array.shape[2:] not in ((), (3,)) or not array.size:
        raise InputError(
            "the array is not an EXR picture",
            where=path,
            got=list(array.shape),
            expected="[h, w] or [h, w, 3]",
        )
    if half and (np.abs(array[np.isfinite(array)]) > HALF_MAX).any():
        raise InputError(
            "values are too large for half floats", where=path, remedy="Write it with half=False."
        )
    import OpenEXR

    pixels = np.ascontiguousarray(array, dtype=np.float16 if half else np.float32)
    header: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        _MARK: mark,
        **numbers,
    }
    channels: dict[str, Any] = {"Y": pixels} if array.ndim == 2 else {"RGB": pixels}
    with whole_file(path) as temporary:
        OpenEXR.File(header, channels).write(str(temporary))
