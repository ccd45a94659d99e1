"""Entries of a JSON object that is not trusted, each checked where it is taken."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from lightsim.core.frames import RigidTransform
from lightsim.datasets.files import require_number, require_object
from lightsim.errors import InputError

# Longest text, in characters: a note of two lines.
_MAX_CHARACTERS = 1000
# Largest error of R R^T from identity that is corrected: calibrations are rounded to four digits.
_ROTATION_ERROR = 1e-2


class JsonObject:
    """One JSON object; null counts as absent.

    Args:
        where: file and place in it, for messages.

    Raises:
        InputError: the value is something else.
    """

    def __init__(self, value: Any, where: str) -> None:
        self.where = where
        self._values = require_object(value, where)
        self._taken: set[str] = set()

    def __contains__(self, key: str) -> bool:
        self._taken.add(key)
        return self._values.get(key) is not None

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def unknown(self) -> list[str]:
        """Return the keys that were not read."""
        return [f"{key!r:.40}" for key in self._values if key not in self._taken]

    def any(self, key: str, expected: str) -> Any:
        """Return a required value."""
        if key not in self:
            raise InputError(
                f"the key '{key}' is missing",
                where=self.where,
                got=", ".join(map(str, self._values))[:200] or "an empty object",
                expected=expected,
            )
        return self._values[key]

    def number(self, key: str, default: float | None = None) -> float:
        """Return a finite number."""
        if default is not None and key not in self:
            return default
        return require_number(self.any(key, "a number"), f"{self.where}, '{key}'")

    def optional_number(self, key: str) -> float | None:
        """Return a finite number; None if it is absent."""
        return self.number(key) if key in self else None

    def numbers(self, key: str, form: str) -> tuple[float, ...]:
        """Return the numbers of an array; `form` names them, such as "[latitude, longitude]"."""
        value = self.any(key, form)
        count = form.count(",") + 1
        if not isinstance(value, list) or len(value) != count:
            raise self._wrong(key, form)
        return tuple(require_number(v, f"{self.where}, '{key}'") for v in value)

    def number_list(self, key: str, most: int) -> tuple[float, ...]:
        """Return an array of at most `most` numbers; empty if it is absent."""
        value = self._values[key] if key in self else []
        if not isinstance(value, list) or len(value) > most:
            raise self._wrong(key, f"an array of at most {most} numbers")
        return tuple(require_number(v, f"{self.where}, '{key}'") for v in value)

    def text(self, key: str, default: str = "") -> str:
        """Return printable text of one line."""
        if key not in self:
            return default
        return self._printable(self._values[key], key)

    def texts(self, key: str) -> tuple[str, ...]:
        """Return an array of texts; empty if it is absent."""
        value = self._values[key] if key in self else []
        if not isinstance(value, list):
            raise self._wrong(key, "an array of texts")
        return tuple(self._printable(text, key) for text in value)

    def choice(self, key: str, choices: Sequence[str], default: str | None = None) -> str:
        """Return one of several words."""
        if default is not None and key not in self:
            return default
        value = self.any(key, f"one of {', '.join(choices)}")
        if value not in list(choices):
            raise self._wrong(key, f"one of {', '.join(choices)}")
        return str(value)

    def objects(self, key: str) -> dict[str, JsonObject]:
        """Return the objects of an object by name; empty if it is absent."""
        value = require_object(self._values[key] if key in self else {}, f"{self.where}, '{key}'")
        return {name: JsonObject(v, f"{self.where}, {key}/{name[:80]}") for name, v in
                value.items()}  # fmt: skip

    def transform(self, key: str, dst: str, src: str) -> RigidTransform:
        """Return a 4x4 matrix as a transform; rounded rotations are corrected."""
        rows = self.any(key, "a 4x4 matrix")
        form = f"4 rows of 4 numbers: a rotation and metres, {dst}_from_{src}"
        lengths = [len(row) if isinstance(row, list) else 0 for row in rows] if isinstance(
            rows, list) else []  # fmt: skip
        if lengths != [4] * 4:
            raise self._wrong(key, form)
        matrix = np.array([[require_number(v, f"{self.where}, '{key}'") for v in r] for r in rows])
        rotation = _nearest_rotation(matrix[:3, :3])
        if rotation is None or not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0]):
            raise self._wrong(key, form)
        return RigidTransform.from_rotation(dst, src, rotation, matrix[:3, 3])

    def _printable(self, value: Any, key: str) -> str:
        is_text = isinstance(value, str) and value.isprintable()
        if not is_text or len(value) > _MAX_CHARACTERS:
            raise self._wrong(key, f"printable text of at most {_MAX_CHARACTERS} characters")
        return value

    def _wrong(self, key: str, expected: str) -> InputError:
        return InputError(
            f"the entry '{key}' has a wrong value",
            where=self.where,
            got=f"{self._values[key]!r:.60}",
            expected=expected,
        )


def _nearest_rotation(matrix: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"] | None:
    """Return the rotation nearest to a matrix; None if the matrix is far from all rotations."""
    if np.abs(matrix).max() > 2.0:
        return None
    error = np.abs(matrix @ matrix.T - np.eye(3)).max()
    if error < 1e-12:
        return matrix if np.linalg.det(matrix) > 0 else None
    if error > _ROTATION_ERROR or np.linalg.det(matrix) < 0:
        return None
    u, _, v = np.linalg.svd(matrix)
    return u @ v
