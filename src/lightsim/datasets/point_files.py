"""Reader of untrusted files of points: .npz, .ply, .pcd and .bin.

Every format gives the same columns: `xyz` and, if there, others such as `intensity`. Sizes that a
header claims are compared with the file before memory is allocated, and nothing is unpickled.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Shaped

from lightsim.errors import InputError
from lightsim.store.arrays import load_arrays
from lightsim.store.reading import read_bytes

Columns = dict[str, Shaped[np.ndarray, "n ..."]]
"""Arrays by name, of equal length; positions of several numbers have shape [n, 3]."""
SUFFIXES = (".npz", ".ply", ".pcd", ".bin")
"""Suffixes of the formats, the preferred one first."""
# Largest file, in bytes: 20 million points with colours and normals.
_MAX_BYTES = 1 << 30
# Largest number of points: a dense reconstruction of a street; 40 s of all LiDARs have 10 million.
_MAX_POINTS = 20_000_000
# Longest header, in bytes.
_MAX_HEADER = 1 << 16
_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_PCD_TYPES = frozenset({
    ("F", "4"), ("F", "8"), ("I", "1"), ("I", "2"), ("I", "4"), ("I", "8"),
    ("U", "1"), ("U", "2"), ("U", "4"), ("U", "8"),
})  # fmt: skip
_COUNT = re.compile(r"[0-9]{1,9}")
_VECTORS = {"xyz": ("x", "y", "z"), "origin": ("origin_x", "origin_y", "origin_z")}


def read_points(path: Path, bin_columns: Sequence[str] = ()) -> Columns:
    """Return the columns of a file of points; `xyz` is [n, 3], and so is `origin` if it is there.

    Args:
        bin_columns: names of the float32 columns of a .bin file.

    Raises:
        InputError: the file is missing, damaged, too large, of an unsupported kind, or has no
            positions.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        columns = dict(load_arrays(path, max_bytes=_MAX_BYTES))
    else:
        data = read_bytes(path, "file of points", _MAX_BYTES)
        parsers: dict[str, Callable[[], Columns]] = {
            ".ply": lambda: _ply(data, path),
            ".pcd": lambda: _pcd(data, path),
            ".bin": lambda: _bin(data, path, bin_columns),
        }
        columns = parsers[suffix]()
    for name, parts in _VECTORS.items():
        if name not in columns and all(part in columns for part in parts):
            columns[name] = np.stack([columns.pop(part) for part in parts], axis=1)
    _check(columns, path)
    return columns


def as_doubles(column: Shaped[np.ndarray, "n ..."]) -> Float64[np.ndarray, "n ..."]:
    """Return a column as doubles; signalling NaN of damaged files become quiet ones."""
    with np.errstate(invalid="ignore"):
        return column.astype(np.float64)


def _check(columns: Mapping[str, np.ndarray], path: Path) -> None:
    if "xyz" not in columns:
        raise InputError(
            "the file has no positions",
            where=path,
            got=", ".join(map(str, columns))[:200] or "no column",
            expected="xyz [n, 3], or columns x, y, z",
        )
    n = len(columns["xyz"]) if columns["xyz"].ndim else 0
    for name, column in columns.items():
        # Others may have several numbers a point, which readers pass over.
        shape = (n, 3) if name in _VECTORS else (n,)
        fits = column.shape == shape if name in _VECTORS else column.shape[:1] == shape
        if not fits or column.dtype.kind not in "fiu":
            raise InputError(
                f"the column '{name}' does not fit",
                where=path,
                got=f"{column.dtype}{list(column.shape)}",
                expected=f"numbers {list(shape)}",
            )
    if n > _MAX_POINTS:
        raise InputError(
            "the file has too many points",
            where=path,
            got=n,
            expected=f"at most {_MAX_POINTS}",
            remedy="Keep every second or third point.",
        )


def _bin(data: bytes, path: Path, names: Sequence[str]) -> Columns:
    if not names or not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise InputError(
            "the columns of .bin files are not known",
            where=path,
            got=", ".join(names) or "no names",
            expected='"bin_columns" of the LiDAR in log.json, such as ["x", "y", "z", "intensity"]',
        )
    if len(data) % (4 * len(names)):
        raise _damaged(path, f"{len(data)} bytes", f"a multiple of {4 * len(names)} bytes: float32")
    table = np.frombuffer(data, "<f4").reshape(-1, len(names))
    return {name: table[:, k] for k, name in enumerate(names)}


