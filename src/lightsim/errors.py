"""Exceptions of LightSim, each with a message of one line that includes the remedy."""

from __future__ import annotations

import importlib
from types import ModuleType

# Most characters of each part of a message: enough for a long path and a sentence.
_MAX_SHOWN = 500


class LightSimError(Exception):
    """Base class of all errors that a user can cause or correct.

    Args:
        what: what is wrong, as a short sentence without a full stop.
        where: the file, camera, stage or option concerned.
        got: what was found.
        expected: the valid values or available choices.
        remedy: what the user can do, as a sentence.
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
        """Return a copy of the error that names `where` if it names no place yet."""
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
    """Return the text in one line of bounded length.

    Files and options may contain line ends or control characters, which a terminal would execute.
    """
    line = "".join(c if c.isprintable() else " " for c in text[: _MAX_SHOWN + 1])
    return line if len(line) <= _MAX_SHOWN else line[:_MAX_SHOWN] + "..."


class InputError(LightSimError):
    """A file or value from the user is missing, broken or out of range."""


class FrameMismatchError(LightSimError):
    """Composed transforms have different inner frames, or a value is in the wrong frame."""


class OutOfRangeError(LightSimError):
    """A time or index is outside the recorded range; values are not extrapolated."""


class ArtefactError(LightSimError):
    """An artefact folder is missing, incomplete or in another format."""


class MissingDependencyError(LightSimError):
    """A required optional package is not installed."""


def need(module: str, *, extra: str) -> ModuleType:
    """Import and return `module`.

    Raises:
        MissingDependencyError: the module is not installed; the error names the extra.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingDependencyError(
            f"the optional package '{module}' is not installed",
            remedy=f"Run: pip install 'lightsim[{extra}]'",
        ) from error
