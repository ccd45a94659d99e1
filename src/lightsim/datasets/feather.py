"""Reader of untrusted Feather files of version 2, which are Arrow IPC files.

Arrow allocates the sizes that a file claims, also for compressed buffers. The messages of a file
are therefore walked first (Arrow Columnar Format 1.5, "Serialization and Interprocess
Communication", with Message.fbs): pyarrow reads a file only if the sum of its claims is small.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.datasets.safe_pickle import Table
from lightsim.errors import InputError, need
from lightsim.store.foreign import foreign_content
from lightsim.store.reading import read_bytes

# Largest file, and largest content after decompression, in bytes: a sweep of 100,000 returns has
# 1.3 MB.
_MAX_BYTES = 64 << 20
# Largest number of messages: writers make one for 64k rows.
_MAX_MESSAGES = 10_000
# Magic number, padded to 8 bytes, before the first message.
_MAGIC = b"ARROW1\0\0"
# Four bytes before the length of each message.
_CONTINUATION = 0xFFFFFFFF
# Kind of the message with the schema (Message.fbs, union MessageHeader).
_SCHEMA = 1
# Kind of a message with rows.
_RECORD_BATCH = 3
# Position of the kind in the table Message of Message.fbs.
_KIND = 1
# Position of the header in the table Message.
_HEADER = 2
# Position of the body's length in the table Message.
_BODY_LENGTH = 3
# Position of the buffers in the table RecordBatch of Message.fbs.
_BUFFERS = 2
# Position of the compression in the table RecordBatch.
_COMPRESSION = 3
_REMEDY = "Download the file again from the original data set."


def read_feather(
    path: Path,
    numbers: Collection[str],
    *,
    max_rows: int,
    texts: Collection[str] = (),
    optional: Collection[str] = (),
) -> Table:
    """Return columns of a Feather file; columns of text have the type object.

    Args:
        numbers, texts: names of the columns that must exist.
        max_rows: largest accepted number of rows.
        optional: columns of numbers that are returned if they exist.

    Raises:
        InputError: the file is missing, damaged or too large, a column is missing or of another
            type, or a cell is empty.
        MissingDependencyError: pyarrow is not installed.
    """
    need("pyarrow.ipc", extra="arrow")
    data = read_bytes(path, "Feather file", _MAX_BYTES)
    if not data.startswith(_MAGIC):
        found = foreign_content(data)
        raise InputError(
            "the file is not a Feather file of version 2",
            where=path,
            got=found[0] if found else repr(data[:8]),
            expected="an Arrow IPC file, whose first bytes are ARROW1",
            remedy=found[1] if found else _REMEDY,
        )
    _check_claims(data, path)
    table = _arrow_table(data, path)
    if table.num_rows > max_rows:
        raise InputError(
            "the table has too many rows",
            where=path,
            got=table.num_rows,
            expected=f"at most {max_rows}",
        )
    names = [*numbers, *texts, *(name for name in optional if name in table.column_names)]
    return {name: _column(table, name, path, is_text=name in texts) for name in names}


def _arrow_table(data: bytes, path: Path) -> Any:
    """Return the pyarrow table, whose buffers have been checked against the number of rows."""
    import pyarrow as pa
    from pyarrow import ipc

    # Threads would outlive the call, and the tables are small.
    options = ipc.IpcReadOptions(use_threads=False)
    try:
        # After its magic number, a file is a stream, followed by an index that is not needed.
        with ipc.open_stream(pa.py_buffer(data).slice(len(_MAGIC)), options=options) as stream:
            for field in stream.schema:
                _check_type(field, path)
            table = stream.read_all()
        table.validate(full=True)
    except (pa.ArrowException, OSError, ValueError, NotImplementedError, OverflowError) as error:
        raise _damaged(path, error) from error
    return table


def _check_type(field: Any, path: Path) -> None:
    """Reject nested and encoded columns, whose claims are not covered by `_check_claims`."""
    from pyarrow import types

    if not (types.is_primitive(field.type) or _is_text(field.type)):
        raise InputError(
            f"the column '{field.name[:60]}' has an unknown type",
            where=path,
            got=str(field.type)[:60],
            expected="numbers or text",
            remedy=_REMEDY,
        )


def _is_text(kind: Any) -> bool:
    from pyarrow import types

    return types.is_string(kind) or types.is_large_string(kind)


def _column(table: Any, name: str, path: Path, *, is_text: bool) -> np.ndarray:
    from pyarrow import types

    indices = table.schema.get_all_field_indices(name)
    if len(indices) != 1:
        raise InputError(
            f"the column '{name}' is missing" if not indices else f"two columns are named '{name}'",
            where=path,
            got=", ".join(table.column_names)[:300],
            remedy=_REMEDY,
        )
    column = table.column(indices[0])
    kind = column.type
    is_right = _is_text(kind) if is_text else types.is_integer(kind) or types.is_floating(kind)
    if not is_right:
        raise InputError(
            f"the column '{name}' has the wrong type",
            where=path,
            got=str(kind),
            expected="text" if is_text else "numbers",
            remedy=_REMEDY,
        )
    if column.null_count:
        row = column.is_null().to_pylist().index(True)
        raise InputError(
            f"a cell of the column '{name}' is empty",
            where=f"{path}, row {row}",
            remedy="Remove the row, or download the file again from the original data set.",
        )
    if is_text:
        return np.array(column.to_pylist(), dtype=object)
    return column.to_numpy()


def _check_claims(data: bytes, path: Path) -> None:
    """Reject a file whose columns would take more than `_MAX_BYTES`."""
    try:
        claimed = _claimed_bytes(data)
    except (struct.error, ValueError) as error:
        raise _damaged(path, error) from error
    if claimed > _MAX_BYTES:
        raise InputError(
            "the table is too large",
            where=path,
            got=f"{claimed} bytes in its columns",
            expected=f"at most {_MAX_BYTES}",
            remedy=_REMEDY,
        )


def _damaged(path: Path, error: Exception) -> InputError:
    return InputError(
        "the Feather file is truncated or damaged",
        where=path,
        got=f"{error}"[:200],
        remedy=_REMEDY,
    )


def _claimed_bytes(data: bytes) -> int:
    """Return the bytes that all columns take in memory, as the messages claim.

    Raises:
        ValueError, struct.error: the messages are damaged.
    """
    at, claimed = len(_MAGIC), 0
    for _ in range(_MAX_MESSAGES):
        marker, size = _number(data, at, "I"), _number(data, at + 4, "i")
        if marker != _CONTINUATION or size < 0:
            raise ValueError("a message does not start with its marker")
        if size == 0:
            return claimed
        message = data[at + 8 : at + 8 + size]
        root = _referred(message, 0)
        kind = _field(message, root, _KIND, "B")
        body_size = _field(message, root, _BODY_LENGTH, "q")
        body = at + 8 + size
        at = body + body_size
        if body_size < 0 or at > len(data):
            raise ValueError("it ends too early")
        if kind == _RECORD_BATCH:
            claimed += _batch_bytes(message, root, data[body:at])
        elif kind != _SCHEMA:
            raise ValueError("it has a message that is neither a schema nor rows")
    raise ValueError(f"it has more than {_MAX_MESSAGES} messages")


def _batch_bytes(message: bytes, root: int, body: bytes) -> int:
    """Return the bytes of the buffers of a message of rows, decompressed."""
    header = _slot(message, root, _HEADER)
    batch = _referred(message, header)
    slot = _slot(message, batch, _BUFFERS)
    if not header or not slot:
        raise ValueError("a message has no rows")
    is_compressed = _slot(message, batch, _COMPRESSION) != 0
    vector = _referred(message, slot)
    claimed = 0
    for i in range(_number(message, vector, "I")):
        start, length = (_number(message, vector + 4 + 16 * i + part, "q") for part in (0, 8))
        if start < 0 or length < 0 or start + length > len(body):
            raise ValueError("a buffer leads out of its message")
        if is_compressed and length:
            # Before each compressed buffer: its size, or -1 if it is stored as it is.
            size = _number(body, start, "q")
            if size < -1:
                raise ValueError("a buffer has a negative size")
            claimed += size if size >= 0 else length
        else:
            claimed += length
    return claimed


def _number(data: bytes, at: int, code: str) -> int:
    # A negative position would count from the end.
    if at < 0:
        raise ValueError("a position is negative")
    return struct.unpack_from("<" + code, data, at)[0]


def _referred(data: bytes, at: int) -> int:
    """Return the position of the FlatBuffers table or vector to which the offset at `at` leads."""
    return at + _number(data, at, "I")


def _slot(data: bytes, table: int, field: int) -> int:
    """Return the position of a field of a FlatBuffers table; 0 if it has its default value."""
    layout = table - _number(data, table, "i")
    entry = 4 + 2 * field
    if entry + 2 > _number(data, layout, "H"):
        return 0
    offset = _number(data, layout + entry, "H")
    return table + offset if offset else 0


def _field(data: bytes, table: int, field: int, code: str) -> int:
    slot = _slot(data, table, field)
    return _number(data, slot, code) if slot else 0
