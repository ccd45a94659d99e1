"""OpenEXR pictures with one channel or with R, G, B, in half or float."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Shaped

from lightsim.errors import InputError
from lightsim.store.atomic import whole_file
from lightsim.store.reading import MAX_PICTURE_BYTES, open_regular

EXR_MAGIC = b"\x76\x2f\x31\x01"
_MAX_VALUES = 1 << 27
"""An 8k panorama, 8192x4096 in four channels: 512 MiB as floats, and again when they are joined."""
_FLAT_TYPES = ("scanlineimage", "tiledimage")
_HALF_MAX = 65504.0
_MARK = "lightsim"
_LEAST_BYTES = 64
"""No picture is smaller; the library must not be given less."""
_REMEDY = "Download or export the file again."


def read_exr(path: Path) -> Float32[np.ndarray, "h w *c"]:
    """An OpenEXR buffer as it is: [h, w] of one channel, [h, w, 3] of R, G, B; inf and NaN stay.

    Alpha is dropped; R, G, B may carry a layer's name ("ViewLayer.Combined.R").

    Raises:
        InputError: the file is missing, damaged, truncated, not OpenEXR, cropped, or has other
            channels.
    """
    with open_regular(path, "picture", MAX_PICTURE_BYTES) as handle:
        if handle.read(len(EXR_MAGIC)) != EXR_MAGIC:
            raise InputError("not an OpenEXR file", where=path, expected="a .exr picture")
    import OpenEXR

    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            _check_header(file.header())
            if len(file.parts) > 1:
                raise ValueError(f"it holds {len(file.parts)} pictures")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            pixels_by_name = {str(n): channel.pixels for n, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, LookupError, MemoryError) as error:
        raise InputError(
            "the OpenEXR picture cannot be read; it is truncated, damaged or cropped",
            where=path,
            got=f"{error}"[:200],
            remedy=_REMEDY,
        ) from error
    return _picture(path, pixels_by_name)


def read_mark(path: Path) -> str | None:
    """What `write_exr` was told to mark the picture with; None of a file that it did not write,
    or not to the end."""
    mark = _attribute(path, _MARK)
    return mark if isinstance(mark, str) else None


def read_number(path: Path, name: str) -> float | None:
    """A number that `write_exr` was told to keep in the header; None where there is none."""
    number = _attribute(path, name)
    return number if isinstance(number, float) and np.isfinite(number) else None


def _attribute(path: Path, name: str) -> Any:
    import OpenEXR

    try:
        if path.stat().st_size < _LEAST_BYTES:
            return None
        with OpenEXR.File(str(path), header_only=True) as file:
            return file.header().get(name)
    except (OSError, RuntimeError, ValueError, TypeError, LookupError, MemoryError):
        return None


def write_exr(
    path: Path,
    array: Float[np.ndarray, "h w *c"],
    half: bool = False,
    mark: str = "",
    numbers: Mapping[str, float] = MappingProxyType({}),
) -> None:
    """Write [h, w] as channel Y, or [h, w, 3] as R, G, B; ZIP compressed, float or half. The mark,
    a word of the writer's own, and the numbers go into the header, these as 32-bit floats.

    Raises:
        InputError: another shape, an empty picture, or finite values beyond half's 65504.
    """
    if array.ndim not in (2, 3) or array.shape[2:] not in ((), (3,)) or not array.size:
        raise InputError(
            "the array is no EXR picture",
            where=path,
            got=list(array.shape),
            expected="[h, w] or [h, w, 3]",
        )
    if half and (np.abs(array[np.isfinite(array)]) > _HALF_MAX).any():
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


def _check_header(header: Mapping[str, Any]) -> None:
    """Refuse before pixels are allocated; a cropped picture would shift silently."""
    data, display = (np.array(header[k], np.int64) for k in ("dataWindow", "displayWindow"))
    width, height = (data[1] - data[0] + 1).tolist()
    count = len(header["channels"])
    if width < 1 or height < 1 or width * height * count > _MAX_VALUES:
        raise ValueError(f"the size {width}x{height} px in {count} channels is out of range")
    if (data != display).any():
        raise ValueError(f"its data window {data.tolist()} is not its frame {display.tolist()}")
    if header["type"].name not in _FLAT_TYPES:
        raise ValueError(f"its pixels are of type {header['type'].name}")


def _picture(
    path: Path, pixels_by_name: Mapping[str, Shaped[np.ndarray, "..."]]
) -> Float32[np.ndarray, "h w *c"]:
    names = list(pixels_by_name)
    picked = [[n for n in names if n.rpartition(".")[2] == letter] for letter in "RGB"]
    if all(len(found) == 1 for found in picked):
        chosen = [pixels_by_name[found[0]] for found in picked]
    elif len(names) == 1:
        chosen = [pixels_by_name[names[0]]]
    else:
        raise InputError(
            "the OpenEXR picture does not hold one picture",
            where=path,
            got=f"channels {sorted(names)[:12]}",
            expected="R, G, B (once each), or a single channel",
            remedy="Export one layer as RGB.",
        )
    if any(c.ndim != 2 or c.dtype.hasobject or c.shape != chosen[0].shape for c in chosen):
        raise InputError("its channels are deep or subsampled", where=path, remedy=_REMEDY)
    if len(chosen) == 1:
        return chosen[0].astype(np.float32)
    return np.stack(chosen, axis=-1).astype(np.float32)
