"""Named numpy arrays in one .npz file."""

from __future__ import annotations

import math
import mmap
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Shaped

from lightsim.errors import ArtefactError, InputError
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
                "an array of Python objects is not stored",
                where=path,
                got=f"'{name}'",
                expected="numbers, or text of a fixed type",
            )
    with whole_file(path) as temporary, temporary.open("wb") as handle:
        np.savez(handle, allow_pickle=False, **dict(arrays))


def load_arrays(path: Path, *, is_mapped: bool = False) -> dict[str, Shaped[np.ndarray, "..."]]:
    """All arrays of a file by name; nothing is unpickled.

    Args:
        is_mapped: what is looked at is read from the file then, and nothing else; a change of the
            arrays stays in memory, and checksums are not looked at. Not for compressed files.

    Raises:
        InputError: the file is missing, no regular file, truncated, damaged, no .npz file, or
            unpacks to far more than it holds.
    """
    try:
        with open_regular(path, "file of arrays", _MAX_BYTES) as handle:
            _check_members(handle)
            if is_mapped:
                return _mapped(handle)
            with np.load(handle, allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
    except (
        OSError,
        ValueError,
        OverflowError,
        EOFError,
        KeyError,
        NotImplementedError,
        RuntimeError,
        struct.error,
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


def _check_members(handle: BinaryIO) -> None:
    """Refuse before anything is allocated: the archive unpacks to no more than it holds, and every
    member has just the bytes that its header claims."""
    if not zipfile.is_zipfile(handle):
        raise ValueError("it is no zip archive")
    with zipfile.ZipFile(handle) as archive:
        members = archive.infolist()
        stored = sum(m.file_size for m in members if m.compress_type == zipfile.ZIP_STORED)
        inflated = sum(m.file_size for m in members) - stored
        if stored > handle.seek(0, os.SEEK_END) or inflated > _MAX_INFLATED_BYTES:
            raise ValueError(f"it claims to hold {stored} and, compressed, {inflated} bytes")
        for member in members:
            _check_member(archive, member)
    handle.seek(0)


def _check_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    with archive.open(member) as handle:
        version = np.lib.format.read_magic(handle)
        if version != (1, 0):
            raise ValueError(f"'{member.filename}' has a header of version {version}")
        shape, _, dtype = np.lib.format.read_array_header_1_0(handle)
        claimed = handle.tell() + math.prod(shape) * dtype.itemsize
    if dtype.hasobject or dtype.fields or min(shape, default=0) < 0:
        raise ValueError(f"'{member.filename}' holds no plain numbers")
    if claimed != member.file_size:
        raise ValueError(f"'{member.filename}' claims {claimed} bytes of {member.file_size}")


def _mapped(handle: BinaryIO) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Views of the members, whose bytes stand in the file as they are."""
    pages = mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_COPY)
    arrays = {}
    with zipfile.ZipFile(handle) as archive:
        for member in archive.infolist():
            if member.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"'{member.filename}' is compressed")
            with archive.open(member) as stored:
                np.lib.format.read_magic(stored)
                shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(stored)
                header = stored.tell()
            # A member's own header: 30 bytes, its name, and more fields (APPNOTE.TXT, 4.3.7).
            handle.seek(member.header_offset + 26)
            start = member.header_offset + 30 + sum(struct.unpack("<HH", handle.read(4))) + header
            flat = np.frombuffer(pages, dtype, math.prod(shape), start)
            name = member.filename.removesuffix(".npy")
            arrays[name] = flat.reshape(shape, order="F" if is_fortran else "C")
    return arrays


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
