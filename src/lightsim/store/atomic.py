"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import re
import shutil
import socket
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from lightsim.errors import ArtefactError, InputError, LightSimError
from lightsim.store.lock import is_alive

_PARTIAL = re.compile(r"\..*\.(?P<host>[^.]*)-(?P<pid>\d+)\.partial(\.[^.]*)?", re.DOTALL)


@contextmanager
def whole_file(path: Path) -> Generator[Path]:
    """A temporary sibling to write to; it becomes `path` when the block ends without an error.

    The sibling keeps the suffix, by which many writers choose their format; it is removed after
    an error, and by `sweep_partials` where its process was killed.

    Raises:
        InputError: the folder does not exist.
        ArtefactError: the file cannot be written (permissions, full disk, a writer's own error).
    """
    if not path.parent.is_dir():
        raise InputError(
            "the folder to write to does not exist",
            where=path.parent,
            remedy="Create the folder first.",
        )
    temporary = partial_name(path)
    try:
        yield temporary
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:
        # Writers in C++ (OpenEXR, torch) tell a full disk by a RuntimeError.
        raise unwritable(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def partial_name(path: Path) -> Path:
    """Temporary name of a file that is being written: it tells its machine and process."""
    host = re.sub(r"\W", "_", socket.gethostname())
    return path.with_name(f".{path.stem}.{host}-{os.getpid()}.partial{path.suffix}")


def unwritable(path: Path, error: BaseException) -> LightSimError:
    """Our error for a file that could not be written, with the space that is left."""
    if isinstance(error, LightSimError):
        return error
    try:
        left = f", {shutil.disk_usage(path.parent).free / 1e6:.0f} MB left on its disk"
    except OSError:
        left = ""
    return ArtefactError(
        "the file cannot be written",
        where=path,
        got=f"{type(error).__name__}: {error}"[:200] + left,
        remedy="Free space, or choose a folder that you may write to; the same command goes on.",
    )


def sweep_partials(folder: Path) -> int:
    """Remove what killed processes of this machine left half written under a folder; returns how
    many files."""
    host = re.sub(r"\W", "_", socket.gethostname())
    swept = 0
    for path in folder.rglob(".*.partial*") if folder.is_dir() else ():
        found = _PARTIAL.fullmatch(path.name)
        if found is None or found["host"] != host or not path.is_file():
            continue
        if not is_alive(found["pid"], socket.gethostname()):
            path.unlink(missing_ok=True)
            swept += 1
    return swept
