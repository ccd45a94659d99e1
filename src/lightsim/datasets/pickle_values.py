"""Stand-ins for the values in a pickled data frame: numpy arrays and the column types of pandas.

No stand-in prints or compares its input, or copies it beyond the limits below. Missing values
become None in text and NaN in numbers; times and durations become seconds (times: POSIX).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lightsim.datasets.pickle_machine import RefusedError

MAX_ROWS = 2_000_000
"""Largest number of rows. PandaSet's sweeps have 170,000 points; three LiDARs of 128 lines together
1.4 million."""
MAX_TEXT = 1000
"""Longest cell or column name, in characters; a uuid has 36."""
# Largest number of object cells of a file: one text column of the longest table, or 400 of a label
# file.
_MAX_CELLS = 2_000_000
# Largest number of converted numbers of a file: twice all columns of the longest sweep.
_MAX_NUMBERS = 32_000_000

_NUMBER_CODES = frozenset(("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"))
_TIME_CODES = frozenset(("M8", "m8"))
_OBJECT_CODES = frozenset(("O", "O4", "O8"))
_BYTE_ORDERS = frozenset("<>|=")
# Units of NumPy and Arrow times.
SECONDS_BY_UNIT = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
# NumPy's "not a time".
_NO_TIME = np.iinfo(np.int64).min
_CELLS = (str, int, float, bool)


class Budget:
    """Limit of the objects that one file may create beyond its own bytes.

    Args:
        n_bytes: size of the file, decompressed.
    """

    def __init__(self, n_bytes: int) -> None:
        # A table encodes each text once, and decodes each text column once.
        self._left = {
            "encoded bytes": n_bytes,
            "decoded bytes": n_bytes,
            "objects": _MAX_CELLS,
            "numbers": _MAX_NUMBERS,
        }

    def take(self, what: str, count: int) -> None:
        """Count created objects; raise RefusedError beyond the budget.

        Args:
            what: "encoded bytes", "decoded bytes", "objects" or "numbers".
        """
        self._left[what] -= count
        if self._left[what] < 0:
            raise RefusedError(f"more {what} than a table has")


@dataclass(frozen=True, eq=False)
class Name:
    """Imported name of a pickle, with the function that replaces it."""

    function: Callable[..., Any]
    budget: Budget

    def make(self, *arguments: Any) -> Any:
        """Return the result of the pickle's call of this name."""
        return self.function(self.budget, *arguments)


class Inert:
    """Stand-in for a type without cells of the table."""

    def __init__(self, *arguments: Any) -> None: ...

    def set_state(self, state: Any) -> None:
        """Ignore the state."""


class Values:
    """Base class of stand-ins with cells; `values` is assigned by `set_state`."""

    def __init__(self, budget: Budget, *_: Any) -> None:
        self.budget = budget
        self.values: np.ndarray | None = None


def values_of(holder: Any) -> np.ndarray:
    """Return the cells of a stand-in; raise RefusedError if it has none."""
    if not isinstance(holder, Values) or holder.values is None:
        raise RefusedError(f"a {kind_of(holder)} instead of values")
    return holder.values


class Dtype:
    """Stand-in for numpy.dtype: numbers, booleans, times and object columns only."""

    def __init__(self, _: Budget, code: Any, *flags: Any) -> None:
        known = _NUMBER_CODES | _OBJECT_CODES | _TIME_CODES
        # "U0" occurs in a cache of pandas, but not in arrays.
        if type(code) is not str or code not in known | {"U0"}:
            got = repr(code[:20]) if type(code) is str else kind_of(code)
            raise RefusedError(f"a column of type {got}")
        self._code = code
        self._order = "<"
        self.seconds: float | None = None
        """Unit of a time, in seconds."""

    def set_state(self, state: Any) -> None:
        """Set byte order and unit from numpy's (version, order, ...); RefusedError for others."""
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        if type(order) is not str or order not in _BYTE_ORDERS:
            raise RefusedError("a damaged column type")
        self._order = order
        if self._code in _TIME_CODES:
            self.seconds = _unit_s(state[8] if len(state) == 9 else None)

    def numpy(self) -> np.dtype:
        """Return the NumPy dtype; times are integers in their unit."""
        if self._code in _OBJECT_CODES:
            return np.dtype(object)
        if self._code == "U0" or (self._code in _TIME_CODES and self.seconds is None):
            raise RefusedError("a damaged column type")
        return np.dtype(self._order + ("i8" if self._code in _TIME_CODES else self._code))


