"""Tables from pickled pandas data frames, without pandas and without running anything in them.

A pickle is a program. Here its opcodes are checked first against the few that data frames need,
and every name it asks for is answered by an inert stand-in of ours, or refused. So the same code
reads what pandas 0.25 to 3 wrote, whichever pandas is installed.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from lightsim.errors import InputError
from lightsim.ingest.files import read_gzip

Table = Mapping[str, Shaped[np.ndarray, " n"]]
"""Columns by name, all of one length."""

MAX_BYTES = 256 * 1024 * 1024
_MAX_OPCODES = 2_000_000
_MAX_TUPLES = 10_000
"""Hashing a deeper nest of tuples would exhaust the interpreter's C stack."""

_OPCODE_NAMES = (
    "PROTO FRAME STOP MARK POP POP_MARK DUP NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG "
    "LONG1 FLOAT BINFLOAT STRING BINSTRING SHORT_BINSTRING UNICODE BINUNICODE SHORT_BINUNICODE "
    "BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8 EMPTY_LIST EMPTY_TUPLE EMPTY_DICT LIST TUPLE "
    "TUPLE1 TUPLE2 TUPLE3 DICT APPEND APPENDS SETITEM SETITEMS GET BINGET LONG_BINGET PUT BINPUT "
    "LONG_BINPUT MEMOIZE GLOBAL STACK_GLOBAL REDUCE NEWOBJ BUILD"
)
_OPCODES = frozenset(_OPCODE_NAMES.split())
_MEMO_OPCODES = frozenset({"PUT", "BINPUT", "LONG_BINPUT", "GET", "BINGET", "LONG_BINGET"})
_TUPLE_OPCODES = frozenset({"TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"})


_DAMAGE = (
    pickle.UnpicklingError,
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
)
"""How damaged bytes fail inside the unpickler."""


class _RefusedError(Exception):
    """Something a pickled table never contains."""


class _StandIn:
    """Base of all names a pickle can reach. Every one refuses state it does not know, so that no
    pickle can write attributes onto our classes."""

    def __setstate__(self, state: Any) -> None:
        raise _RefusedError("state for an object that has none")


class _Dtype(_StandIn):
    """Stand-in for numpy.dtype: plain numbers, booleans and object columns only."""

    def __init__(self, code: Any, *flags: Any) -> None:
        if not isinstance(code, str) or code[:1] not in "fiubO" or not code[1:].isdigit():
            raise _RefusedError(f"a column of type {str(code)[:40]!r}")
        self.code = code
        self.order = "<"

    def __setstate__(self, state: Any) -> None:
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        if order not in ("<", ">", "|", "="):
            raise _RefusedError("a damaged column type")
        self.order = order

    def numpy(self) -> np.dtype:
        return np.dtype(object) if self.code[0] == "O" else np.dtype(self.order + self.code)


class _Array(_StandIn):
    """Stand-in for numpy.ndarray; `values` is set when its state arrives."""

    values: np.ndarray | None = None

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise _RefusedError("a damaged array")
        _, shape, dtype, is_fortran, data = state
        if not isinstance(dtype, _Dtype):
            raise _RefusedError("an array without a type")
        self.values = _array(data, dtype.numpy(), shape, bool(is_fortran))


class _StringArray(_StandIn):
    """Stand-in for the text column of pandas 3: an object array under a wrapper."""

    values: np.ndarray | None = None

    def __setstate__(self, state: Any) -> None:
        arrays = [item for item in state if isinstance(item, _Array)]
        if len(arrays) != 1:
            raise _RefusedError("a damaged text column")
        self.values = arrays[0].values


class _Slice(_StandIn):
    def __init__(self, start: Any, stop: Any, step: Any = None) -> None:
        self.bounds = (start, stop, step)


class _Inert(_StandIn):
    """Stand-in for a type that carries no cell of the table."""

    def __init__(self, *arguments: Any) -> None: ...

    def __setstate__(self, state: Any) -> None: ...


class _Index(_StandIn):
    """Stand-in for the column names; the row index is read and ignored."""

    def __init__(self, data: Any = None) -> None:
        self.data = data


