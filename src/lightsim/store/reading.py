"""Opening of files for reading, restricted to regular files of a bounded size.

A pipe can block its reader for ever and a device has no end; a log, sky or artefact from an
untrusted source may contain links to them.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from lightsim.errors import InputError

# Largest size of a JSON file, in bytes. A log of an hour has some 10 MB of poses; parsed JSON takes
# up to 25 times its size.
MAX_JSON_BYTES = 16 << 20
# Largest size of an HDR picture, in bytes. A 16k panorama without compression takes 512 MiB as .hdr
# and 768 MiB as half-float RGB .exr.
MAX_PICTURE_BYTES = 1 << 30
_REMEDY = "Check the path and the permissions."


@contextmanager
def open_regular(path: Path, kind: str, max_bytes: int) -> Generator[BinaryIO]:
    """Open a regular file for reading; pass the handle, not the path, to libraries that read files.

    Args:
        path: the file; symbolic links are followed.
        kind: name of the kind of file in errors, such as "picture".
        max_bytes: largest size of the file, in bytes.

    Raises:
        InputError: the file does not exist, is not a regular file, is too large, or cannot be
            opened or read.
    """
    try:
        # Checked before it is opened, since opening a device can have effects, and opened without
        # blocking, in case it was replaced by a pipe after the check.
        _require_regular(path, os.stat(path), kind, max_bytes)
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        got = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"cannot open this {kind}", where=path, got=got, remedy=_REMEDY) from error
    with open(number, "rb") as handle:
        _require_regular(path, os.fstat(number), kind, max_bytes)
        try:
            yield handle
        except OSError as error:
            # A defective disk, or a kernel file (procfs) that only appears to be regular.
            raise InputError(
                f"cannot read this {kind}", where=path, got=error.strerror, remedy=_REMEDY
            ) from error


def read_bytes(path: Path, kind: str, max_bytes: int) -> bytes:
    """Return all bytes of a regular file.

    Raises:
        InputError: as `open_regular`; or the number of bytes differs from the file's size.
    """
    with open_regular(path, kind, max_bytes) as handle:
        size = os.fstat(handle.fileno()).st_size
        # One byte more, which exists if the file has grown.
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
    """Return whether a regular file exists; False for text that cannot be a path."""
    return _is(path, stat.S_ISREG)


def is_folder(path: Path) -> bool:
    """Return whether a folder exists; False for text that cannot be a path."""
    return _is(path, stat.S_ISDIR)


def _is(path: Path, kind: Callable[[int], bool]) -> bool:
    try:
        return kind(path.stat().st_mode)
    except (OSError, ValueError):
        return False
