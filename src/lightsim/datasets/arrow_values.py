"""Stand-ins for Apache Arrow columns of a pickled data frame, read without pyarrow.

Since version 3, pandas stores text in this form if pyarrow is installed. An array is a type, a
length and buffers: bits of validity, then numbers, or offsets and UTF-8 (Arrow Columnar Format 1.5,
"Physical memory layout").
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from lightsim.datasets.pickle_machine import RefusedError
from lightsim.datasets.pickle_values import (
    MAX_ROWS,
    SECONDS_BY_UNIT,
    Budget,
    Values,
    checked_text,
    chosen,
    seconds_of,
    without_missing,
)

_CODE_BY_TYPE = {
    "int8": "<i1", "int16": "<i2", "int32": "<i4", "int64": "<i8",
    "uint8": "<u1", "uint16": "<u2", "uint32": "<u4", "uint64": "<u8",
    "halffloat": "<f2", "float": "<f4", "double": "<f8",
}  # fmt: skip
_OFFSETS_BY_TYPE = {"string": "<i4", "large_string": "<i8"}
# Largest number of chunks: pandas joins them on writing, Arrow's readers make one for 64k rows or
# more.
_MAX_CHUNKS = 10_000


@dataclass(frozen=True, eq=False)
class ArrowType:
    """Type of an Arrow array.

    Args:
        name: name in Arrow, such as "double" or "string".
        unit_s: unit of times and durations, in seconds.
        index: type of the codes, for dictionaries.
    """

    name: str
    unit_s: float | None = None
    index: ArrowType | None = None


def type_for_alias(_: Budget, name: Any) -> ArrowType:
    """Safe replacement of pyarrow's `type_for_alias(name)`."""
    if type(name) is not str:
        raise RefusedError("a damaged Arrow type")
    return ArrowType(name[:40])


def time_type(_: Budget, unit: Any, *zone: Any) -> ArrowType:
    """Safe replacement of pyarrow's `timestamp(unit, zone)` and `duration(unit)`.

    Times are UTC in any zone.
    """
    if type(unit) is not str or unit not in SECONDS_BY_UNIT:
        raise RefusedError("a damaged Arrow type")
    return ArrowType("int64", SECONDS_BY_UNIT[unit])


def dictionary_type(_: Budget, index: Any, *arguments: Any) -> ArrowType:
    """Safe replacement of pyarrow's `dictionary(index, value, is_ordered)`."""
    if not isinstance(index, ArrowType):
        raise RefusedError("a damaged Arrow type")
    return ArrowType("dictionary", index=index)


def buffer(_: Budget, data: Any) -> bytes:
    """Safe replacement of pyarrow's `py_buffer(bytes)`."""
    if type(data) is not bytes:
        raise RefusedError("a damaged Arrow buffer")
    return data


class ArrowArray(Values):
    """Stand-in for pyarrow's arrays, of one chunk or of several."""


def restore_array(budget: Budget, parts: Any) -> ArrowArray:
    """Safe replacement of pyarrow's `_restore_array`."""
    made = ArrowArray(budget)
    made.values = _values(budget, parts)
    return made


def chunked_array(budget: Budget, chunks: Any, *_: Any) -> ArrowArray:
    """Safe replacement of pyarrow's `chunked_array(chunks, type)`."""
    is_list = isinstance(chunks, (list, tuple)) and 0 < len(chunks) <= _MAX_CHUNKS
    if not is_list or not all(isinstance(chunk, ArrowArray) for chunk in chunks):
        raise RefusedError("a damaged Arrow column")
    values = [chunk.values for chunk in chunks]
    budget.take("numbers", sum(len(part) for part in values))
    made = ArrowArray(budget)
    made.values = np.concatenate(values)
    return made


class ArrowColumn(Values):
    """Stand-in for pandas' columns around an Arrow array."""

    def set_state(self, state: Any) -> None:
        """Set the values from the array in pandas' dict."""
        array = state.get("_pa_array", state.get("_data")) if isinstance(state, dict) else None
        if not isinstance(array, ArrowArray):
            raise RefusedError("a damaged Arrow column")
        self.values = array.values