def _unit_s(metadata: Any) -> float:
    """Return the seconds of NumPy's (metadata, (unit, number, denominator, events))."""
    unit = metadata[1] if isinstance(metadata, tuple) and len(metadata) == 2 else None
    name = unit[0] if isinstance(unit, tuple) and len(unit) == 4 else None
    if type(name) is bytes:
        name = name[:2].decode("ascii", "replace")
    length_s = SECONDS_BY_UNIT.get(name) if type(name) is str else None
    if length_s is None or not isinstance(unit, tuple) or unit[1:3] != (1, 1):
        raise RefusedError("a time of another unit than s, ms, us or ns")
    return length_s


class Array(Values):
    """Stand-in for numpy.ndarray."""

    def set_state(self, state: Any) -> None:
        """Set the values from numpy's (version, shape, dtype, is_fortran, data)."""
        if not isinstance(state, tuple) or len(state) != 5:
            raise RefusedError("a damaged array")
        _, shape, dtype, is_fortran, data = state
        self.fill(data, dtype, shape, is_fortran is True)

    def fill(self, data: Any, dtype: Any, shape: Any, is_fortran: bool) -> None:
        """View numbers in place, copy object cells, convert times."""
        if not isinstance(dtype, Dtype):
            raise RefusedError("an array without a type")
        # Blocks of pandas have two axes, columns and rows; nothing in a table has three.
        is_shape = isinstance(shape, tuple) and len(shape) in (1, 2)
        if not is_shape or any(type(n) is not int or not 0 <= n <= MAX_ROWS for n in shape):
            raise RefusedError("an array that is no column and no block of columns")
        kind = dtype.numpy()
        if kind.hasobject and type(data) is list:
            flat = _cells(data, self.budget)
        elif type(data) is bytes and not kind.hasobject:
            flat = np.frombuffer(data, dtype=kind)
        else:
            raise RefusedError("a damaged array")
        if dtype.seconds is not None:
            flat = seconds_of(flat, dtype.seconds, self.budget)
        self.values = flat.reshape(shape, order="F" if is_fortran else "C")


def seconds_of(counts: np.ndarray, unit_s: float, budget: Budget) -> np.ndarray:
    """Convert counts of a unit to seconds; "not a time" becomes NaN."""
    budget.take("numbers", counts.size)
    # Whole seconds are converted separately: nanoseconds since 1970 as a float round to 0.2 us.
    per_second = round(1.0 / unit_s)
    whole, rest = np.divmod(counts, per_second)
    return np.where(counts == _NO_TIME, np.nan, whole + rest / per_second)


def _cells(data: list[Any], budget: Budget) -> np.ndarray:
    budget.take("objects", len(data))
    flat = np.empty(len(data), dtype=object)
    flat[:] = [_cell(value) for value in data]
    return flat


def _cell(value: Any) -> str | int | float | bool | None:
    """Return a number or text; any other cell, such as a missing value, becomes None."""
    if type(value) is str:
        return checked_text(value)
    return value if type(value) in _CELLS else None


def checked_text(text: str) -> str:
    """Return a text; raise RefusedError if it is too long for a cell."""
    if len(text) > MAX_TEXT:
        raise RefusedError(f"a text of {len(text)} characters")
    return text


class Index(Values):
    """Stand-in for column names, categories and integer labels of rows."""

    def __init__(self, budget: Budget, data: Any = None) -> None:
        super().__init__(budget)
        self.values = data.values if isinstance(data, Values) else None


class Categories:
    """Stand-in for the type of a column of categories."""

    def __init__(self, _: Budget, *arguments: Any) -> None:
        self.categories: Any = arguments[0] if arguments else None

    def set_state(self, state: Any) -> None:
        """Set the categories from pandas' dict."""
        self.categories = state.get("categories") if isinstance(state, dict) else None


class Backed(Values):
    """Stand-in for columns that wrap one array: texts, times, and codes of categories."""

    def set_state(self, state: Any) -> None:
        """Set the values from the only array of the state; RefusedError for none or several."""
        parts = tuple(state.values()) if isinstance(state, dict) else state
        parts = parts if isinstance(parts, tuple) else ()
        arrays = [item for item in parts if isinstance(item, Array)]
        if len(arrays) != 1:
            raise RefusedError("a damaged column")
        types = [item for item in parts if isinstance(item, Categories)]
        values = values_of(arrays[0])
        if types:
            values = chosen(values_of(types[0].categories), values, self.budget)
        self.values = values


