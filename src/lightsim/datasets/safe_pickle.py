"""Tables from pickled pandas data frames, without pandas and without executing their content.

A pickle is a program. A small interpreter runs it (`pickle_machine`), with the few instructions
that data frames need; every imported name becomes an inert stand-in or is refused. The same code
reads files of pandas 0.25 to 3, independent of the installed version, with columns of Arrow
(`arrow_values`), categories, masks and times (`pickle_values`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64, Shaped

from lightsim.datasets import arrow_values, pickle_values
from lightsim.datasets.files import read_packed
from lightsim.datasets.pickle_machine import PickleMachine, RefusedError
from lightsim.datasets.pickle_values import Budget, Index, Inert, Name, kind_of, values_of
from lightsim.errors import InputError

Table = Mapping[str, Shaped[np.ndarray, " n"]]
"""Columns by name, all of one length."""


class LabelledTable(dict[str, Shaped[np.ndarray, " n"]]):
    """A table with the integers of its row index: None for an index of another type, such as
    pandas' default, 0 to n - 1."""

    row_labels: Int64[np.ndarray, " n"] | None = None


MAX_BYTES = 128 << 20
"""Largest decompressed file. Two million points in eight columns of doubles; a sweep of PandaSet
takes 8 MB."""
MAX_COLUMNS = 256
"""Largest number of columns. PandaSet's label files have 17."""

# Exceptions of the interpreter on damaged bytes.
_DAMAGE = (ArithmeticError, AttributeError, LookupError, MemoryError, TypeError, ValueError)


class _Slice:
    """Stand-in for slice, with column indices."""

    def __init__(self, _: Budget, start: Any, stop: Any, step: Any = None) -> None:
        if any(n is not None and type(n) is not int for n in (start, stop, step)):
            raise RefusedError("a slice of no numbers")
        self.slice = slice(start, stop, step)


class _Manager:
    """Stand-in for BlockManager: (values, placement) of every block, and the axes."""

    def __init__(self, _: Budget, blocks: Any = (), axes: Any = ()) -> None:
        self.blocks = blocks
        self.axes = axes

    def set_state(self, state: Any) -> None:
        """Set blocks and axes from the state of pandas before 1.3; RefusedError for other forms."""
        # pandas < 1.3 stores its blocks under this key for older readers.
        extra = state[3] if isinstance(state, tuple) and len(state) == 4 else None
        versioned = extra.get("0.14.1") if isinstance(extra, dict) else None
        if not isinstance(versioned, dict) or not {"axes", "blocks"} <= set(versioned):
            raise RefusedError("a block manager of an unknown version")
        self.axes = versioned["axes"]
        blocks = _bounded(versioned["blocks"])
        self.blocks = tuple((block["values"], block["mgr_locs"]) for block in blocks)


class _Frame:
    """Stand-in for DataFrame."""

    def __init__(self, _: Budget) -> None:
        self.manager: _Manager | None = None

    def set_state(self, state: Any) -> None:
        """Set the block manager, bare or in pandas' dict; RefusedError without one."""
        if isinstance(state, dict):
            state = state.get("_mgr", state.get("_data"))
        if not isinstance(state, _Manager):
            raise RefusedError("a data frame without blocks")
        self.manager = state


def _new_block(_: Budget, values: Any, placement: Any, *dimensions: Any) -> tuple[Any, Any]:
    return values, placement


def _new_index(budget: Budget, _: Any, state: Any) -> Index:
    return Index(budget, state.get("data") if isinstance(state, dict) else None)


