"""Rows of an untrusted Parquet file, with pyarrow (the extra `arrow`)."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from lightsim.datasets.files import require_number
from lightsim.datasets.waymo.wire import broken
from lightsim.errors import need
from lightsim.store.reading import open_regular

# Largest file, in bytes; those of a segment have up to a gigabyte.
_MAX_FILE_BYTES = 16 << 30
_MAX_ROWS = 1_000_000
"""Most rows of a file: a segment has 200 frames with up to 300 boxes each."""
_MAX_BYTES = 256 << 20
"""Most bytes of columns that are read as a whole: those without pictures and range images."""
_MAX_VALUES = 4 << 20
"""Most values of a cell: poses of a range image are one million."""


class Row:
    """One row; `where` names file and row."""

    def __init__(self, where: str, values: dict[str, Any]) -> None:
        self.where = where
        self._values = values

    def number(self, column: str) -> float:
        """Return a finite number."""
        return require_number(self._values[column], f"{self.where}, '{column}'")

    def number_or_zero(self, column: str) -> float:
        """Return a finite number; 0 for a missing value."""
        return 0.0 if self._values[column] is None else self.number(column)

    def whole(self, column: str) -> int:
        """Return a whole number."""
        value = self._values[column]
        if not isinstance(value, int):
            raise broken(f"{self.where}, '{column}'", f"{value!r:.40}", "a whole number")
        return value

    def text(self, column: str) -> str:
        """Return printable text of at most 512 characters."""
        value = self._values[column]
        if not isinstance(value, str) or len(value) > 512 or not value.isprintable():
            raise broken(f"{self.where}, '{column}'", f"{value!r:.40}", "text")
        return value

    def numbers(self, column: str) -> list[float]:
        """Return a list of finite numbers; an empty one for a missing value."""
        values = self._values[column]
        if values is not None and not isinstance(values, list):
            raise broken(f"{self.where}, '{column}'", f"{values!r:.40}", "a list of numbers")
        return [require_number(value, f"{self.where}, '{column}'") for value in values or ()]


class Table:
    """Columns of a Parquet file.

    Args:
        large: columns of which one row is read at a time. Rows are read from the first row of
            their row group on, hence fastest in their order: groups can hold gigabytes.

    Raises:
        InputError: the file is damaged or lacks a column.
        MissingDependencyError: pyarrow is not installed.
    """

    def __init__(self, path: Path, columns: Sequence[str], large: Sequence[str] = ()) -> None:
        self.path = path
        self._large = list(large)
        self._lock = threading.Lock()
        self._cells: Iterator[Any] = iter(())
        self._next = -1
        with self._open() as file:
            self._starts = _check(file.metadata, path, columns, large)
            rows = file.read(columns=list(columns)).to_pylist()
            # Damaged files have other names in the schema than in the metadata of columns.
            lost = set(columns) - set(rows[0])
        if lost:
            raise broken(path, f"no column '{min(lost)}'")
        self.rows = [Row(f"{path}, row {i}", row) for i, row in enumerate(rows)]

    def cells(self, row: int) -> dict[str, Any]:
        """Return pyarrow's values of the large columns in a row, by column."""
        group_start = int(self._starts[np.searchsorted(self._starts, row, side="right") - 1])
        # Pictures are loaded by several threads.
        with self._lock:
            if not max(group_start, 0) <= self._next <= row:
                self._cells, self._next = self._from(group_start), group_start
            with _arrow_errors(self.path):
                for batch in self._cells:
                    self._next += 1
                    if self._next > row:
                        return {name: batch.column(name)[0] for name in self._large}
            raise broken(self.path, f"{self._next} rows", f"a row {row}")

    def array(self, values: Any, where: object) -> Float32[np.ndarray, " n"]:
        """Return the numbers of a list in a cell."""
        with _arrow_errors(where):
            return np.asarray(values.values.to_numpy(zero_copy_only=False), dtype=np.float32)

    def _from(self, start: int) -> Iterator[Any]:
        groups = np.flatnonzero(self._starts >= start).tolist()
        with self._open() as file:
            yield from file.iter_batches(1, groups, self._large)

    @contextmanager
    def _open(self) -> Generator[Any]:
        pq = need("pyarrow.parquet", extra="arrow")
        opened = open_regular(self.path, "Parquet file", _MAX_FILE_BYTES)
        with opened as handle, _arrow_errors(self.path):
            yield pq.ParquetFile(handle, buffer_size=1 << 20)


def _check(metadata: Any, path: Path, columns: Sequence[str], large: Sequence[str]) -> np.ndarray:
    """Check sizes before anything is read, and return the first row of each row group."""
    if not 0 < metadata.num_rows <= _MAX_ROWS:
        raise broken(path, f"{metadata.num_rows} rows", f"1 to {_MAX_ROWS}")
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    chunks = [(g.num_rows, g.column(i)) for g in groups for i in range(g.num_columns)]

    def of(name: str) -> list[tuple[int, Any]]:
        return [c for c in chunks if f"{c[1].path_in_schema}.".startswith(f"{name}.")]

    missing = [name for name in (*columns, *large) if not of(name)]
    if missing:
        raise broken(path, f"no column '{missing[0]}'", ", ".join((*columns, *large)))
    total = sum(chunk.total_uncompressed_size for name in columns for _, chunk in of(name))
    values = [chunk.num_values / max(1, n) for name in (*columns, *large) for n, chunk in of(name)]
    if total > _MAX_BYTES or max(values) > _MAX_VALUES:
        got = f"columns of {total} bytes, {max(values):.0f} values in a row"
        raise broken(path, got, f"at most {_MAX_BYTES} bytes and {_MAX_VALUES} values")
    return np.cumsum([0, *(group.num_rows for group in groups)])[:-1]


@contextmanager
def _arrow_errors(where: object) -> Generator[None]:
    """Convert pyarrow's exceptions to InputError."""
    import pyarrow as pa

    try:
        yield
    except (pa.ArrowException, OSError, ValueError, TypeError, LookupError, OverflowError,
            AttributeError, MemoryError) as error:  # fmt: skip
        raise broken(where, f"{type(error).__name__}: {error}"[:200], "a Parquet file") from error