def _ply(data: bytes, path: Path) -> Columns:
    """Return the properties of the element `vertex`, which must be the first one."""
    head, body = _split_header(data, "end_header", path)
    lines = [line.split() for line in head if line.strip()]
    form = next((line[1] for line in lines if line[0] == "format" and len(line) > 1), "")
    elements = [i for i, line in enumerate(lines) if line[0] == "element"]
    if lines[0] != ["ply"] or form not in _PLY_ORDERS or not elements:
        raise _damaged(path, f"format {form[:40] or 'unknown'}", "a PLY file")
    first = lines[elements[0]]
    last = elements[1] if len(elements) > 1 else len(lines)
    properties = [x[1:] for x in lines[elements[0] + 1 : last] if x[0] == "property"]
    is_known = all(len(p) == 2 and p[0] in _PLY_TYPES for p in properties) and properties
    if first[1:2] != ["vertex"] or len(first) != 3 or not is_known:
        raise _damaged(
            path,
            f"{' '.join(first)[:60]} with {[' '.join(p) for p in properties][:6]}",
            "the element vertex first, with properties of single numbers",
        )
    types = [(name, _PLY_ORDERS[form] + _PLY_TYPES[kind]) for kind, name in properties]
    return _table(body, types, _count(first[2], path), path, is_text=form == "ascii")


def _pcd(data: bytes, path: Path) -> Columns:
    head, body = _split_header(data, "DATA", path)
    entries = {line.split()[0]: line.split()[1:] for line in head if line.strip()}
    form = (entries.get("DATA") or [""])[0]
    if form not in ("ascii", "binary"):
        raise InputError(
            "the PCD file has an encoding that is not read",
            where=path,
            got=form[:40] or "no DATA",
            expected="DATA ascii or DATA binary",
            remedy="Convert it: pcl_convert_pcd_ascii_binary IN.pcd OUT.pcd 1",
        )
    names, sizes, kinds = (entries.get(key, []) for key in ("FIELDS", "SIZE", "TYPE"))
    counts = entries.get("COUNT", ["1"] * len(names))
    is_known = len(names) == len(sizes) == len(kinds) == len(counts) > 0
    is_known &= all(pair in _PCD_TYPES for pair in zip(kinds, sizes, strict=False))
    is_known &= all(_COUNT.fullmatch(count) and 0 < int(count) < 1000 for count in counts)
    if not is_known:
        raise _damaged(path, f"FIELDS {' '.join(names)[:60]}", "FIELDS, SIZE, TYPE and COUNT")
    types: list[tuple[str, str]] = []
    for name, size, kind, count in zip(names, sizes, kinds, counts, strict=True):
        # Fields of several numbers, and the padding that PCL names "_", are passed over.
        several = int(count) > 1 or name == "_"
        code = f"<{kind.lower()}{size}"
        types += [(f"_{len(types) + k}" if several else name, code) for k in range(int(count))]
    points = (entries.get("POINTS") or [""])[0]
    table = _table(body, types, _count(points, path), path, is_text=form == "ascii")
    return {name: column for name, column in table.items() if not name.startswith("_")}


def _split_header(data: bytes, last: str, path: Path) -> tuple[list[str], bytes]:
    """Return the lines of a header up to the one that begins with `last`, and what follows it."""
    end = re.search(rb"(?m)^" + last.encode() + rb"\b[^\n]*\n", data[:_MAX_HEADER])
    if end is None:
        raise _damaged(path, "no end of the header", f"a line {last}")
    text = data[: end.end()].decode("ascii", "replace")
    lines = [line for line in text.splitlines() if not line.startswith(("#", "comment"))]
    return lines or [""], data[end.end() :]


def _count(text: str, path: Path) -> int:
    if not _COUNT.fullmatch(text) or int(text) > _MAX_POINTS:
        raise _damaged(path, f"{text[:40]} points", f"a number of points up to {_MAX_POINTS}")
    return int(text)


def _table(
    body: bytes, types: Sequence[tuple[str, str]], n: int, path: Path, *, is_text: bool
) -> Columns:
    """Return the columns of `n` rows, after a check that the file has them."""
    if len({name for name, _ in types}) < len(types):
        raise _damaged(path, "two columns of one name", "each name once")
    if is_text:
        return _text_table(body, types, n, path)
    row = np.dtype(list(types))
    if len(body) < n * row.itemsize:
        raise _damaged(path, f"{len(body)} bytes", f"{n * row.itemsize} bytes for {n} points")
    table = np.frombuffer(body, row, n)
    return {name: table[name].astype(table[name].dtype.newbyteorder("=")) for name, _ in types}


def _text_table(body: bytes, types: Sequence[tuple[str, str]], n: int, path: Path) -> Columns:
    words = body.split(None, n * len(types))[: n * len(types)]
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise _damaged(path, f"{error}"[:80], "numbers") from error
    if len(numbers) != n * len(types):
        raise _damaged(path, f"{len(numbers)} numbers", f"{n * len(types)} for {n} points")
    # Columns of text stay doubles: conversion to their own type could overflow.
    return dict(zip((name for name, _ in types), numbers.reshape(n, len(types)).T, strict=True))


def _damaged(path: Path, got: str, expected: str) -> InputError:
    return InputError(
        "the file of points cannot be read",
        where=path,
        got=got,
        expected=expected,
        remedy="Write the file again.",
    )
