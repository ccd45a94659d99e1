"""Our own JSON objects, entry by entry: each is of the type that its reader needs, or named."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.errors import ArtefactError, LightSimError
from lightsim.store.artefact import read_json

_REMEDY = "Build again."
_MAX_NUMBER = 1e30
"""Nothing we store is larger; float32 holds it."""
_SHOWN = 60
_Member = TypeVar("_Member", bound=StrEnum)


class Entries:
    """A JSON object of a file, `where`.

    Raises:
        ArtefactError, or the `error` that is given: from every method: an entry is missing or of
            another type.
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
        """The object that a JSON file holds."""
        return Entries(read_json(path), path, remedy=remedy)

    def __contains__(self, key: str) -> bool:
        return key in self._value

    def is_null(self, key: str) -> bool:
        """Whether the entry is there and null."""
        return self._entry(key) is None

    def flag(self, key: str) -> bool:
        """An entry that is true or false."""
        return self._checked(key, bool, "true or false")

    def allow(self, keys: Sequence[str]) -> None:
        """Refuse entries of other names: a misspelt one would do nothing."""
        unknown = [key for key in self._value if key not in keys]
        if unknown:
            raise self._kind(
                f"there is no entry '{unknown[0]:.{_SHOWN}}'",
                where=self.where,
                expected=f"some of {', '.join(keys)}",
                remedy=self._remedy,
            )

    def text(self, key: str) -> str:
        """An entry that is a text, possibly empty."""
        return self._checked(key, str, "a text")

    def word(self, key: str, words: Sequence[str]) -> Any:
        """A text that is one of some words."""
        text = self.text(key)
        if text not in words:
            raise self._error(f"'{key}' is none of {', '.join(words)}", text)
        return text

    def member(self, key: str, enumeration: type[_Member]) -> _Member:
        """The member of an enumeration of texts that an entry names."""
        text = self.text(key)
        if text not in [str(member) for member in enumeration]:
            raise self._error(f"'{key}' is none of {', '.join(enumeration)}", text)
        return enumeration(text)

    def texts(self, key: str) -> tuple[str, ...]:
        """An entry that is a list of texts."""
        values = self._checked(key, list, "a list of texts")
        if not all(isinstance(value, str) for value in values):
            raise self._error(f"'{key}' is no list of texts", values)
        return tuple(values)

    def number(self, key: str) -> float:
        """An entry that is one finite number."""
        return float(self.numbers(key, ()))

    def numbers(self, key: str, shape: tuple[int | None, ...]) -> Float64[np.ndarray, "..."]:
        """A finite number, or nested lists of them in this shape; None is any length."""
        value = self._entry(key)
        if not _is_nested(value, shape):
            raise self._error(f"'{key}' is no {_words(shape)}", value)
        return np.array(value, dtype=np.float64)

    def whole_numbers(self, key: str, shape: tuple[int | None, ...]) -> Int64[np.ndarray, "..."]:
        """The same of integers, which floats would round: times in nanoseconds."""
        value = self._entry(key)
        try:
            found = np.array(value, dtype=np.int64) if _is_nested(value, shape) else None
        except OverflowError:
            found = None
        if found is None or found.tolist() != value:
            raise self._error(f"'{key}' is no {_words(shape)}, whole", value)
        return found

    def mapping(self) -> dict[str, Any]:
        """The object as it is."""
        return self._value

    def object(self, key: str) -> Entries:
        """An entry that is an object itself; its errors name the way to it."""
        return self._inner(self._entry(key), f"'{key}'")

    def objects(self, key: str) -> tuple[Entries, ...]:
        """An entry that is a list of objects; their errors name the place in it."""
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
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and abs(value) <= _MAX_NUMBER


def _words(shape: tuple[int | None, ...]) -> str:
    return (
        f"list of {' x '.join('any' if n is None else str(n) for n in shape)} finite numbers"
        if shape
        else "finite number"
    )