# Modules and names of column types in pandas.
_DTYPES = {
    ("pandas", "pandas.core.dtypes.dtypes"): ("ArrowDtype", "DatetimeTZDtype"),
    ("pandas", "pandas.core.arrays.string_"): ("StringDtype",),
    ("pandas", "pandas.core.arrays.arrow.dtype"): ("ArrowDtype",),
    ("pandas", "pandas.core.arrays.boolean"): ("BooleanDtype",),
    ("pandas", "pandas.core.arrays.floating"): ("Float32Dtype", "Float64Dtype"),
    ("pandas", "pandas.core.arrays.integer"): tuple(
        f"{sign}{bits}Dtype" for sign in ("Int", "UInt") for bits in (8, 16, 32, 64)
    ),
}
_ROW_INDEXES = {
    "range": "RangeIndex", "multi": "MultiIndex", "category": "CategoricalIndex",
    "datetimes": "DatetimeIndex", "timedeltas": "TimedeltaIndex",
}  # fmt: skip
# Names of types and cells that carry no number and no text of the table.
_INERT = (
    *((module, name) for modules, names in _DTYPES.items() for module in modules for name in names),
    *((f"pandas.core.indexes.{module}", name) for module, name in _ROW_INDEXES.items()),
    *(("pandas", name) for name in _ROW_INDEXES.values()),
    *(("pandas.core.indexes.numeric", f"{kind}Index") for kind in ("Int64", "UInt64", "Float64")),
    ("pandas.core.indexes.datetimes", "_new_DatetimeIndex"),
    ("pandas.core.indexes.frozen", "FrozenList"),
    # Missing values and single times in object columns: cells without a number or a text.
    ("pandas", "NA"),
    ("pandas._libs.missing", "NA"),
    ("pandas._libs.tslibs.nattype", "_nat_unpickle"),
    ("pandas._libs.tslibs.nattype", "__nat_unpickle"),
    ("pandas._libs.tslibs.timestamps", "_unpickle_timestamp"),
    *(("datetime", name) for name in ("datetime", "date", "timedelta", "timezone")),
    ("pytz", "_UTC"),
    ("pytz", "_p"),
    ("zoneinfo", "ZoneInfo._unpickle"),
)
_BACKED = {
    "categorical": "Categorical", "datetimes": "DatetimeArray", "timedeltas": "TimedeltaArray",
    "string_": "StringArray",
}  # fmt: skip
_MASKED = {"integer": "IntegerArray", "floating": "FloatingArray", "boolean": "BooleanArray"}
_ARROW_COLUMNS = {
    "string_arrow": ("ArrowStringArray", "ArrowStringArrayNumpySemantics"),
    "arrow.array": ("ArrowExtensionArray",),
}


def _array_names() -> dict[tuple[str, str], Callable[..., Any]]:
    """Return the stand-ins of pandas' column types, under the names of all versions."""
    found: dict[tuple[str, str], Callable[..., Any]] = {}
    columns = [(m, (n,), pickle_values.Backed) for m, n in _BACKED.items()]
    columns += [(m, (n,), pickle_values.Masked) for m, n in _MASKED.items()]
    columns += [(m, n, arrow_values.ArrowColumn) for m, n in _ARROW_COLUMNS.items()]
    for module, names, stand_in in columns:
        for name in names:
            for place in (f"pandas.core.arrays.{module}", "pandas.arrays", "pandas"):
                found[place, name] = stand_in
    return found


_STAND_INS: dict[tuple[str, str], Callable[..., Any]] = {
    **dict.fromkeys(_INERT, Inert),
    **_array_names(),
    ("pandas", "DataFrame"): _Frame,
    ("pandas.core.frame", "DataFrame"): _Frame,
    ("pandas.core.internals.managers", "BlockManager"): _Manager,
    ("pandas.core.internals", "BlockManager"): _Manager,
    ("pandas._libs.internals", "_unpickle_block"): _new_block,
    ("pandas._libs.arrays", "__pyx_unpickle_NDArrayBacked"): pickle_values.new_backed,
    ("pandas", "CategoricalDtype"): pickle_values.Categories,
    ("pandas.core.dtypes.dtypes", "CategoricalDtype"): pickle_values.Categories,
    ("pandas.core.indexes.base", "_new_Index"): _new_index,
    ("pandas.core.indexes.base", "Index"): Index,
    ("pandas", "Index"): Index,
    ("numpy", "ndarray"): pickle_values.Array,
    ("numpy", "dtype"): pickle_values.Dtype,
    **{
        (f"numpy.{core}.{module}", name): function
        for core in ("core", "_core")
        for module, name, function in (
            ("multiarray", "_reconstruct", pickle_values.new_array),
            ("multiarray", "scalar", pickle_values.new_scalar),
            ("numeric", "_frombuffer", pickle_values.from_buffer),
        )
    },
    **{
        (module, name): function
        for module in ("builtins", "__builtin__")
        for name, function in (
            ("slice", _Slice),
            ("bytes", pickle_values.new_bytes),
            ("bytearray", pickle_values.new_bytes),
        )
    },
    ("_codecs", "encode"): pickle_values.encode,
    ("pyarrow.lib", "_restore_array"): arrow_values.restore_array,
    ("pyarrow.lib", "chunked_array"): arrow_values.chunked_array,
    ("pyarrow.lib", "py_buffer"): arrow_values.buffer,
    ("pyarrow.lib", "type_for_alias"): arrow_values.type_for_alias,
    ("pyarrow.lib", "dictionary"): arrow_values.dictionary_type,
    ("pyarrow.lib", "timestamp"): arrow_values.time_type,
    ("pyarrow.lib", "duration"): arrow_values.time_type,
}
# Module with the steps of a row index of times, one class each.
_OFFSETS = "pandas._libs.tslibs.offsets"


