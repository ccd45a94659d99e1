"""Named numpy arrays in one .npz file."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from lightsim.errors import InputError
from lightsim.store.atomic import whole_file

_REMEDY = "Delete the file and make it again."


def save_arrays(path: Path, arrays: Mapping[str, Shaped[np.ndarray, "..."]]) -> None:
    """Write arrays by name, without compression; the file appears whole or not at all.

    Raises:
        InputError: an array holds Python objects, or the folder does not exist.
    """
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise InputError(
                "an array of Python objects is not stored",
                where=path,
                got=f"'{name}'",
                expected="numbers, or text of a fixed type",
            )
    with whole_file(path) as temporary, temporary.open("wb") as handle:
        np.savez(handle, allow_pickle=False, **dict(arrays))


def load_arrays(path: Path) -> dict[str, Shaped[np.ndarray, "..."]]:
    """All arrays of a file by name; nothing is unpickled.

    Raises:
        InputError: the file is missing, truncated, damaged, or no .npz file.
    """
    try:
        if not path.exists():
            raise FileNotFoundError
        if not zipfile.is_zipfile(path):
            raise ValueError("it is no zip archive")
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError as error:
        raise InputError("the file does not exist", where=path, remedy=_REMEDY) from error
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