def _values(budget: Budget, parts: Any) -> np.ndarray:
    """Return the cells of (type, length, nulls, offset, buffers, children, dictionary)."""
    if not isinstance(parts, tuple) or len(parts) != 7:
        raise RefusedError("a damaged Arrow array")
    # Offsets arise from slices: several arrays may be views of the same buffers.
    kind, length, _, offset, buffers, _, dictionary = parts
    is_sane = isinstance(kind, ArrowType) and isinstance(buffers, list) and 1 <= len(buffers) <= 3
    if not is_sane or any(b is not None and type(b) is not bytes for b in buffers):
        raise RefusedError("a damaged Arrow array")
    if any(type(n) is not int or not 0 <= n <= MAX_ROWS for n in (length, offset)):
        raise RefusedError("an Arrow array that is no column")
    span = slice(offset, offset + length)
    is_null = ~_bits(budget, buffers[0], span) if buffers[0] is not None else None
    if kind.name in _OFFSETS_BY_TYPE and len(buffers) == 3:
        return _texts(budget, kind, buffers[1:], span, is_null)
    # Null cells may have any code, also one that is out of range: replaced before the look-up.
    if kind.index is not None:
        codes = _numbers(budget, kind.index, buffers, span)
        codes = codes if is_null is None else np.where(is_null, -1, codes.astype(np.int64))
        budget.take("numbers", codes.size)
        return chosen(_values(budget, _without_dictionary(dictionary)), codes, budget)
    if kind.name == "null":
        budget.take("numbers", length)
        return np.full(length, np.nan)
    numbers = _numbers(budget, kind, buffers, span)
    if kind.unit_s is not None:
        numbers = seconds_of(numbers, kind.unit_s, budget)
    return numbers if is_null is None else without_missing(numbers, is_null, budget)


def _without_dictionary(parts: Any) -> Any:
    """Return the array of a dictionary, which must not have a dictionary itself."""
    if isinstance(parts, tuple) and len(parts) == 7 and parts[6] is None:
        return parts
    raise RefusedError("a damaged Arrow dictionary")


def _numbers(budget: Budget, kind: ArrowType, buffers: list[Any], span: slice) -> np.ndarray:
    data = buffers[1] if len(buffers) == 2 else None
    if kind.name == "bool" and data is not None:
        return _bits(budget, data, span)
    code = _CODE_BY_TYPE.get(kind.name)
    if code is None or data is None:
        raise RefusedError(f"an Arrow column of type '{kind.name}'")
    return _part(data, code, span)


def _part(data: bytes, code: str, span: slice) -> np.ndarray:
    width = np.dtype(code).itemsize
    if len(data) < span.stop * width:
        raise RefusedError("an Arrow buffer that is too short")
    return np.frombuffer(data, code, span.stop - span.start, span.start * width)


def _bits(budget: Budget, data: bytes, span: slice) -> np.ndarray:
    """Return bits as booleans, the lowest of each byte first."""
    # The whole prefix is unpacked, hence the budget of `stop` bits, not of the length of the span.
    budget.take("numbers", span.stop)
    if 8 * len(data) < span.stop:
        raise RefusedError("an Arrow buffer that is too short")
    packed = np.frombuffer(data, np.uint8, (span.stop + 7) // 8)
    return np.unpackbits(packed, count=span.stop, bitorder="little")[span].astype(bool)


def _texts(
    budget: Budget, kind: ArrowType, buffers: list[Any], span: slice, is_null: np.ndarray | None
) -> np.ndarray:
    length = span.stop - span.start
    budget.take("objects", length)
    texts = np.empty(length, dtype=object)
    if length == 0:
        return texts
    starts, data = buffers[0], buffers[1] or b""
    if starts is None:
        raise RefusedError("an Arrow buffer that is too short")
    bounds = _part(starts, _OFFSETS_BY_TYPE[kind.name], slice(span.start, span.stop + 1))
    if bounds[0] < 0 or bounds[-1] > len(data) or (bounds[1:] < bounds[:-1]).any():
        raise RefusedError("an Arrow text outside its buffer")
    budget.take("decoded bytes", int(bounds[-1] - bounds[0]))
    ends = bounds.tolist()
    texts[:] = [checked_text(data[start:end].decode()) for start, end in pairwise(ends)]
    if is_null is not None:
        texts[is_null] = None
    return texts
