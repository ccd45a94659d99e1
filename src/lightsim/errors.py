"""The exceptions that LightSim raises on purpose: one clear line each, with the remedy."""

from __future__ import annotations

import importlib
from types import ModuleType

_MAX_SHOWN = 500
"""Characters of each part of a message: a path and a sentence."""


class LightSimError(Exception):
    """Base of every error a user can cause or mend.

    Args:
        what: what is wrong, as a short sentence without a full stop.
        where: the file, camera, stage or option concerned.
        got: what was found.
        expected: what would have been right, or the available choices.
        remedy: what the user can do about it.
    """

    def __init__(
        self,
        what: str,
        *,
        where: object = None,
        got: object = None,
        expected: object = None,
        remedy: str | None = None,
    ) -> None:
        self.what = what
        self.where = where
        self.got = got
        self.expected = expected
        self.remedy = remedy
        super().__init__(self._message())

    def at(self, where: object) -> LightSimError:
        """The same error, which names `where` unless it named a place already."""
        return type(self)(
            self.what,
            where=where if self.where is None else self.where,
            got=self.got,
            expected=self.expected,
            remedy=self.remedy,
        )

    def _message(self) -> str:
        parts = [f"{self.where}: {self.what}" if self.where is not None else self.what]
        if self.got is not None:
            parts.append(f"got {self.got}")
        if self.expected is not None:
            parts.append(f"expected {self.expected}")
        head = ", ".join(_shown(part) for part in parts) + "."
        return f"{head} {self.remedy}" if self.remedy else head


def _shown(text: str) -> str:
    """One line of bounded length: files and options may hold line ends, or what steers a
    terminal."""
    line = "".join(c if c.isprintable() else " " for c in text[: _MAX_SHOWN + 1])
    return line if len(line) <= _MAX_SHOWN else line[:_MAX_SHOWN] + "..."


class InputError(LightSimError):
    """A file or value given by the user is missing, broken or out of range."""


class FrameMismatchError(LightSimError):
    """Transforms of unequal inner frames were composed, or a value is in the wrong frame."""


class OutOfRangeError(LightSimError):
    """A time or index lies outside what was recorded; nothing is extrapolated."""


class ArtefactError(LightSimError):
    """An artefact folder is missing, incomplete or made in another format."""


class MissingDependencyError(LightSimError):
    """An optional package is needed and not installed."""


def need(module: str, *, extra: str) -> ModuleType:
    """Import `module`, or say which extra brings it.

    Raises:
        MissingDependencyError: the module is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingDependencyError(
            f"the optional package '{module}' is not installed",
            remedy=f"Run: pip install 'lightsim[{extra}]'",
        ) from error
