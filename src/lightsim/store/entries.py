"""Typed access to the entries of JSON objects; errors name the entry and the file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float64

from lightsim.errors import ArtefactError, LightSimError
from lightsim.store.artefact import read_json

_REMEDY = "Build again."
# Number of characters of a wrong value that an error shows: one line of a terminal.
_SHOWN = 60
_Member = TypeVar("_Member", bound=StrEnum)


class Entries:
    """A JSON object with typed access to its entries.

    Args:
        value: the parsed JSON.
        where: the file, for errors.
        error: type of the errors that all methods raise.
        remedy: the action that errors recommend.

    Raises:
        ArtefactError, or `error` if given: an entry is missing or of another type.
    """

    def __init__(
        self,
        value: Any,
        where: object,
        error: type[LightSimError] = ArtefactError,
        remedy: str = _REMEDY,
    ) -> None:
        self.where = where
        self._kind, self._remedy = error, remedy
        if not isinstance(value, dict):
            raise self._error("not a JSON object", value)
        self._value: dict[str, Any] = value

    @staticmethod
    def of_file(path: Path, remedy: str = _REMEDY) -> Entries:
        """Return the object that a JSON file contains."""
        return Entries(read_json(path), path, remedy=remedy)

    def __contains__(self, key: str) -> bool:
        return key in self._value

    def is_null(self, key: str) -> bool:
        """Return whether an entry is null; an error if it is missing."""
        return self._entry(key) is None

    def flag(self, key: str) -> bool:
        """Return an entry that is true or false."""
        return self._checked(key, bool, "true or false")

    def allow(self, keys: Sequence[str]) -> None:
        """Raise an error if the object has other entries: a misspelt name would have no effect."""
        unknown = [key for key in self._value if key not in keys]
        if unknown:
            raise self._kind(
                f"there is no entry '{unknown[0]:.{_SHOWN}}'",
                where=self.where,
                expected=f"some of {', '.join(keys)}",
                remedy=self._remedy,
            )

    def text(self, key: str) -> str:
        """Return an entry that is a text, possibly empty."""
        return self._checked(key, str, "a text")

    def word(self, key: str, words: Sequence[str]) -> Any:
        """Return an entry that must be one of the given words."""
        text = self.text(key)
        if text not in words:
            raise self._error(f"'{key}' is not one of {', '.join(words)}", text)
        return text

    def member(self, key: str, enumeration: type[_Member]) -> _Member:
        """Return the member of an enumeration of texts that an entry names."""
        return enumeration(self.word(key, [str(member) for member in enumeration]))

    def texts(self, key: str) -> tuple[str, ...]:
        """Return an entry that is a list of texts."""
        values = self._checked(key, list, "a list of texts")
        if not all(isinstance(value, str) for value in values):
            raise self._error(f"'{key}' is not a list of texts", values)
        return tuple(values)

    def number(self, key: str) -> float:
        """Return an entry that is one finite number."""
        return float(self.numbers(key, ()))

    def numbers(self, key: str, shape: tuple[int | None, ...]) -> Float64[np.ndarray, "..."]:
        """Return an array of finite numbers from nested lists of this shape; None is any length."""
        value = self._entry(key)
        if not _is_nested(value, shape):
            raise self._error(f"'{key}' is not a {_words(shape)}", value)
        return np.array(value, dtype=np.float64)

    def mapping(self) -> dict[str, Any]:
        """Return the object without checks."""
        return self._value

    def object(self, key: str) -> Entries:
        """Return an entry that is an object itself; its errors name the path to it."""
        return self._inner(self._entry(key), f"'{key}'")

    def objects(self, key: str) -> tuple[Entries, ...]:
        """Return an entry that is a list of objects; their errors name the index."""
        values = self._checked(key, list, "a list")
        return tuple(self._inner(v, f"'{key}'[{i}]") for i, v in enumerate(values))

    def _inner(self, value: Any, name: str) -> Entries:
        return Entries(value, f"{self.where}, {name}", self._kind, self._remedy)

    def __iter__(self) -> Iterator[str]:
        return iter(self._value)

    def _entry(self, key: str) -> Any:
        if key not in self._value:
            raise self._kind(f"'{key}' is missing", where=self.where, remedy=self._remedy)
        return self._value[key]

    def _checked(self, key: str, kind: type, words: str) -> Any:
        value = self._entry(key)
        if not isinstance(value, kind):
            raise self._error(f"'{key}' is not {words}", value)
        return value

    def _error(self, what: str, got: Any) -> LightSimError:
        shown = f"{type(got).__name__} {got!r:.{_SHOWN}}"
        return self._kind(what, where=self.where, got=shown, remedy=self._remedy)


def _is_nested(value: Any, shape: tuple[int | None, ...]) -> bool:
    if shape:
        is_list = isinstance(value, list) and shape[0] in (None, len(value))
        return is_list and all(_is_nested(item, shape[1:]) for item in value)
    # In Python, True and False are integers, too.
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    # The limit is far above any stored quantity, and within the range of float32.
    return is_number and abs(value) <= 1e30


def _words(shape: tuple[int | None, ...]) -> str:
    return (
        f"list of {' x '.join('any' if n is None else str(n) for n in shape)} finite numbers"
        if shape
        else "finite number"
    )
