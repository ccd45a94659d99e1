"""Reading of untrusted JSON and gzip files: one clear error each, with the file's name."""

from __future__ import annotations

import gzip
import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.errors import InputError

_MAX_JSON_BYTES = 256 * 1024 * 1024
_CHUNK_BYTES = 1 << 20
_BROKEN = "Copy the file again from the original data set."


def read_json(path: Path) -> Any:
    """The parsed JSON document.

    Raises:
        InputError: the file is missing, too large or no JSON.
    """
    try:
        if path.stat().st_size > _MAX_JSON_BYTES:
            raise InputError("the JSON file is too large", where=path, remedy=_BROKEN)
        return json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(
            "the file cannot be read", where=path, got=error.strerror, remedy=_BROKEN
        ) from error
    except (ValueError, RecursionError) as error:
        raise InputError(
            "the file is no valid JSON", where=path, got=error, remedy=_BROKEN
        ) from error


def read_gzip(path: Path, max_bytes: int) -> bytes:
    """The decompressed bytes, at most `max_bytes` of them.

    Raises:
        InputError: the file is missing, truncated, no gzip, or decompresses to more.
    """
    chunks: list[bytes] = []
    size = 0
    try:
        with gzip.open(path, "rb") as stream:
            while chunk := stream.read(_CHUNK_BYTES):
                size += len(chunk)
                if size > max_bytes:
                    raise InputError(
                        "the file decompresses to more than a sweep or label file can hold",
                        where=path,
                        expected=f"at most {max_bytes} bytes",
                    )
                chunks.append(chunk)
    except FileNotFoundError as error:
        raise InputError("the file is missing", where=path) from error
    except (EOFError, OSError, zlib.error) as error:
        raise InputError(
            "the gzip file is truncated or damaged", where=path, got=error, remedy=_BROKEN
        ) from error
    return b"".join(chunks)


def require_object(value: Any, where: object) -> dict[str, Any]:
    """`value` if it is a JSON object.

    Raises:
        InputError: it is something else.
    """
    if not isinstance(value, dict):
        raise InputError("not a JSON object", where=where, got=type(value).__name__)
    return value


def require_list(value: Any, where: object) -> list[Any]:
    """`value` if it is a non-empty JSON array.

    Raises:
        InputError: it is something else, or empty.
    """
    if not isinstance(value, list) or not value:
        raise InputError("not a JSON array with entries", where=where, got=type(value).__name__)
    return value


def require_numbers(value: Any, keys: tuple[str, ...], where: object) -> Float64[np.ndarray, " n"]:
    """The finite numbers that `value` holds under `keys`, in their order.

    Raises:
        InputError: a key is missing or its value is not a finite number.
    """
    table = require_object(value, where)
    numbers = np.empty(len(keys))
    for i, key in enumerate(keys):
        if key not in table:
            raise InputError(
                f"the key '{key}' is missing",
                where=where,
                got=", ".join(map(str, table)) or "an empty object",
                expected=", ".join(keys),
            )
        numbers[i] = require_number(table[key], f"{where}, '{key}'")
    return numbers


def require_number(value: Any, where: object) -> float:
    """`value` as a finite float.

    Raises:
        InputError: it is no number, or not finite.
    """
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    is_finite = is_number and abs(value) <= 1e300
    if not is_finite:
        raise InputError("not a finite number", where=where, got=str(value)[:40])
    return float(value)


def read_times_ns(path: Path) -> Int64[np.ndarray, " n"]:
    """UTC nanoseconds of a JSON array of POSIX seconds, strictly increasing.

    The files hold doubles with microsecond digits, so the rest is rounded off.

    Raises:
        InputError: no array of increasing times between 1980 and 2100.
    """
    values = require_list(read_json(path), path)
    seconds = np.array([require_number(v, f"{path}[{i}]") for i, v in enumerate(values)])
    if (seconds < 3.1e8).any() or (seconds > 4.2e9).any():
        raise InputError(
            "a time is no UTC second between 1980 and 2100",
            where=path,
            got=f"{seconds.min()} to {seconds.max()}",
        )
    times_ns = np.round(seconds * 1e6).astype(np.int64) * 1000
    backwards = np.flatnonzero(np.diff(times_ns) <= 0)
    if len(backwards):
        raise InputError(
            "the times do not increase",
            where=path,
            got=f"entry {backwards[0] + 1} is not after entry {backwards[0]}",
            remedy=_BROKEN,
        )
    return times_ns