def read_table(path: Path, columns: Sequence[str]) -> LabelledTable:
    """Return the columns of a pickled data frame (`.pkl`, or with gzip `.pkl.gz`).

    Args:
        path: the file; gzip is recognised by its first bytes, whatever the name.
        columns: required names; other columns are returned, too.

    Raises:
        InputError: the file is missing, damaged, too large, more than a table of numbers and text,
            or lacks a column.
    """
    table = parse_table(read_packed(path, MAX_BYTES), path, columns)
    missing = [name for name in columns if name not in table]
    if missing:
        raise InputError(
            f"the column '{missing[0]}' is missing",
            where=path,
            got=", ".join(table)[:400] or "no columns",
            expected=", ".join(columns),
        )
    return table


def parse_table(data: bytes, where: object, columns: Sequence[str] = ()) -> LabelledTable:
    """Return the columns of a pickled data frame.

    Args:
        where: the file, for messages.
        columns: required names, for messages.

    Raises:
        InputError: the bytes are no pickled table; none of their content was executed.
    """
    # One budget for all stand-ins of a file.
    budget = Budget(len(data))

    def find(module: str, name: str) -> Name:
        function = _STAND_INS.get((module, name), Inert if module == _OFFSETS else None)
        if function is None:
            raise RefusedError(f"the global '{module[:60]}.{name[:60]}'")
        return Name(function, budget)

    try:
        return _columns(PickleMachine(find).run(data))
    except RefusedError as error:
        needed = ", ".join(columns) or "that are needed"
        raise InputError(
            "the pickle contains an object that no table needs; none of its code was run",
            where=where,
            got=error,
            remedy="Use the file of the data set itself. If you wrote this one, write it again "
            f"with the columns {needed} alone, as numbers, booleans and text.",
        ) from error
    except _DAMAGE as error:
        raise InputError(
            "the pickle is damaged",
            where=where,
            got=f"{type(error).__name__}: {str(error)[:80]!r}",
            remedy="Copy the file again from the original data set.",
        ) from error


def names_in(data: bytes, where: object) -> frozenset[tuple[str, str]]:
    """Return module and name of every global of a pickled table.

    Raises:
        InputError: as `parse_table`.
    """
    found: set[tuple[str, str]] = set()
    budget = Budget(len(data))

    def find(module: str, name: str) -> Name:
        found.add((module, name))
        return Name(_STAND_INS.get((module, name), Inert), budget)

    try:
        PickleMachine(find).run(data)
    except (RefusedError, *_DAMAGE) as error:
        raise InputError(
            "the pickle is not a table",
            where=where,
            got=str(error)[:80],
            expected="a pickled pandas data frame",
        ) from error
    return frozenset(found)


def _columns(frame: Any) -> LabelledTable:
    if not isinstance(frame, _Frame) or frame.manager is None:
        raise RefusedError(f"a {kind_of(frame)} instead of a data frame")
    axes = _bounded(frame.manager.axes)
    names = _names(axes[0])
    table: dict[str, np.ndarray] = {}
    for values, placement in _bounded(frame.manager.blocks):
        # Blocks are [column, row]; blocks of extension types hold a single column without that
        # axis.
        block = np.atleast_2d(values_of(values))
        positions = _positions(placement, len(names))
        if len(positions) != len(block):
            raise RefusedError("a block whose columns do not match its index")
        table.update({names[i]: column for i, column in zip(positions, block, strict=True)})
    if len(table) != len(names) or len({len(c) for c in table.values()}) > 1:
        raise RefusedError("columns of unequal length")
    found = LabelledTable({name: table[name] for name in names})
    labels = axes[1].values if len(axes) > 1 and isinstance(axes[1], Index) else None
    if labels is not None and labels.ndim == 1 and labels.dtype.kind in "iu":
        found.row_labels = labels.astype(np.int64)
    return found


def _names(axis: Any) -> list[str]:
    if not isinstance(axis, Index) or axis.values is None:
        raise RefusedError("column names that are not texts")
    names = axis.values
    if names.ndim != 1 or len(names) > MAX_COLUMNS or any(type(n) is not str for n in names):
        raise RefusedError(f"column names that are not up to {MAX_COLUMNS} texts")
    return names.tolist()


def _positions(placement: Any, n: int) -> list[int]:
    if isinstance(placement, _Slice):
        # Slicing a list bounds the result, whatever the numbers of the slice are.
        return list(range(n))[placement.slice]
    numbers = values_of(placement)
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu" or len(numbers) > n:
        raise RefusedError("a block without column numbers")
    return numbers.tolist()


def _bounded(items: Any) -> Sequence[Any]:
    """Return a list or tuple with at most as many items as a table has columns."""
    if not isinstance(items, (list, tuple)) or len(items) > MAX_COLUMNS:
        raise RefusedError(f"no list of at most {MAX_COLUMNS} parts")
    return items
