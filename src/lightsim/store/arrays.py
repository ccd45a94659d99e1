"""Named numpy arrays in one .npz file."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Shaped

from lightsim.errors import InputError
from lightsim.store.atomic import whole_file
from lightsim.store.reading import open_regular

_MAX_BYTES = 16 << 30
"""The fields of a street of 300 m take 2 GB; they are stored without compression."""
_MAX_INFLATED_BYTES = 1 << 30
"""Only small arrays are stored compressed: the truth of a synthetic log, domes for training."""
_REMEDY = "Delete the file and make it again."


def save_arrays(path: Path, arrays: Mapping[str, Shaped[np.ndarray, "..."]]) -> None:
    """Write arrays by name, without compression; the file appears whole or not at all.

    Raises:
        InputError: an array holds Python objects, or the folder does not exist.
    """
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise InputError(
                "an array of Python objects is not stored", where=path, got=f"'{name}'"
            )
    with whole_file(path) as temporary, temporary.open("wb") as handle:
        np.savez(handle, allow_pickle=False, **dict(arrays))


def load_arrays(path: Path) -> dict[str, Shaped[np.ndarray, "..."]]:
    """All arrays of a file by name; nothing is unpickled.

    Raises:
        InputError: the file is missing, no regular file, truncated, damaged, no .npz file, or
            unpacks to far more than it holds.
    """
    try:
        with open_regular(path, "file of arrays", _MAX_BYTES) as handle:
            _check_sizes(handle)
            with np.load(handle, allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
    except (
        OSError,
        ValueError,
        EOFError,
        KeyError,
        NotImplementedError,
        RuntimeError,
        SyntaxError,
        TypeError,
        MemoryError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise InputError(
            "the arrays cannot be read; the file is truncated or damaged",
            where=path,
            got=f"{type(error).__name__}: {error}"[:200],
            expected="an .npz file",
            remedy=_REMEDY,
        ) from error


def _check_sizes(handle: BinaryIO) -> None:
    """Refuse archives that would unpack to more than they hold, before anything is unpacked."""
    if not zipfile.is_zipfile(handle):
        raise ValueError("it is no zip archive")
    with zipfile.ZipFile(handle) as archive:
        entries = archive.infolist()
    stored = sum(e.file_size for e in entries if e.compress_type == zipfile.ZIP_STORED)
    inflated = sum(e.file_size for e in entries) - stored
    if stored > handle.seek(0, os.SEEK_END) or inflated > _MAX_INFLATED_BYTES:
        raise ValueError(f"it claims to hold {stored} and, compressed, {inflated} bytes")
    handle.seek(0)
