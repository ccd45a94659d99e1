"""Search for the files that a model file refers to: buffers, pictures, material libraries."""

from __future__ import annotations

import os
import re
import unicodedata
from pathlib import Path
from urllib.parse import unquote

from lightsim.errors import InputError
from lightsim.store.reading import is_file, is_folder

# Largest number of entries of a folder that are compared without regard to case. It bounds the time
# that a hostile folder can take; model folders have up to some hundred files.
_MAX_ENTRIES = 10_000
# Scheme at the start of a URL: two characters or more, unlike a drive letter of Windows.
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")
_DRIVE = re.compile(r"^[A-Za-z]:")
# A local file named by a URL, which is an absolute path.
_FILE_URL = re.compile(r"^file://[^/\\]*", re.IGNORECASE)
# Largest number of path components that are compared with folders; paths in models have some five.
_MAX_PARTS = 16


def path_beside(model: Path, reference: str, kind: str) -> Path:
    """Return the path of a file that a model refers to.

    References are relative to the model's folder, and may start with `../`. They are tried with and
    without percent-decoding, with `\\` as `/`, and with other case or other Unicode normalisation
    (macOS stores decomposed accents) if exactly one file matches. Of an absolute path, the longest
    existing end is used: `textures/red.png` of `D:/models/textures/red.png`, else `red.png`. URLs
    are refused, except those of local files (`file:///D:/models/red.png`). The caller must open the
    result with `reading.open_regular`.

    Args:
        kind: name of the kind of file in errors, such as "picture".

    Raises:
        InputError: the file does not exist, or the reference is a URL.
    """
    reference = _FILE_URL.sub("", reference)
    if _SCHEME.match(reference):
        raise InputError(
            f"the model's {kind} is named by a URL",
            where=model,
            got=reference[:80],
            expected="a file beside the model",
            remedy="Save the file beside the model, and name it in the model without its URL.",
        )
    # glTF has percent-encoded references, but some exporters do not encode them.
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
    # PATH_MAX of Linux.
    if len(text) > 4096:
        return None
    if not text.startswith("/") and not _DRIVE.match(text):
        return _at(folder, text.split("/"))
    parts = [part for part in _DRIVE.sub("", text).split("/") if part][-_MAX_PARTS:]
    tails = (_at(folder, parts[n:]) for n in range(len(parts)))
    return next((path for path in tails if path is not None), None)


def _at(folder: Path, parts: list[str]) -> Path | None:
    """Return the file at a relative path; a missing component may match one similar entry."""
    path = folder.joinpath(*parts)
    if not parts[-1] or is_file(path):
        return path if parts[-1] else None
    if len(parts) > _MAX_PARTS:
        return None
    path = folder
    for part in parts:
        if part in ("", ".", "..") or _is_there(path / part):
            path = path / part
            continue
        alike = [name for name in _names(path) if _plain(name) == _plain(part)]
        if len(alike) != 1:
            return None
        path = path / alike[0]
    return path if is_file(path) else None


def _is_there(path: Path) -> bool:
    return is_file(path) or is_folder(path)


def _names(folder: Path) -> list[str]:
    try:
        with os.scandir(folder) as entries:
            return [entry.name for entry, _ in zip(entries, range(_MAX_ENTRIES), strict=False)]
    except (OSError, ValueError):
        return []


def _plain(name: str) -> str:
    # Twice, since case folding can decompose characters.
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())
