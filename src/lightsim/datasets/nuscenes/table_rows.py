"""Rows of nuScenes tables, read from files of any size, and their values with checks."""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Container, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float64

from lightsim.core.frames import RigidTransform
from lightsim.datasets.files import require_number
from lightsim.errors import InputError
from lightsim.store.reading import open_regular

# Largest table, in bytes: sample_data.json of nuScenes v1.0-trainval has 1.3 GB.
_MAX_TABLE_BYTES = 16 << 30
# Largest row, in characters: rows of nuScenes have some 500.
_MAX_ROW = 1 << 18
# Bytes read at a time.
_CHUNK_BYTES = 8 << 20
# Largest number of rows of one table: a scene of 20 s has some 4000 of sample_data.
_MAX_KEPT = 500_000
# Times between 1980 and 2100, in microseconds since 1970.
_TIMES_US = (3.1e14, 4.2e15)
_OPENING = re.compile(r"\s*\[\s*")
_SEPARATOR = re.compile(r"\s*([,\]])\s*")
_BROKEN = "Copy the file again from the original data set."


@dataclass(frozen=True)
class Row:
    """One row of a table; values are checked when they are read.

    Args:
        table: file of the table, for messages.
    """

    table: Path
    values: dict[str, Any]

    @property
    def where(self) -> str:
        """Table and token, for messages."""
        return f"{self.table}, token {str(self.values.get('token'))[:40]}"

    def text(self, key: str) -> str:
        """Return a text."""
        value = self._value(key)
        if not isinstance(value, str):
            raise self._error(key, value, "a text")
        return value

    def tokens(self, key: str) -> list[str]:
        """Return the tokens of other rows: one, or a list of them."""
        value = self._value(key)
        tokens = [value] if isinstance(value, str) else value
        if not isinstance(tokens, list) or not all(isinstance(token, str) for token in tokens):
            raise self._error(key, value, "a token, or a list of tokens")
        return tokens

    def numbers(self, key: str, count: int) -> Float64[np.ndarray, " n"]:
        """Return a list of `count` finite numbers."""
        value = self._value(key)
        if not isinstance(value, list) or len(value) != count:
            raise self._error(key, value, f"a list of {count} numbers")
        return np.array([require_number(entry, f"{self.where}, '{key}'") for entry in value])

    def matrix(self, key: str) -> Float64[np.ndarray, "3 3"]:
        """Return a list of 3 lists of 3 finite numbers."""
        value = self._value(key)
        if not isinstance(value, list) or len(value) != 3:
            raise self._error(key, value, "3 lists of 3 numbers")
        rows = [Row(self.table, {**self.values, key: row}).numbers(key, 3) for row in value]
        return np.stack(rows)

    def time_ns(self) -> int:
        """Return the `timestamp`, which is in microseconds since 1970."""
        value = self._value("timestamp")
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        # NaN fails the comparison.
        if not is_number or not _TIMES_US[0] <= value <= _TIMES_US[1]:
            raise self._error("timestamp", value, "microseconds between the years 1980 and 2100")
        return round(value * 1000)

    def pose(self, dst: str, src: str) -> RigidTransform:
        """Return the transform of `rotation` (w, x, y, z) and `translation`."""
        quaternion = self.numbers("rotation", 4)
        # Wide limits, since the quaternion is normalised: other lengths are another quantity.
        if not 0.5 < float(np.linalg.norm(quaternion)) < 2.0:
            raise self._error("rotation", quaternion.tolist(), "a unit quaternion w, x, y, z")
        return RigidTransform.from_quaternion(dst, src, quaternion, self.numbers("translation", 3))

    def path(self, root: Path) -> Path:
        """Return the file that `filename` names, which must lie below `root`."""
        # Tables that were written on Windows have backslashes.
        name = self.text("filename").replace("\\", "/")
        parts = PurePosixPath(name).parts
        is_below = bool(parts) and parts[0] != "/" and ".." not in parts
        if not is_below or not name.isprintable() or ":" in parts[0]:
            raise self._error("filename", name, f"the path of a file below {root}")
        return root.joinpath(*parts)

    def _value(self, key: str) -> Any:
        if key not in self.values:
            got = ", ".join(map(str, self.values))[:200]
            raise self._error(key, f"a row with {got or 'nothing'}", "this key")
        return self.values[key]

    def _error(self, key: str, got: Any, expected: str) -> InputError:
        return InputError(
            f"the value of '{key}' is missing or wrong",
            where=self.where,
            got=f"{got!r:.200}",
            expected=expected,
            remedy=_BROKEN,
        )


def kept_rows(path: Path, key: str, wanted: Container[str] | None = None) -> list[dict[str, Any]]:
    """Return the rows of a table whose value of `key` is wanted; all rows for None.

    The table is read in pieces, because those of nuScenes v1.0-trainval have up to 1.3 GB.

    Raises:
        InputError: the file is missing, or is no JSON array of objects.
    """
    kept: list[dict[str, Any]] = []
    for row in _rows(path):
        value = row.get(key)
        if wanted is not None and not (isinstance(value, str) and value in wanted):
            continue
        kept.append(row)
        if len(kept) > _MAX_KEPT:
            raise InputError("the table has too many rows", where=path,
                             expected=f"at most {_MAX_KEPT} of one scene")  # fmt: skip
    return kept


def _rows(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the objects of a JSON array."""
    decode_row = json.JSONDecoder().raw_decode
    with open_regular(path, "table", _MAX_TABLE_BYTES) as handle:
        decoder = codecs.getincrementaldecoder("utf-8-sig")()
        try:
            data = handle.read(_CHUNK_BYTES)
            text = decoder.decode(data, not data)
            found = _OPENING.match(text)
            if found is None:
                raise ValueError("no array")
            at = found.end()
            is_last = text.startswith("]", at)
            at += is_last
            while not is_last:
                # Whole rows are always in the text: then none of them is parsed twice.
                while data and len(text) - at < 2 * _MAX_ROW:
                    data = handle.read(_CHUNK_BYTES)
                    text, at = text[at:] + decoder.decode(data, not data), 0
                row, at = decode_row(text, at)
                found = _SEPARATOR.match(text, at)
                if not isinstance(row, dict) or found is None:
                    raise ValueError("no array of objects")
                yield row
                at, is_last = found.end(), found[1] == "]"
            if text[at:].strip():
                raise ValueError("text after the array")
        except (ValueError, RecursionError) as error:
            raise InputError(
                "the table is not valid JSON",
                where=path,
                got=f"{error}"[:200],
                expected="an array of objects",
                remedy=_BROKEN,
            ) from error
