"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import stat
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from lightsim.errors import InputError

_MAX_BYTES = 1 << 30
"""Of a picture or a mesh; what they hold takes several times their bytes of memory."""


@contextmanager
def whole_file(path: Path) -> Generator[Path]:
    """A temporary sibling to write to; it becomes `path` when the block ends without an error.

    The sibling keeps the suffix, by which many writers choose their format; it is removed after
    an error.

    Raises:
        InputError: the folder does not exist or cannot be written to.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    if not path.parent.is_dir():
        raise InputError(
            "the folder to write to does not exist",
            where=path.parent,
            remedy="Create the folder first.",
        )
    try:
        yield temporary
        os.replace(temporary, path)
    except PermissionError as error:
        raise InputError(
            "the file may not be written",
            where=path,
            got=error,
            remedy="Choose a folder that you may write to.",
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def require_regular(path: Path) -> None:
    """A device or FIFO never ends, or waits for ever: only regular files are opened.

    Raises:
        OSError: the file does not exist, or is no regular file.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError("not a regular file")


def read_bytes(path: Path, kind: str) -> bytes:
    """All bytes of a file the user named.

    Raises:
        InputError: it does not exist, is no regular file, is too large, or cannot be read.
    """
    try:
        require_regular(path)
        if path.stat().st_size > _MAX_BYTES:
            raise ValueError(f"{path.stat().st_size} bytes are more than {_MAX_BYTES}")
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot open this {kind}",
            where=path,
            got=error,
            remedy="Check the path and the permissions.",
        ) from error
