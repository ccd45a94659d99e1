"""Reader of untrusted CSV tables with a header; errors name the file and the row."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.core.frames import (
    RigidTransform,
    matrices_from_quaternions,
    quaternion_from_matrix,
)
from lightsim.datasets.files import MAX_NUMBER
from lightsim.errors import InputError
from lightsim.store.reading import read_bytes

# Largest file, in bytes: an hour of poses at 100 Hz takes 50 MB.
_MAX_BYTES = 64 << 20
# Nanoseconds below 2^62 leave room for sums and differences in int64.
_MAX_NS = 2**62
_TIME = re.compile(r"-?[0-9]{1,19}")
POSE_COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz")
"""Columns of `CsvTable.matrices`."""


@dataclass(frozen=True)
class CsvTable:
    """Cells of a table by column. Row 1 is the first one below the header."""

    path: Path
    columns: Mapping[str, Sequence[str]]
    n_rows: int

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def texts(self, name: str) -> Sequence[str]:
        """Return the cells of a column."""
        return self.columns[name]

    def numbers(self, name: str) -> Float64[np.ndarray, " n"]:
        """Return a column of finite numbers.

        Raises:
            InputError: a cell is no number, not finite, or beyond MAX_NUMBER.
        """
        values = np.full(self.n_rows, np.nan)
        for i, cell in enumerate(self.columns[name]):
            try:
                values[i] = float(cell)
            except ValueError:
                break
        is_bad = ~(np.abs(values) <= MAX_NUMBER)
        if is_bad.any():
            raise self.wrong_cell(name, int(np.argmax(is_bad)), "a finite number")
        return values

    def times_ns(self, name: str = "time_ns") -> Int64[np.ndarray, " n"]:
        """Return a column of times in nanoseconds. Cells must be whole numbers, because a double
        resolves present UTC times to 256 ns only.

        Raises:
            InputError: a cell is no whole number.
        """
        values = np.zeros(self.n_rows, dtype=np.int64)
        for i, cell in enumerate(self.columns[name]):
            value = int(cell) if _TIME.fullmatch(cell) else _MAX_NS
            if abs(value) >= _MAX_NS:
                raise self.wrong_cell(name, i, "whole nanoseconds, such as 1561645824993653000")
            values[i] = value
        return values

    def matrices(self) -> Float64[np.ndarray, "n 4 4"]:
        """Return the poses of columns x, y, z (metres) and qw, qx, qy, qz.

        Raises:
            InputError: a number is not finite, or a quaternion is not of unit length.
        """
        values = np.stack([self.numbers(name) for name in POSE_COLUMNS], axis=1)
        lengths = np.linalg.norm(values[:, 3:], axis=1)
        # Wide limits, since quaternions are normalised: other lengths are another quantity.
        is_bad = (lengths <= 0.5) | (lengths >= 2.0)
        if is_bad.any():
            i = int(np.argmax(is_bad))
            raise InputError(
                "the rotation is not a unit quaternion",
                where=f"{self.path}, row {i + 1}",
                got=f"qw, qx, qy, qz of length {lengths[i]:.3g}",
                expected="length 1",
            )
        matrices = np.tile(np.eye(4), (self.n_rows, 1, 1))
        if self.n_rows:
            matrices[:, :3, :3] = matrices_from_quaternions(values[:, 3:])
        matrices[:, :3, 3] = values[:, :3]
        return matrices

    def wrong_cell(self, name: str, row: int, expected: str) -> InputError:
        """Return the error for a cell; `row` counts from 0."""
        return InputError(
            f"the column '{name}' contains a wrong value",
            where=f"{self.path}, row {row + 1}",
            got=repr(self.columns[name][row])[:60],
            expected=expected,
        )


def pose_cells(transform: RigidTransform) -> list[float]:
    """Return the cells of POSE_COLUMNS; inverse of `CsvTable.matrices`."""
    return [*transform.translation_m.tolist(), *quaternion_from_matrix(transform.rotation).tolist()]


def read_csv(path: Path, required: Sequence[str]) -> CsvTable:
    """Read a table whose first row names its columns; further columns are read, too.

    Raises:
        InputError: the file is missing, too large, no CSV, lacks a column, or a row has another
            number of cells than the header.
    """
    data = read_bytes(path, "CSV file", _MAX_BYTES)
    try:
        # utf-8-sig: spreadsheets write a byte order mark.
        reader = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""))
        rows = [row for row in reader if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            "the file is not a CSV table",
            where=path,
            got=f"{error}"[:100],
            expected="text in UTF-8 with a header",
        ) from error
    header = [name.strip() for name in rows[0]] if rows else []
    missing = [name for name in required if name not in header]
    if missing or len(set(header)) < len(header):
        raise InputError(
            f"the column '{missing[0]}' is missing" if missing else "two columns have one name",
            where=path,
            got=", ".join(header)[:200] or "an empty file",
            expected=f"a header with {','.join(required)}",
        )
    for i, row in enumerate(rows):
        if len(row) != len(header):
            raise InputError(
                "the row has another number of cells than the header",
                where=f"{path}, row {i}",
                got=len(row),
                expected=len(header),
            )
    cells = list(zip(*rows[1:], strict=True)) or [()] * len(header)
    return CsvTable(path, dict(zip(header, cells, strict=True)), len(rows) - 1)
