"""The one way to open a file for reading: regular files of a bounded size, nothing else.

A pipe blocks its reader for ever and a device has no end, and a log, a sky or an artefact that a
stranger made may well hold links to them.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from lightsim.errors import InputError

MAX_JSON_BYTES = 16 << 20
"""A log of an hour has some 10 MB of poses; parsed, JSON takes up to 25 times its size."""
MAX_PICTURE_BYTES = 1 << 30
"""A 16k panorama without compression takes 512 MiB as .hdr and 800 MiB as half-float .exr."""
_REMEDY = "Check the path and the permissions."


@contextmanager
def open_regular(path: Path, kind: str, max_bytes: int) -> Generator[BinaryIO]:
    """The open file. Libraries that read on their own get this handle instead of the path.

    Args:
        path: the file; links are followed.
        kind: a word for errors, such as "picture".
        max_bytes: its largest size.

    Raises:
        InputError: it does not exist, is no regular file, is too large, or cannot be opened or
            read.
    """
    try:
        # Looked at before it is opened, since opening a device can already do something; and
        # opened without waiting, in case it became a pipe in between.
        _require_regular(path, os.stat(path), kind, max_bytes)
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        got = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"cannot open this {kind}", where=path, got=got, remedy=_REMEDY) from error
    with open(number, "rb") as handle:
        _require_regular(path, os.fstat(number), kind, max_bytes)
        try:
            yield handle
        except (
            OSError
        ) as error:  # A broken disk, or a file of the kernel's that only looks regular.
            raise InputError(
                f"cannot read this {kind}", where=path, got=error.strerror, remedy=_REMEDY
            ) from error


def read_bytes(path: Path, kind: str, max_bytes: int) -> bytes:
    """All bytes of a regular file.

    Raises:
        InputError: as `open_regular`; or it could not be read to the end that its size told.
    """
    with open_regular(path, kind, max_bytes) as handle:
        size = os.fstat(handle.fileno()).st_size
        data = handle.read(size + 1)
    if len(data) != size:
        raise InputError(
            f"this {kind} changed while it was read",
            where=path,
            got=f"{len(data)} bytes or more",
            expected=f"{size} bytes",
            remedy="Wait until it is written, then try again.",
        )
    return data


def _require_regular(path: Path, status: os.stat_result, kind: str, max_bytes: int) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise InputError(
            f"cannot open this {kind}",
            where=path,
            got="a folder" if stat.S_ISDIR(status.st_mode) else "a pipe, device or socket",
            expected="a regular file",
            remedy=_REMEDY,
        )
    if status.st_size > max_bytes:
        raise InputError(
            f"this {kind} is too large",
            where=path,
            got=f"{status.st_size} bytes",
            expected=f"at most {max_bytes} bytes",
        )


def is_file(path: Path) -> bool:
    """Whether a regular file is there; words that cannot be a path name none."""
    return _is(path, stat.S_ISREG)


def is_folder(path: Path) -> bool:
    """Whether a folder is there; words that cannot be a path name none."""
    return _is(path, stat.S_ISDIR)


def _is(path: Path, kind: Callable[[int], bool]) -> bool:
    try:
        return kind(path.stat().st_mode)
    except (OSError, ValueError):
        return False
