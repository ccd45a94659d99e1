"""Conversion of ids of a log to safe file names; an id is data, never a path."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lightsim.errors import ArtefactError

# Largest length of a name. With suffixes and temporary names it remains below the 255 bytes of
# common file systems.
MAX_NAME_CHARACTERS = 80
# Character before the hash. A harmless name cannot contain it, so it cannot equal a name with a
# hash.
_MARK = "~"
_HARMLESS = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]*[A-Za-z0-9_-])?")
_HARMFUL_RUNS = re.compile(r"[^A-Za-z0-9_-]+")
# Names of devices on Windows, with any suffix.
_DEVICES = frozenset(
    ("con", "prn", "aux", "nul", *(f"{kind}{n}" for kind in ("com", "lpt") for n in range(1, 10)))
)


def is_harmless(name: str) -> bool:
    """Return whether a text can be a file's name, without its suffix, on every common system."""
    return (
        len(name) <= MAX_NAME_CHARACTERS
        and _HARMLESS.fullmatch(name) is not None
        and name.split(".")[0].lower() not in _DEVICES
    )


def safe_file_name(text: str) -> str:
    """Return `text` if it is a safe file name, else its safe characters and a hash of the text.

    Different texts give different names. Names that differ only in case are one file on file
    systems that ignore case; `file_names` distinguishes these, too.
    """
    return text if is_harmless(text) else _with_hash(text)


def file_names(texts: Iterable[str]) -> dict[str, str]:
    """Return a file name for each text; the names differ even if case is ignored."""
    distinct = list(dict.fromkeys(texts))
    times = Counter(text.casefold() for text in distinct)
    return {
        text: safe_file_name(text) if times[text.casefold()] == 1 else _with_hash(text)
        for text in distinct
    }


def inside(folder: Path, name: Any) -> Path:
    """Return the path of a file that a JSON file names; it must lie below `folder`.

    Raises:
        ArtefactError: `name` is not a relative path, or leads out of the folder.
    """
    parts = name.split("/") if isinstance(name, str) else []
    is_relative = bool(parts) and not any(
        part in ("", ".", "..") or not part.isprintable() or re.search(r"[\\:]", part)
        for part in parts
    )
    # The second check follows symbolic links, which the name alone does not show.
    if not is_relative or not _lies_below(folder / name, folder):
        raise ArtefactError(
            "a file's name leads out of its folder",
            where=folder,
            got=repr(name)[:80],
            expected="a relative path below it",
            remedy="Do not use this folder if it came from elsewhere; else build again.",
        )
    return folder / name


def _lies_below(path: Path, folder: Path) -> bool:
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # A loop of symbolic links.
        return False


def _with_hash(text: str) -> str:
    # Python represents undecodable bytes of file names, and invalid JSON escapes, as surrogates.
    # With 64 bits, ids of a log do not collide by chance.
    digest = hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=8)
    # The first 32 characters remain readable; the hash makes the name unique.
    slug = _HARMFUL_RUNS.sub("-", text[:32]).strip("-_").lower()
    return f"{slug or 'unnamed'}{_MARK}{digest.hexdigest()}"
