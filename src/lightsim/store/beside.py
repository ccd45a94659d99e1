"""Files that a model names: buffers, pictures, material libraries."""

from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import unquote

from lightsim.errors import InputError
from lightsim.store.reading import is_file

_MAX_ENTRIES = 10_000
"""Entries of a folder that are compared without regard to case."""
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")
"""Start of a URL. Drive letters of Windows have one letter."""
_DRIVE = re.compile(r"[A-Za-z]:")


def path_beside(model: Path, reference: str, kind: str) -> Path:
    """Return the path of a file that a model names.

    References are relative to the model's folder, and may start with `../` as exporters write it.
    They are read with and without percent-decoding, with `\\` as `/`, and without regard to case
    where only that differs. Of an absolute path only the file name counts, beside the model. URLs
    are refused. The caller opens the result with `reading.open_regular`.

    Args:
        kind: a word for errors, such as "picture".

    Raises:
        InputError: there is no such file, or the reference is a URL.
    """
    if _SCHEME.match(reference):
        raise InputError(
            f"the model's {kind} is named by a URL",
            where=model,
            got=reference[:80],
            expected="a file beside the model",
            remedy="Save the file beside the model, and name it in the model without its URL.",
        )
    for text in dict.fromkeys((unquote(reference), reference)):
        path = _existing(model.parent, text.replace("\\", "/"))
        if path is not None:
            return path
    raise InputError(
        f"the model's {kind} is missing",
        where=model,
        got=f"no file {unquote(reference)[:200]!r}",
        expected="a file at this path, relative to the model",
        remedy="Copy it there, or export the model with everything in one file.",
    )


def _existing(folder: Path, text: str) -> Path | None:
    if text.startswith("/") or _DRIVE.match(text):
        text = text.rsplit("/", 1)[-1]
    path = folder / text
    if not text or is_file(path):
        return path if text else None
    try:
        with os.scandir(path.parent) as entries:
            names = [entry.name for entry, _ in zip(entries, range(_MAX_ENTRIES), strict=False)]
    except (OSError, ValueError):
        return None
    alike = [name for name in names if name.casefold() == path.name.casefold()]
    return path.parent / alike[0] if len(alike) == 1 and is_file(path.parent / alike[0]) else None
