"""Tables from pickled pandas data frames, without pandas and without running anything in them.

A pickle is a program. Here a small machine of ours runs it (`pickle_machine`), with the few
instructions that data frames need, and every name it asks for is answered by an inert stand-in of
ours, or refused. So the same code reads what pandas 0.25 to 3 wrote, whichever pandas is
installed. No stand-in prints, compares or copies what it is given beyond the bounds below.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from lightsim.datasets.files import read_gzip
from lightsim.datasets.pickle_machine import MAX_STEPS, PickleMachine, RefusedError
from lightsim.errors import InputError

Table = Mapping[str, Shaped[np.ndarray, " n"]]
"""Columns by name, all of one length."""

MAX_BYTES = 128 << 20
"""Two million points in eight columns of doubles; a sweep of PandaSet takes 8 MB."""
MAX_ROWS = 2_000_000
"""PandaSet's sweeps have 170,000 points; three LiDARs of 128 lines together 1.4 million."""
MAX_COLUMNS = 256
"""PandaSet's label files have 17."""
MAX_TEXT = 1000
"""Characters of a cell or column name; a uuid has 36."""

_NUMBER_CODES = frozenset(("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"))
_OBJECT_CODES = frozenset(("O", "O4", "O8"))
_BYTE_ORDERS = frozenset("<>|=")
_CELLS = (str, int, float, bool)
_DAMAGE = (ArithmeticError, AttributeError, LookupError, MemoryError, TypeError, ValueError)
"""How damaged bytes fail inside the machine."""


class _Budget:
    """What one file may still make that does not lie in its bytes already.

    Args:
        n_bytes: size of the file, decompressed.
    """

    def __init__(self, n_bytes: int) -> None:
        # A table encodes each of its texts once, and each cell of objects has an instruction.
        self._encoded, self._cells = n_bytes, MAX_STEPS

    def take_encoded(self, count: int) -> None:
        """Counts `count` encoded bytes; RefusedError past the budget."""
        self._encoded -= count
        if self._encoded < 0:
            raise RefusedError("more encoded bytes than the file has")

    def take_cells(self, count: int) -> None:
        """Counts `count` cells of objects; RefusedError past the budget."""
        self._cells -= count
        if self._cells < 0:
            raise RefusedError("more objects than a table has")


class _Dtype:
    """Stand-in for numpy.dtype: plain numbers, booleans and object columns only."""

    def __init__(self, _: _Budget, code: Any, *flags: Any) -> None:
        if type(code) is not str or code not in _NUMBER_CODES | _OBJECT_CODES:
            got = repr(code[:20]) if type(code) is str else _kind(code)
            raise RefusedError(f"a column of type {got}")
        self._code = code
        self._order = "<"

    def set_state(self, state: Any) -> None:
        """Takes the byte order of numpy's (version, order, ...); RefusedError for another form."""
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        if type(order) is not str or order not in _BYTE_ORDERS:
            raise RefusedError("a damaged column type")
        self._order = order

    def numpy(self) -> np.dtype:
        """The true dtype."""
        if self._code in _OBJECT_CODES:
            return np.dtype(object)
        return np.dtype(self._order + self._code)


class _Array:
    """Stand-in for numpy.ndarray; `values` is set when its state arrives."""

    def __init__(self, budget: _Budget) -> None:
        self._budget = budget
        self.values: np.ndarray | None = None

    def set_state(self, state: Any) -> None:
        """Takes numpy's (version, shape, dtype, is_fortran, data)."""
        if not isinstance(state, tuple) or len(state) != 5:
            raise RefusedError("a damaged array")
        _, shape, dtype, is_fortran, data = state
        self.fill(data, dtype, shape, is_fortran is True)

    def fill(self, data: Any, dtype: Any, shape: Any, is_fortran: bool) -> None:
        """Numbers are seen where they lie in the file, cells of objects are copied."""
        if not isinstance(dtype, _Dtype):
            raise RefusedError("an array without a type")
        is_shape = isinstance(shape, tuple) and len(shape) in (1, 2)
        if not is_shape or any(type(n) is not int or not 0 <= n <= MAX_ROWS for n in shape):
            raise RefusedError("an array that is no column and no block of columns")
        kind = dtype.numpy()
        if kind.hasobject and type(data) is list:
            self._budget.take_cells(len(data))
            flat = np.empty(len(data), dtype=object)
            flat[:] = [_cell(value) for value in data]
        elif type(data) is bytes and not kind.hasobject:
            flat = np.frombuffer(data, dtype=kind)
        else:
            raise RefusedError("a damaged array")
        self.values = flat.reshape(shape, order="F" if is_fortran else "C")


