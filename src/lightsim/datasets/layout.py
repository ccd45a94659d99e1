"""Tests for folders and files of a log, which distinguish absence from an entry of another type."""

from __future__ import annotations

import stat
from collections.abc import Callable
from pathlib import Path

from lightsim.errors import InputError


def has_folder(path: Path) -> bool:
    """Return whether a folder exists.

    Raises:
        InputError: it is no folder, a broken link, or not accessible.
    """
    return _is_there(path, stat.S_ISDIR, "a folder")


def has_file(path: Path) -> bool:
    """Return whether a file exists.

    Raises:
        InputError: it is no file, a broken link, or not accessible.
    """
    return _is_there(path, stat.S_ISREG, "a file")


def subfolders(folder: Path) -> list[Path]:
    """Return the folders in a folder, by name, without hidden ones; none without the folder.

    Raises:
        InputError: a visible entry is no folder.
    """
    if not has_folder(folder):
        return []
    return [path for path in visible_entries(folder) if has_folder(path)]


def visible_entries(folder: Path) -> list[Path]:
    """Return the entries of a folder, by name, without hidden ones.

    Raises:
        InputError: the folder is not accessible.
    """
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise InputError(
            "the folder or file is not accessible",
            where=folder,
            got=error.strerror,
            remedy="Check the permissions.",
        ) from error


def _is_there(path: Path, is_kind: Callable[[int], bool], kind: str) -> bool:
    try:
        mode = path.stat().st_mode
    except NotADirectoryError:
        # A folder above is a file: this call reports it.
        has_folder(path.parent)
        return False
    except FileNotFoundError:
        # A broken link is a damaged copy of a recording, not an absent file.
        if not path.is_symlink():
            return False
        raise InputError(
            "the target of the link does not exist",
            where=path,
            expected=kind,
            remedy="Copy the target to this path, or remove the link.",
        ) from None
    except OSError as error:
        raise InputError(
            "the folder or file is not accessible",
            where=path,
            got=error.strerror,
            remedy="Check the permissions.",
        ) from error
    if not is_kind(mode):
        raise InputError(
            "the path has the wrong type",
            where=path,
            got=_kind_of(mode),
            expected=kind,
            remedy="Copy it again from the original data set, or remove it.",
        )
    return True


def _kind_of(mode: int) -> str:
    if stat.S_ISDIR(mode):
        return "a folder"
    return "a file" if stat.S_ISREG(mode) else "a pipe, device or socket"
