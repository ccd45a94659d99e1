"""Atomic writing of files: a file appears whole or not at all."""

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

# Temporary names as `partial_name` makes them.
_PARTIAL = re.compile(r"\..*\.(?P<host>[^.]*)-(?P<pid>\d+)\.partial(\.[^.]*)?", re.DOTALL)


@contextmanager
def whole_file(path: Path) -> Generator[Path]:
    """Yield a temporary path, which is renamed to `path` if the block ends without an error.

    The temporary path has the same suffix, by which many writers choose the format. It is removed
    after an error; after the process was killed, `sweep_partials` removes it.

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
        # Writers in C++ (OpenEXR, torch) raise RuntimeError when the disk is full.
        raise unwritable(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def partial_name(path: Path) -> Path:
    """Return a temporary path for writing a file, with the names of machine and process."""
    # By host and process, `sweep_partials` recognises files whose writer has ended.
    host = re.sub(r"\W", "_", socket.gethostname())
    return path.with_name(f".{path.stem}.{host}-{os.getpid()}.partial{path.suffix}")


def unwritable(path: Path, error: BaseException) -> LightSimError:
    """Return the error for a file that cannot be written, with the free space of its disk."""
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
        remedy="Free space, or choose a folder that you may write to; the same command continues.",
    )


def sweep_partials(folder: Path) -> None:
    """Remove the partly written files that killed processes of this machine left below a folder."""
    host = re.sub(r"\W", "_", socket.gethostname())
    for path in folder.rglob(".*.partial*") if folder.is_dir() else ():
        found = _PARTIAL.fullmatch(path.name)
        if found is None or found["host"] != host or not path.is_file():
            continue
        if not is_alive(found["pid"], socket.gethostname()):
            path.unlink(missing_ok=True)
