"""Damaged Feather files: bytes, sizes of compressed buffers, and well-formed tables of nonsense."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from .mutations import VALUES, Rng, mutate_bytes, pick

# First bytes of an LZ4 frame, which follow the claimed size of a buffer.
_FRAME = b"\x04\x22\x4d\x18"
_SIZES = (0, 1, -1, -2, 2**20, 2**31, 2**40, 2**62, -(2**63))
_NUMBERS = (
    0, 1, -1, 63, 64, 255, 2**31, 2**62, 2**63 - 1, -(2**63), 0.5, 1e-300, 1e15, 1e16, 1e300,
    float("nan"), float("inf"), float("-inf"), None,
)  # fmt: skip
_TYPES = (
    "int8", "uint64", "int64", "float16", "float32", "float64", "string", "large_string", "bool_",
    "binary", "date32", "null",
)  # fmt: skip


def mutate_feather(path: Path, rng: Rng) -> str:
    """Damage a Feather file, and return what was done in words."""
    way = rng.random()
    data = path.read_bytes()
    if way < 0.3:
        data, words = mutate_bytes(data, rng)
    elif way < 0.4 and _FRAME in data:
        data, words = _other_size(data, rng)
    else:
        return f"{path.name}: {_other_table(path, rng)}"
    path.write_bytes(data)
    return f"{path.name}: {words}"


def _other_size(data: bytes, rng: Rng) -> tuple[bytes, str]:
    frames = [i for i in range(len(data)) if data.startswith(_FRAME, i)]
    at, size = pick(rng, frames) - 8, pick(rng, _SIZES)
    return data[:at] + struct.pack("<q", size) + data[at + 8 :], f"a buffer claims {size} bytes"


def _other_table(path: Path, rng: Rng) -> str:
    import pyarrow as pa
    from pyarrow import feather

    table: Any = feather.read_table(str(path), memory_map=False, use_threads=False)
    index = int(rng.integers(table.num_columns))
    name = table.column_names[index]
    way = pick(
        rng, ("cell", "cell", "cell", "column", "type", "removed", "doubled", "rows", "order")
    )
    if way == "removed":
        table = table.remove_column(index)
    elif way == "doubled":
        table = table.append_column(name, table.column(index))
    elif way == "rows":
        table = table.slice(0, int(rng.integers(3)))
    elif way == "order":
        table = table.take(pa.array(rng.integers(0, max(1, table.num_rows), table.num_rows)))
    elif way == "type":
        kind = pick(rng, _TYPES)
        table = table.set_column(index, name, _cast(table.column(index), kind))
        way = f"becomes {kind}"
    else:
        cells = table.column(index).to_pylist()
        value = pick(rng, (*_NUMBERS, *VALUES))
        rows = range(len(cells)) if way == "column" else [int(rng.integers(len(cells)))]
        for row in rows:
            cells[row] = value
        table = table.set_column(index, name, _array(cells, table.column(index).type))
        way = f"{way} becomes {value!r:.60}"
    feather.write_feather(table, str(path), compression=pick(rng, ("lz4", "uncompressed", "zstd")))
    return f"{name}: {way}"


def _cast(column: Any, kind: str) -> Any:
    import pyarrow as pa

    try:
        return column.cast(getattr(pa, kind)(), safe=False)
    except pa.ArrowException:
        return pa.nulls(len(column), getattr(pa, kind)())


def _array(cells: list[Any], kind: Any) -> Any:
    """Return an array of the old type if the cells fit into it, else of a type that they fit."""
    import pyarrow as pa

    for other in (kind, None, pa.float64(), pa.string()):
        try:
            return pa.array(cells, other)
        except (pa.ArrowException, OverflowError, UnicodeError, TypeError, ValueError):
            continue
    texts = [str(cell).encode(errors="replace").decode() for cell in cells]
    return pa.array(np.array(texts, dtype=object), pa.string())