def chosen(choices: np.ndarray, codes: np.ndarray, budget: Budget) -> np.ndarray:
    """Return the choice of each code; negative codes are missing values."""
    if choices.ndim != 1 or codes.dtype.kind not in "iu":
        raise RefusedError("damaged categories")
    budget.take("objects" if choices.dtype.hasobject else "numbers", codes.size)
    is_missing = codes < 0
    if codes.size and int(codes.max()) >= len(choices):
        raise RefusedError("a missing category")
    if not is_missing.any():
        return choices[codes]
    padded = np.append(choices, np.array([None], object)) if choices.dtype.hasobject else None
    # A missing value is appended as one more choice, which negative codes select.
    if padded is None:
        padded = np.append(choices.astype(np.float64), np.nan)
    return padded[np.where(is_missing, len(choices), codes)]


class Masked(Values):
    """Stand-in for columns of pandas with a mask of missing values (Int64, boolean, Float64)."""

    def set_state(self, state: Any) -> None:
        """Set values and mask from pandas' dict."""
        if not isinstance(state, dict):
            raise RefusedError("a damaged column")
        values, mask = values_of(state.get("_data")), values_of(state.get("_mask"))
        self.values = without_missing(values, mask, self.budget)


def without_missing(values: np.ndarray, is_missing: np.ndarray, budget: Budget) -> np.ndarray:
    """Return numbers unchanged if none is missing, else as floats with NaN."""
    is_fit = is_missing.dtype == np.bool_ and is_missing.shape == values.shape
    if not is_fit or values.dtype.kind not in "biuf":
        raise RefusedError("a damaged column")
    if not is_missing.any():
        return values
    budget.take("numbers", values.size)
    return np.where(is_missing, np.nan, values)


def new_backed(budget: Budget, kind: Any, _: Any = None, state: Any = None) -> Any:
    """Safe replacement of pandas' `__pyx_unpickle_NDArrayBacked(type, checksum, state)`."""
    if not is_replaced_by(kind, Backed):
        return Inert()
    made = Backed(budget)
    if state is not None:
        made.set_state(state)
    return made


def new_array(budget: Budget, kind: Any, *arguments: Any) -> Array:
    """Safe replacement of numpy's `_reconstruct(type, shape, code)`."""
    if not is_replaced_by(kind, Array):
        raise RefusedError("an array of another type")
    return Array(budget)


def from_buffer(budget: Budget, data: Any, dtype: Any, shape: Any, order: Any, *axes: Any) -> Array:
    """Safe replacement of numpy's `_frombuffer(data, dtype, shape, order)`."""
    array = Array(budget)
    array.fill(data, dtype, shape, type(order) is str and order == "F")
    return array


def new_scalar(_: Budget, dtype: Any, data: Any = None) -> int | float | bool | None:
    """Safe replacement of numpy's `scalar(dtype, bytes)`: a single number among objects."""
    kind = dtype.numpy() if isinstance(dtype, Dtype) else None
    if kind is None or kind.hasobject or type(data) is not bytes or len(data) != kind.itemsize:
        return None
    return np.frombuffer(data, dtype=kind)[0].item() if dtype.seconds is None else None


def encode(budget: Budget, text: Any, encoding: Any) -> bytes:
    """Safe replacement of `_codecs.encode`, by which old protocols store bytes."""
    is_latin = type(encoding) is str and encoding in ("latin1", "latin-1")
    if type(text) is not str or not is_latin:
        raise RefusedError("bytes in an unknown encoding")
    budget.take("encoded bytes", len(text))
    return text.encode("latin1")


def new_bytes(budget: Budget, data: Any = b"", encoding: Any = None) -> bytes:
    """Safe replacement of `bytes` and `bytearray`, by which old protocols store buffers."""
    if encoding is not None:
        return encode(budget, data, encoding)
    if type(data) is not bytes:
        raise RefusedError("a damaged buffer")
    return data


def is_replaced_by(name: Any, function: Callable[..., Any]) -> bool:
    """Return whether a value is a name that a function of this package replaces."""
    return isinstance(name, Name) and name.function is function


def kind_of(value: Any) -> str:
    """Return the name of a value's type; untrusted objects are never printed themselves."""
    return type(value).__name__.strip("_").lower()
