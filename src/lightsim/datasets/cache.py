"""Folder of values that are derived from recordings and too slow to derive again."""

from __future__ import annotations

import os
from pathlib import Path

from lightsim.errors import InputError


def cache_folder(name: str) -> Path:
    """Return a folder of the cache: $LIGHTSIM_CACHE/NAME, or $XDG_CACHE_HOME/lightsim/NAME, or
    ~/.cache/lightsim/NAME. It is made if needed.

    Raises:
        InputError: it cannot be made.
    """
    given = os.environ.get("LIGHTSIM_CACHE")
    shared = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = (Path(given) if given else Path(shared) / "lightsim") / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise InputError(
            "the folder of the cache cannot be made",
            where=folder,
            got=f"{error}"[:200],
            remedy="Set LIGHTSIM_CACHE to a folder in which you may write.",
        ) from error
    return folder
