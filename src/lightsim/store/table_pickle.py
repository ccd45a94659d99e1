"""Writer of pickled data frames that pandas 1.0 to 3 and NumPy 1.20 to 2 load.

`DataFrame.to_pickle` writes names of the installed versions of pandas and NumPy (`numpy._core`,
`_unpickle_block`), which older versions do not have. This module writes the instructions one by
one, in the form of PandaSet's own files (pandas 0.25), which all later versions read.
"""

from __future__ import annotations

import pickle
import struct
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np
from jaxtyping import Shaped

# Globals in the pickle: module and name.
_FRAME = ("pandas.core.frame", "DataFrame")
_MANAGER = ("pandas.core.internals.managers", "BlockManager")
_NEW_INDEX = ("pandas.core.indexes.base", "_new_Index")
_INDEX = ("pandas.core.indexes.base", "Index")
_RANGE = ("pandas.core.indexes.range", "RangeIndex")
_NEW_ARRAY = ("numpy.core.multiarray", "_reconstruct")
_ARRAY = ("numpy", "ndarray")
_DTYPE = ("numpy", "dtype")
_SLICE = ("builtins", "slice")
# All globals in these pickles; they exist in pandas 1.0 to 3 and NumPy 1.20 to 2.
PORTABLE_NAMES = frozenset(
    (_FRAME, _MANAGER, _NEW_INDEX, _INDEX, _RANGE, _NEW_ARRAY, _ARRAY, _DTYPE, _SLICE)
)
# Types of the cells of object columns.
_CELLS = (str, int, float, bool, type(None))


def pickled_frame(columns: Mapping[str, Shaped[np.ndarray, " n"]], index_name: str | None) -> bytes:
    """Return a pickled data frame.

    Args:
        columns: numbers, booleans, or objects that are text, numbers, booleans or None; at least
            one column, all of one length.
        index_name: name of the index, which counts the rows from 0.

    Raises:
        TypeError: a column or a cell has another type.
    """
    count = len(next(iter(columns.values())))
    # The appended None prevents NumPy from making an array of fixed-width text.
    names = np.array([*columns, None], dtype=object)[:-1]
    axes = [
        _call(_NEW_INDEX, _global(_INDEX), _dict(data=_array(names), name=_plain(None))),
        _call(
            _NEW_INDEX,
            _global(_RANGE),
            _dict(name=_plain(index_name), start=_plain(0), stop=_plain(count), step=_plain(1)),
        ),
    ]
    manager = _dict(axes=_list(axes), blocks=_list(_blocks(list(columns.values()))))
    # "0.14.1" is the version of this form of a BlockManager's state in pandas.
    state = _tuple([_list(axes), _list([]), _list([]), b"}" + _plain("0.14.1") + manager + b"s"])
    frame = _dict(
        _data=_new(_MANAGER, state),
        _typ=_plain("dataframe"),
        _metadata=_list([]),
        # pandas 1.0 stores attributes under this name, and fails without it.
        _attrs=_dict(),
    )
    # Protocol 3 is the oldest with an instruction for bytes.
    return b"\x80\x03" + _new(_FRAME, frame) + b"."


def _blocks(columns: Sequence[np.ndarray]) -> list[bytes]:
    """Return one block for each run of adjacent columns of one type, with one row per column."""
    blocks: list[bytes] = []
    for _, some in groupby(enumerate(columns), key=lambda item: item[1].dtype):
        numbers, values = zip(*some, strict=True)
        place = _call(_SLICE, *map(_plain, (numbers[0], numbers[-1] + 1, 1)))
        blocks.append(_dict(values=_array(np.stack(values)), mgr_locs=place))
    return blocks


def _array(values: np.ndarray) -> bytes:
    if values.dtype.hasobject:
        cells = [c.item() if isinstance(c, np.generic) else c for c in values.ravel().tolist()]
        wrong = {type(cell).__name__ for cell in cells if type(cell) not in _CELLS}
        if wrong:
            raise TypeError(f"cells of a table are text, numbers and booleans, not {sorted(wrong)}")
        # 63 are the flags of NumPy's dtype of objects; dtypes of numbers have none.
        dtype, content = _dtype("O8", "|", 63), _plain(cells)
    elif values.dtype.kind in "biuf":
        little = values.astype(values.dtype.newbyteorder("<"))
        code = f"{little.dtype.kind}{little.dtype.itemsize}"
        dtype = _dtype(code, "|" if little.dtype.itemsize == 1 else "<", 0)
        content = _bytes(little.tobytes())
    else:
        raise TypeError(f"a column of type {values.dtype}")
    made = _call(_NEW_ARRAY, _global(_ARRAY), _plain((0,)), _bytes(b"b"))
    shape = _plain(tuple(values.shape))
    return made + _tuple([_plain(1), shape, dtype, _plain(False), content]) + b"b"


def _dtype(code: str, order: str, flags: int) -> bytes:
    return (
        _call(_DTYPE, _plain(code), _plain(0), _plain(1))
        + _plain((3, order, None, None, None, -1, -1, flags))
        + b"b"
    )


def _global(name: tuple[str, str]) -> bytes:
    return f"c{name[0]}\n{name[1]}\n".encode()


def _call(name: tuple[str, str], *arguments: bytes) -> bytes:
    return _global(name) + _tuple(arguments) + b"R"


def _new(name: tuple[str, str], state: bytes) -> bytes:
    """Return the instructions for an object that is made without arguments, and for its state."""
    return _global(name) + b")\x81" + state + b"b"


def _plain(value: Any) -> bytes:
    """Return a pickled value of built-in types, without the instructions PROTO and STOP.

    Protocol 2 has no frames, and its memo entries are only used within the same value.
    """
    return pickle.dumps(value, protocol=2)[2:-1]


def _bytes(data: bytes) -> bytes:
    return b"B" + struct.pack("<I", len(data)) + data


def _tuple(items: Iterable[bytes]) -> bytes:
    return b"(" + b"".join(items) + b"t"


def _list(items: Iterable[bytes]) -> bytes:
    return b"](" + b"".join(items) + b"e"


def _dict(**items: bytes) -> bytes:
    return b"}(" + b"".join(_plain(key) + value for key, value in items.items()) + b"u"