class _StringArray:
    """Stand-in for the text column of pandas 3: an object array under a wrapper."""

    def __init__(self, _: _Budget) -> None:
        self.values: np.ndarray | None = None

    def set_state(self, state: Any) -> None:
        """Takes the only array of the state; RefusedError for none or several."""
        parts = state if isinstance(state, tuple) else ()
        arrays = [item for item in parts if isinstance(item, _Array)]
        if len(arrays) != 1:
            raise RefusedError("a damaged text column")
        self.values = arrays[0].values


class _Slice:
    """Stand-in for slice, of column numbers."""

    def __init__(self, _: _Budget, start: Any, stop: Any, step: Any = None) -> None:
        if any(n is not None and type(n) is not int for n in (start, stop, step)):
            raise RefusedError("a slice of no numbers")
        self.slice = slice(start, stop, step)


class _Inert:
    """Stand-in for a type that carries no cell of the table."""

    def __init__(self, *arguments: Any) -> None: ...

    def set_state(self, state: Any) -> None:
        """Ignores the state."""


class _Index:
    """Stand-in for the column names; the row index is read and ignored."""

    def __init__(self, _: _Budget, data: Any = None) -> None:
        self.data = data


class _Manager:
    """Stand-in for BlockManager: (values, placement) of every block, and the axes."""

    def __init__(self, _: _Budget, blocks: Any = (), axes: Any = ()) -> None:
        self.blocks = blocks
        self.axes = axes

    def set_state(self, state: Any) -> None:
        """Takes blocks and axes of pandas before 1.3; RefusedError for another form."""
        # pandas < 1.3 keeps its blocks under this key for the sake of older readers.
        extra = state[3] if isinstance(state, tuple) and len(state) == 4 else None
        versioned = extra.get("0.14.1") if isinstance(extra, dict) else None
        if not isinstance(versioned, dict) or not {"axes", "blocks"} <= set(versioned):
            raise RefusedError("a block manager of an unknown version")
        self.axes = versioned["axes"]
        blocks = _bounded(versioned["blocks"])
        self.blocks = tuple((block["values"], block["mgr_locs"]) for block in blocks)


class _Frame:
    """Stand-in for DataFrame."""

    def __init__(self, _: _Budget) -> None:
        self.manager: _Manager | None = None

    def set_state(self, state: Any) -> None:
        """Takes the block manager, bare or in pandas' dict; RefusedError without one."""
        if isinstance(state, dict):
            state = state.get("_mgr", state.get("_data"))
        if not isinstance(state, _Manager):
            raise RefusedError("a data frame without blocks")
        self.manager = state


def _new_array(budget: _Budget, kind: Any, *arguments: Any) -> _Array:
    if not _stands_for(kind, _Array):
        raise RefusedError("an array of another type")
    return _Array(budget)


def _from_buffer(
    budget: _Budget, data: Any, dtype: Any, shape: Any, order: Any, *axes: Any
) -> _Array:
    array = _Array(budget)
    array.fill(data, dtype, shape, type(order) is str and order == "F")
    return array


def _new_block(_: _Budget, values: Any, placement: Any, *dimensions: Any) -> tuple[Any, Any]:
    return values, placement


def _new_index(budget: _Budget, kind: Any, state: Any) -> _Index:
    return _Index(budget, state.get("data") if isinstance(state, dict) else None)


def _new_backed(budget: _Budget, kind: Any, *arguments: Any) -> _StringArray | _Inert:
    return _StringArray(budget) if _stands_for(kind, _StringArray) else _Inert()


def _encode(budget: _Budget, text: Any, encoding: Any) -> bytes:
    if type(text) is not str or type(encoding) is not str or encoding != "latin1":
        raise RefusedError("bytes in an unknown encoding")
    budget.take_encoded(len(text))
    return text.encode("latin1")


@dataclass(frozen=True, eq=False)
class _Name:
    """A name of theirs in a pickle, and the function of ours that answers it."""

    function: Callable[..., Any]
    budget: _Budget

    def make(self, *arguments: Any) -> Any:
        """What the pickle's call of this name gives."""
        return self.function(self.budget, *arguments)


