"""Names from a log as file names: an id is data, never a path."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lightsim.errors import ArtefactError

MAX_NAME_CHARACTERS = 80
"""Leaves room for suffixes and temporary names below the 255 bytes of common file systems."""
_SLUG_CHARACTERS = 32
"""Enough of a long or odd id to be recognised by a person; the hash tells it from others."""
_HASH_BYTES = 8
"""64 bits: no two ids of a log meet by chance, and nobody seeks a collision with himself."""
_MARK = "~"
"""Stands before the hash. No harmless name has it, so none equals the made-up name of another."""
_HARMLESS = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]*[A-Za-z0-9_-])?")
_HARMFUL_RUNS = re.compile(r"[^A-Za-z0-9_-]+")
_DEVICES = frozenset(
    ("con", "prn", "aux", "nul", *(f"{kind}{n}" for kind in ("com", "lpt") for n in range(1, 10)))
)
"""Windows opens a device for these, whatever the suffix."""


def is_harmless(name: str) -> bool:
    """Whether a name can be a file's name, without its suffix, on every common system."""
    return (
        len(name) <= MAX_NAME_CHARACTERS
        and _HARMLESS.fullmatch(name) is not None
        and name.split(".")[0].lower() not in _DEVICES
    )


def safe_file_name(text: str) -> str:
    """`text` itself where it is harmless; else what is readable of it, and a hash of the whole.

    Different texts give different names. Two that differ by case alone share a file where the file
    system ignores case: `file_names` separates these too.
    """
    return text if is_harmless(text) else _with_hash(text)


def file_names(texts: Iterable[str]) -> dict[str, str]:
    """A file name for each of some texts, no two alike even where case is ignored."""
    distinct = list(dict.fromkeys(texts))
    times = Counter(text.casefold() for text in distinct)
    return {
        text: safe_file_name(text) if times[text.casefold()] == 1 else _with_hash(text)
        for text in distinct
    }


def inside(folder: Path, name: Any) -> Path:
    """The path of a file that a JSON file of ours names, which must lie below `folder`.

    Raises:
        ArtefactError: `name` is no relative path, or leads out of the folder.
    """
    parts = name.split("/") if isinstance(name, str) else []
    is_relative = bool(parts) and not any(
        part in ("", ".", "..") or not part.isprintable() or re.search(r"[\\:]", part)
        for part in parts
    )
    # The second look follows links, which the text of a name does not show.
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
    except (OSError, RuntimeError):  # A loop of links.
        return False


def _with_hash(text: str) -> str:
    # Undecodable bytes of file names and broken escapes of JSON come as lone surrogates.
    digest = hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=_HASH_BYTES)
    slug = _HARMFUL_RUNS.sub("-", text[:_SLUG_CHARACTERS]).strip("-_").lower()
    return f"{slug or 'unnamed'}{_MARK}{digest.hexdigest()}"
