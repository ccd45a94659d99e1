"""Locks on work folders, so that two commands cannot mix their files.

The lock is flock(2) on a small file. The kernel releases it when its process ends in any way, so no
stale lock can remain. The file's text only serves to name the process in errors.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import socket
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from lightsim.errors import ArtefactError

LOCK_NAME = ".lock"
# Error numbers of file systems without locks.
_WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL)
# Error numbers of folders that may not be written to.
_READ_ONLY = (errno.EACCES, errno.EROFS, errno.EPERM)

logger = logging.getLogger(__name__)


@contextmanager
def locked(path: Path, *, is_shared: bool = False, is_waiting: bool = False) -> Generator[None]:
    """Hold the lock file `path` while the block runs; its folder must exist.

    Args:
        path: lock file; it is created if it is missing, and is not deleted.
        is_shared: take a reader's lock, which several readers can hold at a time. A reader
            continues without a lock in a read-only folder, since nothing can write there.
        is_waiting: wait for the lock instead of raising an error.

    Raises:
        ArtefactError: another process holds the lock; the message names that process.
    """
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        if is_shared and error.errno in _READ_ONLY:
            yield
            return
        raise ArtefactError(
            "the folder may not be written",
            where=path.parent,
            got=error.strerror,
            remedy="Choose a folder that you may write to.",
        ) from error
    try:
        _take(handle, path, is_shared=is_shared, is_waiting=is_waiting)
        _sign(handle, keep_others=is_shared)
        yield
    finally:
        os.close(handle)


def _take(handle: int, path: Path, *, is_shared: bool, is_waiting: bool) -> None:
    how = fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX
    try:
        fcntl.flock(handle, how if is_waiting else how | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise ArtefactError(
            "another command is using this folder",
            where=path.parent,
            got=_holders(handle) or "an unknown process",
            remedy="Wait until it has ended, or stop it.",
        ) from error
    except OSError as error:
        if error.errno not in _WITHOUT_LOCKS:
            raise
        logger.warning("%s: its file system has no locks: run one command at a time", path.parent)


def _sign(handle: int, *, keep_others: bool) -> None:
    """Write the holder of the lock into the file, for the error of other processes."""
    # A reader adds its line, since other readers may hold the lock, too.
    lines = _living(handle) if keep_others else []
    words = " ".join(" ".join(sys.argv[:2]).split())[:200]
    lines.append(f"{os.getpid()} {socket.gethostname()} {words}")
    os.ftruncate(handle, 0)
    os.pwrite(handle, ("\n".join(lines) + "\n").encode(errors="replace"), 0)


def _holders(handle: int) -> str:
    names = (line.split(maxsplit=2) for line in _living(handle))
    return "; ".join(f"process {pid} on {host} ({' '.join(words)})" for pid, host, *words in names)


def _living(handle: int) -> list[str]:
    """Return the lines of the lock file, without processes of this machine that have ended."""
    text = os.pread(handle, 1 << 16, 0).decode(errors="replace")
    lines = [line for line in text.splitlines() if len(line.split()) >= 2]
    return [line for line in lines if is_alive(*line.split()[:2])]


def is_alive(pid: str, host: str) -> bool:
    """Return whether a process may still run; True for processes of other machines."""
    if host != socket.gethostname() or not pid.isdigit():
        return True
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