_STAND_INS: dict[tuple[str, str], Callable[..., Any]] = {
    ("pandas", "DataFrame"): _Frame,
    ("pandas.core.frame", "DataFrame"): _Frame,
    ("pandas.core.internals.managers", "BlockManager"): _Manager,
    ("pandas.core.internals", "BlockManager"): _Manager,
    ("pandas._libs.internals", "_unpickle_block"): _new_block,
    ("pandas._libs.arrays", "__pyx_unpickle_NDArrayBacked"): _new_backed,
    ("pandas.arrays", "StringArray"): _StringArray,
    ("pandas", "StringDtype"): _Inert,
    ("pandas.core.indexes.base", "_new_Index"): _new_index,
    ("pandas.core.indexes.base", "Index"): _Index,
    ("pandas", "Index"): _Index,
    ("pandas.core.indexes.range", "RangeIndex"): _Inert,
    ("pandas", "RangeIndex"): _Inert,
    ("pandas.core.indexes.numeric", "Int64Index"): _Inert,
    ("numpy.core.multiarray", "_reconstruct"): _new_array,
    ("numpy._core.multiarray", "_reconstruct"): _new_array,
    ("numpy.core.numeric", "_frombuffer"): _from_buffer,
    ("numpy._core.numeric", "_frombuffer"): _from_buffer,
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("builtins", "slice"): _Slice,
    ("__builtin__", "slice"): _Slice,
    ("_codecs", "encode"): _encode,
}


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
            got=", ".join(table)[:400] or "no columns",
            expected=", ".join(columns),
        )
    return table


def parse_table(data: bytes, where: object) -> Table:
    """The columns of a pickled data frame.

    Raises:
        InputError: the bytes are no pickled table; nothing in them was run.
    """
    budget = _Budget(len(data))

    def find(module: str, name: str) -> _Name:
        function = _STAND_INS.get((module, name))
        if function is None:
            raise RefusedError(f"the global '{module[:60]}.{name[:60]}'")
        return _Name(function, budget)

    try:
        return _columns(PickleMachine(find).run(data))
    except RefusedError as error:
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
            got=f"{type(error).__name__}: {str(error)[:80]!r}",
            remedy="Copy the file again from the original data set.",
        ) from error


def _cell(value: Any) -> str | int | float | bool | None:
    """A cell as it is; what is no number and no text, such as a missing value, becomes None."""
    if type(value) is str and len(value) > MAX_TEXT:
        raise RefusedError(f"a text of {len(value)} characters")
    return value if type(value) in _CELLS else None


def _columns(frame: Any) -> Table:
    if not isinstance(frame, _Frame) or frame.manager is None:
        raise RefusedError(f"a {_kind(frame)} instead of a data frame")
    names = _names(_bounded(frame.manager.axes)[0])
    table: dict[str, np.ndarray] = {}
    for values, placement in _bounded(frame.manager.blocks):
        block = np.atleast_2d(_values(values))
        positions = _positions(placement, len(names))
        if len(positions) != len(block):
            raise RefusedError("a block of other columns than it says")
        table.update({names[i]: column for i, column in zip(positions, block, strict=True)})
    if len(table) != len(names) or len({len(c) for c in table.values()}) > 1:
        raise RefusedError("columns of unequal length")
    return {name: table[name] for name in names}


def _names(axis: Any) -> list[str]:
    if not isinstance(axis, _Index):
        raise RefusedError(f"a {_kind(axis)} instead of column names")
    names = _values(axis.data)
    if names.ndim != 1 or len(names) > MAX_COLUMNS or any(type(n) is not str for n in names):
        raise RefusedError(f"column names that are not up to {MAX_COLUMNS} texts")
    return names.tolist()


def _values(holder: Any) -> np.ndarray:
    if not isinstance(holder, (_Array, _StringArray)) or holder.values is None:
        raise RefusedError(f"a {_kind(holder)} instead of values")
    return holder.values


def _positions(placement: Any, n: int) -> list[int]:
    if isinstance(placement, _Slice):
        return list(range(n))[placement.slice]
    numbers = _values(placement)
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu" or len(numbers) > n:
        raise RefusedError("a block without column numbers")
    return numbers.tolist()


def _bounded(items: Any) -> Sequence[Any]:
    """A list or tuple of no more parts than a table has columns."""
    if not isinstance(items, (list, tuple)) or len(items) > MAX_COLUMNS:
        raise RefusedError(f"no list of at most {MAX_COLUMNS} parts")
    return items


def _stands_for(name: Any, function: Callable[..., Any]) -> bool:
    return isinstance(name, _Name) and name.function is function


def _kind(value: Any) -> str:
    """Only the type of an untrusted object is ever put into words: nested ones print for ever."""
    return type(value).__name__.strip("_")
