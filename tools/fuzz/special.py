"""Files that are no files: missing, folders, links to devices, FIFOs, sockets, loops."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

from .mutations import Rng, pick


def replace_by_special(path: Path, rng: Rng) -> str:
    """Put something that is no regular file in the place of a file or folder."""
    change = pick(rng, _CHANGES)
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
    change(path)
    return f"{path.name}: {change.__name__.strip('_')}"


def any_path(folder: Path, rng: Rng) -> Path:
    """A file or folder below `folder`."""
    return pick(rng, sorted(folder.rglob("*")))


def _missing(path: Path) -> None: ...


def _a_folder(path: Path) -> None:
    path.mkdir()


def _an_empty_file(path: Path) -> None:
    path.touch()


def _a_link_to_dev_zero(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _a_link_to_dev_null(path: Path) -> None:
    path.symlink_to("/dev/null")


def _a_link_to_proc_mem(path: Path) -> None:
    path.symlink_to("/proc/self/mem")


def _a_link_to_proc_status(path: Path) -> None:
    path.symlink_to("/proc/self/status")


def _a_fifo(path: Path) -> None:
    os.mkfifo(path)


def _a_link_to_a_fifo(path: Path) -> None:
    target = path.with_name(".fifo")
    if not target.exists():
        os.mkfifo(target)
    path.symlink_to(target)


def _a_socket(path: Path) -> None:
    here = os.getcwd()
    os.chdir(path.parent)  # names of sockets are short
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(path.name)
    os.chdir(here)


def _a_link_loop(path: Path) -> None:
    path.symlink_to(path.name)


def _a_link_to_nothing(path: Path) -> None:
    path.symlink_to("nowhere")


def _a_link_to_its_folder(path: Path) -> None:
    path.symlink_to("..")


def _a_sparse_giant(path: Path) -> None:
    with path.open("wb") as handle:
        handle.truncate(64 << 30)


_CHANGES: tuple[Callable[[Path], None], ...] = (
    _missing, _missing, _a_folder, _an_empty_file, _a_link_to_dev_zero, _a_link_to_dev_null,
    _a_link_to_proc_mem, _a_link_to_proc_status, _a_fifo, _a_link_to_a_fifo, _a_socket,
    _a_link_loop, _a_link_to_nothing, _a_link_to_its_folder, _a_sparse_giant,
)  # fmt: skip
