"""Readers of untrusted JSON and compressed files; errors name the file."""

from __future__ import annotations

import io
import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.errors import InputError
from lightsim.store.foreign import foreign_content
from lightsim.store.reading import MAX_JSON_BYTES, open_regular, read_bytes

# Compressed bytes per step: few, since bytes after the end of a member are read again.
_IN_BYTES = 1 << 16
# Decompressed bytes per step: bounds the memory.
_OUT_BYTES = 1 << 20
# Largest table file whose first bytes are examined.
_MAX_PACKED = 1 << 30
# Largest number of gzip members: parallel compressors write one for every 64 KB or so.
_MAX_MEMBERS = 10_000
# zlib's code for a gzip header with the largest window.
_GZIP_WINDOW = 31
_GZIP_MAGIC = b"\x1f\x8b"
# First bytes of tables in other formats, with advice.
_OTHER_TABLES = (
    (b"PAR1", "Parquet", "Write the table with pandas.DataFrame.to_pickle."),
    (b"ARROW1", "Feather", "Write the table with pandas.DataFrame.to_pickle."),
)
MAX_NUMBER = 1e15
"""Largest number in a file: quantities of logs in SI units are far smaller, and its square fits
into float32."""
_BROKEN = "Copy the file again from the original data set."


def read_json(path: Path) -> Any:
    """Read a JSON document.

    Raises:
        InputError: the file is missing, no regular file, too large or no JSON.
    """
    data = read_bytes(path, "JSON file", MAX_JSON_BYTES)
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(
            "the file is not valid JSON", where=path, got=f"{error}"[:200], remedy=_BROKEN
        ) from error


def read_packed(path: Path, max_bytes: int) -> bytes:
    """Return the bytes of a file, decompressed if its first bytes are those of gzip.

    Raises:
        InputError: the file is missing, no regular file, truncated, compressed in another format
            than gzip, or decompresses to more than `max_bytes`.
    """
    # Gzip never takes twice the size of its content, not even for noise in small members.
    data = read_bytes(path, "table file", 2 * max_bytes)
    if data.startswith(_GZIP_MAGIC):
        return _gunzipped(data, path, max_bytes)
    tables = (entry[1:] for entry in _OTHER_TABLES if data.startswith(entry[0]))
    foreign = foreign_content(data) or next(tables, None)
    if foreign is not None:
        raise InputError(
            "the file is not a pickled table",
            where=path,
            got=foreign[0],
            expected="a pickle, or a pickle compressed with gzip",
            remedy=foreign[1],
        )
    if len(data) > max_bytes:
        raise _too_large(path, max_bytes)
    return data


def is_gzip(path: Path) -> bool:
    """Return whether a file is gzip by its first bytes.

    Raises:
        InputError: it cannot be read.
    """
    with open_regular(path, "table file", _MAX_PACKED) as handle:
        return handle.read(len(_GZIP_MAGIC)) == _GZIP_MAGIC


def _gunzipped(data: bytes, path: Path, max_bytes: int) -> bytes:
    try:
        return _inflated(data, max_bytes)
    except (EOFError, zlib.error) as error:
        raise InputError(
            "the gzip file is truncated or damaged", where=path, got=error, remedy=_BROKEN
        ) from error
    except OverflowError as error:
        raise _too_large(path, max_bytes) from error


def _too_large(path: Path, max_bytes: int) -> InputError:
    return InputError(
        "the file decompresses to more than a sweep or label file can hold",
        where=path,
        expected=f"at most {max_bytes} bytes in {_MAX_MEMBERS} gzip members",
    )


def _inflated(data: bytes, max_bytes: int) -> bytes:
    """Decompress and join all gzip members of `data`.

    Raises:
        OverflowError: too many members or bytes.
        EOFError, zlib.error: truncated or damaged.
    """
    out = io.BytesIO()
    position = 0
    # Tape drives and some copy programs pad with zeros.
    end = len(data.rstrip(b"\0"))
    for _ in range(_MAX_MEMBERS):
        stream = zlib.decompressobj(_GZIP_WINDOW)
        while not stream.eof:
            piece = stream.unconsumed_tail
            if not piece:
                piece = data[position : position + _IN_BYTES]
                position += len(piece)
            if not piece:
                raise EOFError("it ends too early")
            out.write(stream.decompress(piece, _OUT_BYTES))
            if out.tell() > max_bytes:
                raise OverflowError
        # Bytes behind the end of a member belong to the next one.
        position -= len(stream.unused_data)
        if position >= end:
            return out.getvalue()
    raise OverflowError


def require_object(value: Any, where: object) -> dict[str, Any]:
    """Return `value` if it is a JSON object.

    Raises:
        InputError: it is something else.
    """
    if not isinstance(value, dict):
        raise InputError("not a JSON object", where=where, got=type(value).__name__, remedy=_BROKEN)
    return value


def require_list(value: Any, where: object) -> list[Any]:
    """Return `value` if it is a non-empty JSON array.

    Raises:
        InputError: it is something else, or empty.
    """
    if not isinstance(value, list) or not value:
        raise InputError(
            "not a JSON array with entries", where=where, got=type(value).__name__, remedy=_BROKEN
        )
    return value


def require_numbers(value: Any, keys: tuple[str, ...], where: object) -> Float64[np.ndarray, " n"]:
    """Return the finite numbers of `value` under `keys`, in their order.

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
    """Return `value` as a finite float.

    Raises:
        InputError: it is no number, not finite, or beyond MAX_NUMBER.
    """
    # In Python, bool is an int.
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    is_finite = is_number and abs(value) <= MAX_NUMBER
    if not is_finite:
        raise InputError("not a finite number", where=where, got=f"{value!r:.40}", remedy=_BROKEN)
    return float(value)


def read_times_ns(path: Path) -> Int64[np.ndarray, " n"]:
    """Read a JSON array of strictly increasing POSIX seconds; return UTC nanoseconds.

    The files contain doubles with microsecond digits, to which times are rounded.

    Raises:
        InputError: no array of increasing times between 1980 and 2100.
    """
    values = require_list(read_json(path), path)
    for i, value in enumerate(values):
        if isinstance(value, str):
            raise InputError(
                "a time is text",
                where=f"{path}[{i}]",
                got=f"{value!r:.40}",
                expected="a number",
                remedy="Write times as numbers, without quotation marks.",
            )
    # Nanoseconds exceed the largest number of other quantities.
    is_huge = any(isinstance(value, int) and value > MAX_NUMBER for value in values)
    seconds = np.array(
        [MAX_NUMBER if is_huge else require_number(v, f"{path}[{i}]") for i, v in enumerate(values)]
    )
    if (seconds < 3.1e8).any() or (seconds > 4.2e9).any():
        raise InputError(
            "a time is not in UTC seconds between 1980 and 2100",
            where=path,
            got=f"{values[0]} to {values[-1]}",
            remedy="Times are POSIX seconds, not milliseconds, nanoseconds or counts.",
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