class _Manager(_StandIn):
    """Stand-in for BlockManager: (placement, values) of every block, and the column names."""

    def __init__(self, blocks: Any = (), axes: Any = ()) -> None:
        self.blocks = blocks
        self.axes = axes

    def __setstate__(self, state: Any) -> None:
        # pandas < 1.3 keeps its blocks under this key for the sake of older readers.
        extra = state[3] if isinstance(state, tuple) and len(state) == 4 else None
        versioned = extra.get("0.14.1") if isinstance(extra, dict) else None
        if not isinstance(versioned, dict) or not {"axes", "blocks"} <= set(versioned):
            raise _RefusedError("a block manager of an unknown version")
        self.axes = versioned["axes"]
        self.blocks = tuple((b["values"], b["mgr_locs"]) for b in versioned["blocks"])


class _Frame(_StandIn):
    """Stand-in for DataFrame."""

    manager: _Manager | None = None

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, dict):
            state = state.get("_mgr", state.get("_data"))
        if not isinstance(state, _Manager):
            raise _RefusedError("a data frame without blocks")
        self.manager = state


def _reconstruct(kind: Any, *arguments: Any) -> _Array:
    if kind is not _Array:
        raise _RefusedError("an array of another type")
    return _Array()


def _from_buffer(data: Any, dtype: Any, shape: Any, order: Any, *axes: Any) -> _Array:
    if not isinstance(dtype, _Dtype):
        raise _RefusedError("an array without a type")
    array = _Array()
    array.values = _array(data, dtype.numpy(), shape, order == "F")
    return array


def _unpickle_block(values: Any, placement: Any, *dimensions: Any) -> tuple[Any, Any]:
    return values, placement


def _new_index(kind: Any, state: Any) -> _Index:
    data = state.get("data") if isinstance(state, dict) else None
    return _Index(data)


def _unpickle_backed(kind: Any, *arguments: Any) -> Any:
    return kind() if kind is _StringArray else _Inert()


def _encode(text: Any, encoding: Any) -> bytes:
    if not isinstance(text, str) or encoding != "latin1":
        raise _RefusedError("bytes in an unknown encoding")
    return text.encode("latin1")


