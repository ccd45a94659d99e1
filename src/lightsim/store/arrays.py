"""Named numpy arrays in one .npz file."""

from __future__ import annotations

import math
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from lightsim.errors import ArtefactError, InputError
from lightsim.store.atomic import require_regular, whole_file

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
        InputError: the file is missing, truncated, damaged, or no .npz file.
    """
    try:
        require_regular(path)
        if not zipfile.is_zipfile(path):
            raise ValueError("it is no zip archive")
        _check_members(path)
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError as error:
        raise InputError("the file does not exist", where=path, remedy=_REMEDY) from error
    except (
        OSError,
        ValueError,
        OverflowError,
        EOFError,
        KeyError,
        NotImplementedError,
        RuntimeError,
        SyntaxError,
        TypeError,
        MemoryError,
        tokenize.TokenError,  # of a damaged header
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


def _check_members(path: Path) -> None:
    """Refuse before anything is allocated: a member must hold just the bytes its header claims.

    `save_arrays` compresses nothing, so what is read is never larger than the file.
    """
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            if member.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"'{member.filename}' is compressed")
            with archive.open(member) as handle:
                version = np.lib.format.read_magic(handle)
                if version != (1, 0):
                    raise ValueError(f"'{member.filename}' has a header of version {version}")
                shape, _, dtype = np.lib.format.read_array_header_1_0(handle)
                claimed = handle.tell() + math.prod(shape) * dtype.itemsize
            if dtype.hasobject or dtype.fields or min(shape, default=0) < 0:
                raise ValueError(f"'{member.filename}' holds no plain numbers")
            if claimed != member.file_size:
                raise ValueError(
                    f"'{member.filename}' claims {claimed} bytes of {member.file_size}"
                )


class ArrayFile:
    """The arrays of one file, each of the type and shape that its reader needs.

    Raises:
        InputError: as `load_arrays`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.arrays = load_arrays(path)
        self._sizes: dict[str, int] = {}

    def __contains__(self, name: str) -> bool:
        return name in self.arrays

    def names(self, prefix: str) -> tuple[str, ...]:
        """Names below a prefix, without it."""
        return tuple(n.removeprefix(prefix) for n in self.arrays if n.startswith(prefix))

    def take(self, name: str, kind: str, shape: str) -> Shaped[np.ndarray, "..."]:
        """One array; a letter in `shape` is any size, the same wherever it stands in this file,
        and "_" any size.

        Args:
            kind: of the type, such as "f4" or "i8"; "U" is any text. Numbers must be finite.
            shape: such as "n 3"; "" is a single number.

        Raises:
            ArtefactError: the array is missing, of another type or shape, or not finite.
        """
        if name not in self.arrays:
            raise ArtefactError(f"the array '{name}' is missing", where=self.path, remedy=_REMEDY)
        array = self.arrays[name]
        is_kind = array.dtype.kind == "U" if kind == "U" else array.dtype == np.dtype(kind)
        words = shape.split()
        sizes = [self._sizes.get(w, int(w) if w.isdigit() else None) for w in words]
        fits = len(sizes) == array.ndim and all(
            s is None or s == n for s, n in zip(sizes, array.shape, strict=True)
        )
        if not is_kind or not fits:
            raise ArtefactError(
                f"the array '{name}' is damaged",
                where=self.path,
                got=f"{array.dtype}{list(array.shape)}",
                expected=f"{kind}[{', '.join(words)}]",
                remedy=_REMEDY,
            )
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ArtefactError(
                f"the array '{name}' is not finite", where=self.path, remedy=_REMEDY
            )
        named = {w: n for w, n in zip(words, array.shape, strict=True) if w.isalpha()}
        self._sizes |= named
        return array
