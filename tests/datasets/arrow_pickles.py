"""Pickles as pandas writes them where pyarrow is installed, made without pyarrow."""

from __future__ import annotations

import io
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Global:
    """A name in a pickle that need not exist here."""

    module: str
    name: str

    def __call__(self, *arguments: Any, state: Any = None) -> Call:
        return Call(self, arguments, state)


@dataclass(frozen=True)
class Call:
    """A call of such a name, and the state that its result is given."""

    function: Global
    arguments: tuple[Any, ...]
    state: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        return self.function, self.arguments, self.state


_Plain: Any = pickle._Pickler  # type: ignore[attr-defined] - unknown to the stubs


class _Pickler(_Plain):
    dispatch = dict(_Plain.dispatch)  # noqa: RUF012

    def save_name(self, name: Global) -> None:
        self.write(f"c{name.module}\n{name.name}\n".encode())

    dispatch[Global] = save_name


def dumped(value: Any, protocol: int = 5) -> bytes:
    """The pickle of a value with such names in it."""
    stream = io.BytesIO()
    _Pickler(stream, protocol).dump(value)
    return stream.getvalue()


def arrow(name: str) -> Global:
    return Global("pyarrow.lib", name)


def alias(name: str) -> Call:
    return arrow("type_for_alias")(name)


def buffer(data: bytes) -> Call:
    return arrow("py_buffer")(bytearray(data))


def bits(truths: Sequence[bool]) -> bytes:
    return np.packbits(np.array(truths), bitorder="little").tobytes()


def array(kind: Any, length: int, buffers: list[Any], offset: int = 0, words: Any = None) -> Call:
    """An array of `length` cells that begin `offset` cells into its buffers."""
    nulls = 0 if buffers[0] is None else 1
    return arrow("_restore_array")((kind, length, nulls, offset, buffers, [], words))


def validity(values: Sequence[Any]) -> Call | None:
    known = [value is not None for value in values]
    return None if all(known) else buffer(bits(known))


def text_parts(values: Sequence[str | None], *, large: bool = True) -> tuple[Any, list[Any]]:
    """Type and buffers of texts."""
    encoded = [(value or "").encode() for value in values]
    ends = np.cumsum([0, *map(len, encoded)])
    offsets = ends.astype("<i8" if large else "<i4").tobytes()
    kind = alias("large_string" if large else "string")
    return kind, [validity(values), buffer(offsets), buffer(b"".join(encoded))]


def words(values: Sequence[str]) -> tuple[Any, ...]:
    """The words of a dictionary."""
    kind, buffers = text_parts(values)
    return (kind, len(values), 0, 0, buffers, [], None)


def texts(values: Sequence[str | None], *, large: bool = True, offset: int = 0) -> Call:
    kind, buffers = text_parts(values, large=large)
    return array(kind, len(values) - offset, buffers, offset)


def numbers(kind: Any, code: str, values: Sequence[Any]) -> Call:
    filled = [0 if value is None else value for value in values]
    data = (
        bits([bool(value) for value in filled]) if code == "?" else np.array(filled, code).tobytes()
    )
    return array(kind, len(values), [validity(values), buffer(data)])


def column(made: Call, name: str = "ArrowExtensionArray") -> Call:
    """A column of pandas 3 around an Arrow array."""
    return Global("pandas.arrays", name)(state={"_pa_array": made, "_cache": {}})


def frame(columns: Mapping[str, Any]) -> bytes:
    """A pickled data frame of such columns, one block each, column names as Arrow text too."""
    block = Global("pandas._libs.internals", "_unpickle_block")
    blocks = tuple(block(value, slice(i, i + 1, 1), 2) for i, value in enumerate(columns.values()))
    new_index = Global("pandas.core.indexes.base", "_new_Index")
    names = {"data": column(texts(list(columns)), "ArrowStringArray"), "name": None}
    rows = {"name": None, "start": 0, "stop": 3, "step": 1}
    axes = [
        new_index(Global("pandas", "Index"), names),
        new_index(Global("pandas", "RangeIndex"), rows),
    ]
    manager = Global("pandas.core.internals.managers", "BlockManager")(blocks, axes)
    return dumped(Global("pandas", "DataFrame")(state={"_mgr": manager, "_typ": "dataframe"}))


def text_frame(table: Mapping[str, Any]) -> bytes:
    """A table of texts and numbers as pandas 3 with pyarrow writes it."""
    columns: dict[str, Any] = {}
    for name, values in table.items():
        if isinstance(values[0], str):
            columns[name] = column(texts(list(values)), "ArrowStringArray")
        else:
            columns[name] = np.array(values)[None]
    return frame(columns)
