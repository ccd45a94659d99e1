"""Damaged pandas tables: columns, types, rows and values, in every pickle protocol."""

from __future__ import annotations

import gzip
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lightsim.datasets.files import read_packed
from lightsim.datasets.safe_pickle import MAX_BYTES, read_table

from .hostile_pickles import BUILDERS
from .mutations import Rng, mutate_bytes, pick

_CELLS: tuple[Any, ...] = (
    np.nan, np.inf, -np.inf, 0.0, -1.0, 1e300, -1e300, 1e5, 1e9, 1e-320, 2**31, 2**62, "x", "",
    None, True, "../../outside", "/outside", "a/b", "\0", "x" * 5000, "é\n\x1b[2J",
)  # fmt: skip
_TYPES = ("float32", "float16", "int8", "int64", "uint64", "bool", "object", "str", "complex64",
          "datetime64[ns]", "datetime64[s]", "category", "longdouble", "string", "Int64",
          "boolean", "Float64")  # fmt: skip


def mutate_table_file(path: Path, rng: Rng) -> str:
    """A table file with one to three changes of its content, or of its bytes."""
    way = rng.random()
    if way < 0.2:
        data, words = mutate_bytes(path.read_bytes(), rng)
        path.write_bytes(data)
        return f"{path.name}, file {words}"
    if way < 0.45:
        data, words = mutate_bytes(read_packed(path, MAX_BYTES), rng)
        _pack(path, data)
        return f"{path.name}, pickle {words}"
    columns: dict[str, Any] = dict(read_table(path, ()))
    words_: list[str] = []
    for _ in range(int(rng.integers(1, 4))):
        columns, word = _mutate_columns(columns, rng)
        words_.append(word)
    _write(path, pd.DataFrame(columns), pick(rng, (2, 3, 4, 5)))
    return f"{path.name}: {'; '.join(words_)}"


def write_hostile_pickle(path: Path, canary: Path, rng: Rng) -> str:
    """One of the library; now and then with damage on top."""
    builder = pick(rng, BUILDERS)
    data = builder(canary, rng)
    words = ""
    if rng.random() < 0.3:
        data, words = mutate_bytes(data, rng)
    _pack(path, data)
    return f"{path.name}: pickle {builder.__name__} {words}"


def _write(path: Path, table: pd.DataFrame, protocol: int) -> None:
    _pack(path, pickle.dumps(table, protocol=protocol))


def _pack(path: Path, data: bytes) -> None:
    """With gzip as the file's name tells."""
    path.write_bytes(gzip.compress(data, 1) if path.suffix == ".gz" else data)


def _mutate_columns(columns: dict[str, Any], rng: Rng) -> tuple[dict[str, Any], str]:
    names = list(columns)
    if not names:
        return {"x": np.zeros(3)}, "a column of zeros"
    name = pick(rng, names)
    values = np.asarray(columns[name])
    way = int(rng.integers(8))
    if way == 0:
        return {k: v for k, v in columns.items() if k != name}, f"without {name}"
    if way == 1:
        return {**columns, name: np.asarray(columns[pick(rng, names)])}, f"{name} is another column"
    if way == 2:
        return columns | {name: _of_type(values, pick(rng, _TYPES))}, f"{name} of another type"
    if way == 3:
        return _other_rows(columns, rng)
    if way == 4 and values.dtype.kind in "fiu":
        factor = pick(rng, (-1.0, 0.0, 1e-3, 10.0, 1e3, 1e6, 1e30, 1e300))
        with np.errstate(all="ignore"):
            return columns | {name: values.astype(float) * factor}, f"{name} times {factor:g}"
    if way == 5:
        cell = pick(rng, _CELLS)
        return columns | {name: np.array([cell] * len(values))}, f"all of {name} is {cell!r:.40}"
    cell = pick(rng, _CELLS)
    is_odd = isinstance(cell, str | type(None) | bool) or values.dtype.kind not in "fiub"
    kind = object if is_odd else values.dtype
    kind = float if values.dtype.kind in "iub" and kind is not object else kind
    changed = values.astype(kind)
    if len(changed):
        with np.errstate(all="ignore"):
            changed[int(rng.integers(len(changed)))] = cell
    return columns | {name: changed}, f"a cell of {name} is {cell!r:.40}"


def _of_type(values: np.ndarray, name: str) -> Any:
    try:
        with np.errstate(all="ignore"):
            return pd.Series(values).astype(name)
    except (TypeError, ValueError, OverflowError):
        return pd.Series(values).astype(str)


def _other_rows(columns: dict[str, Any], rng: Rng) -> tuple[dict[str, Any], str]:
    table = pd.DataFrame(columns)
    way = pick(rng, ("none", "one", "half", "doubled", "shuffled", "reversed"))
    n = len(table)
    rows = {
        "none": np.arange(0),
        "one": np.arange(min(n, 1)),
        "half": np.arange(n // 2),
        "doubled": np.arange(2 * n) % max(n, 1),
        "shuffled": rng.permutation(n),
        "reversed": np.arange(n)[::-1],
    }[way]
    return {str(k): v.to_numpy() for k, v in table.iloc[rows].items()}, f"rows: {way}"