class _Function(_StandIn):
    """A function of ours under the name of one of theirs."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function

    def __call__(self, *arguments: Any) -> Any:
        return self.function(*arguments)


_STAND_INS: dict[tuple[str, str], Any] = {
    ("pandas", "DataFrame"): _Frame,
    ("pandas.core.frame", "DataFrame"): _Frame,
    ("pandas.core.internals.managers", "BlockManager"): _Manager,
    ("pandas.core.internals", "BlockManager"): _Manager,
    ("pandas._libs.internals", "_unpickle_block"): _Function(_unpickle_block),
    ("pandas._libs.arrays", "__pyx_unpickle_NDArrayBacked"): _Function(_unpickle_backed),
    ("pandas.arrays", "StringArray"): _StringArray,
    ("pandas", "StringDtype"): _Inert,
    ("pandas.core.indexes.base", "_new_Index"): _Function(_new_index),
    ("pandas.core.indexes.base", "Index"): _Index,
    ("pandas", "Index"): _Index,
    ("pandas.core.indexes.range", "RangeIndex"): _Inert,
    ("pandas", "RangeIndex"): _Inert,
    ("pandas.core.indexes.numeric", "Int64Index"): _Inert,
    ("numpy.core.multiarray", "_reconstruct"): _Function(_reconstruct),
    ("numpy._core.multiarray", "_reconstruct"): _Function(_reconstruct),
    ("numpy.core.numeric", "_frombuffer"): _Function(_from_buffer),
    ("numpy._core.numeric", "_frombuffer"): _Function(_from_buffer),
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("builtins", "slice"): _Slice,
    ("__builtin__", "slice"): _Slice,
    ("_codecs", "encode"): _Function(_encode),
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str, /) -> Any:
        stand_in = _STAND_INS.get((module, name))
        if stand_in is None:
            raise _RefusedError(f"the global '{module}.{name}'")
        return stand_in


def read_table(path: Path, columns: Sequence[str]) -> Table:
    """The wanted columns of a gzipped, pickled data frame (`.pkl.gz`).

    Args:
        path: the file.
        columns: names that must be there; other columns are returned too.

    Raises:
        InputError: the file is missing, damaged, too large, asks for anything but a table of
            numbers and text, or lacks a column.
    """
    table = parse_table(read_gzip(path, MAX_BYTES), path)
    missing = [name for name in columns if name not in table]
    if missing:
        raise InputError(
            f"the column '{missing[0]}' is missing",
            where=path,
            got=", ".join(table) or "no columns",
            expected=", ".join(columns),
        )
    return table


def parse_table(data: bytes, where: object) -> Table:
    """The columns of a pickled data frame.

    Raises:
        InputError: the bytes are no pickled table; nothing in them was run.
    """
    try:
        _check_opcodes(data)
        frame = _Unpickler(io.BytesIO(data)).load()
        return _columns(frame)
    except _RefusedError as error:
        raise InputError(
            "the pickle holds something that no table needs; nothing in it was run",
            where=where,
            got=error,
            remedy="Use the files of the data set itself, or write them again with "
            "pandas.DataFrame.to_pickle.",
        ) from error
    except _DAMAGE as error:
        raise InputError(
            "the pickle is damaged",
            where=where,
            got=f"{type(error).__name__}: {str(error)[:80]}",
            remedy="Copy the file again from the original data set.",
        ) from error


def _check_opcodes(data: bytes) -> None:
    # The C unpickler allocates its memo up to the largest index named, so a 6-byte pickle could
    # ask for 64 GB: bound the index before it runs.
    n_tuples = 0
    for n, (opcode, argument, _) in enumerate(pickletools.genops(data)):
        if opcode.name not in _OPCODES:
            raise _RefusedError(f"the instruction {opcode.name}")
        if opcode.name in _MEMO_OPCODES and not 0 <= int(argument or 0) <= _MAX_OPCODES:
            raise _RefusedError(f"a memo index of {argument}")
        n_tuples += opcode.name in _TUPLE_OPCODES
        if n > _MAX_OPCODES or n_tuples > _MAX_TUPLES:
            raise _RefusedError("more objects than a table has")


def _array(data: Any, dtype: np.dtype, shape: Any, is_fortran: bool) -> np.ndarray:
    is_shape = isinstance(shape, tuple) and all(type(n) is int and n >= 0 for n in shape)
    if not is_shape or len(shape) > 2:
        raise _RefusedError("an array of more than two dimensions")
    if dtype.hasobject:
        if not isinstance(data, list):
            raise _RefusedError("a damaged object array")
        flat = np.empty(len(data), dtype=object)
        flat[:] = [v if isinstance(v, (str, int, float, bool)) else None for v in data]
    else:
        flat = np.frombuffer(bytes(data) if isinstance(data, bytearray) else data, dtype=dtype)
    return flat.reshape(shape, order="F" if is_fortran else "C")


def _columns(frame: Any) -> Table:
    if not isinstance(frame, _Frame) or frame.manager is None:
        raise _RefusedError(f"a {type(frame).__name__.strip('_')} instead of a data frame")
    names = [str(name) for name in _values(frame.manager.axes[0].data)]
    table: dict[str, np.ndarray] = {}
    for block, placement in frame.manager.blocks:
        values = np.atleast_2d(_values(block))
        positions = _positions(placement, len(names))
        for position, column in zip(positions, values, strict=True):
            table[names[position]] = column
    if len(table) != len(names) or len({len(c) for c in table.values()}) > 1:
        raise _RefusedError("columns of unequal length")
    return {name: table[name] for name in names}


def _values(holder: Any) -> np.ndarray:
    if not isinstance(holder, (_Array, _StringArray)) or holder.values is None:
        raise _RefusedError(f"a {type(holder).__name__.strip('_')} instead of values")
    return holder.values


def _positions(placement: Any, n: int) -> list[int]:
    if isinstance(placement, _Slice):
        return list(range(n))[slice(*placement.bounds)]
    return [int(i) for i in _values(placement)]
