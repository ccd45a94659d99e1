"""Files of named NumPy arrays (.npz), read with checks of size, type and shape."""

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

# Largest size of a file that is read, in bytes. The fields of a street of 300 m, the largest
# arrays, take 2 GB.
_MAX_BYTES = 16 << 30
# Largest size of all compressed arrays of a file after decompression, in bytes. Only small arrays
# are compressed: ground truth of synthetic logs, sky domes for training.
_MAX_INFLATED_BYTES = 1 << 30
_REMEDY = "Delete the file and make it again."


def save_arrays(path: Path, arrays: Mapping[str, Shaped[np.ndarray, "..."]]) -> None:
    """Write named arrays without compression; the file appears whole or not at all.

    Raises:
        InputError: an array holds Python objects, or the folder does not exist.
    """
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise InputError(
                "an array of Python objects cannot be stored",
                where=path,
                got=f"'{name}'",
                expected="numbers, or text of a fixed type",
            )
    with whole_file(path) as temporary, temporary.open("wb") as handle:
        np.savez(handle, allow_pickle=False, **dict(arrays))


def load_arrays(
    path: Path, *, is_mapped: bool = False, max_bytes: int = _MAX_BYTES
) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Return all arrays of a file by name; nothing is unpickled.

    Args:
        max_bytes: largest size of the file, and of its arrays after decompression.
        is_mapped: map the file into memory, so that only pages which are accessed are read. Changes
            of the arrays do not reach the file, and checksums are not verified. Compressed files
            are refused.

    Raises:
        InputError: the file is missing, not a regular file, truncated, damaged, not an .npz file,
            or its headers claim more data than the file can hold.
    """
    try:
        with open_regular(path, "file of arrays", max_bytes) as handle:
            _check_members(handle, min(max_bytes, _MAX_INFLATED_BYTES))
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
        tokenize.TokenError,  # raised for a damaged header
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


def _check_members(handle: BinaryIO, max_inflated: int) -> None:
    """Reject an archive or a member that claims more data than it has.

    Called before arrays are allocated.
    """
    # Headers of a zip archive can claim any size: stored members are compared with the file, and
    # the size after decompression is bounded.
    if not zipfile.is_zipfile(handle):
        raise ValueError("it is not a zip archive")
    with zipfile.ZipFile(handle) as archive:
        members = archive.infolist()
        stored = sum(m.file_size for m in members if m.compress_type == zipfile.ZIP_STORED)
        inflated = sum(m.file_size for m in members) - stored
        if stored > handle.seek(0, os.SEEK_END) or inflated > max_inflated:
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
        raise ValueError(f"'{member.filename}' does not contain plain numbers")
    if claimed != member.file_size:
        raise ValueError(f"'{member.filename}' claims {claimed} bytes of {member.file_size}")


def _mapped(handle: BinaryIO) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Return views of uncompressed members in the mapped file."""
    # Private pages: writes to the arrays do not reach the file.
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
            # Data follows the local header of the zip format: 30 bytes, the name, and extra fields,
            # whose lengths are at byte 26 (APPNOTE.TXT, 4.3.7).
            handle.seek(member.header_offset + 26)
            start = member.header_offset + 30 + sum(struct.unpack("<HH", handle.read(4))) + header
            flat = np.frombuffer(pages, dtype, math.prod(shape), start)
            name = member.filename.removesuffix(".npy")
            arrays[name] = flat.reshape(shape, order="F" if is_fortran else "C")
    return arrays


class ArrayFile:
    """Arrays of one file, returned after a check of type and shape.

    Raises:
        InputError: as `load_arrays`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.arrays = load_arrays(path)
        # Sizes by letter, from the arrays that were taken so far.
        self._sizes: dict[str, int] = {}

    def __contains__(self, name: str) -> bool:
        return name in self.arrays

    def names(self, prefix: str) -> tuple[str, ...]:
        """Return the names of the arrays below a prefix, without the prefix."""
        return tuple(n.removeprefix(prefix) for n in self.arrays if n.startswith(prefix))

    def find(self, name: str, kind: str, shape: str) -> Shaped[np.ndarray, "..."] | None:
        """Return one array as `take`; None if the file does not have it."""
        return self.take(name, kind, shape) if name in self else None

    def take(self, name: str, kind: str, shape: str) -> Shaped[np.ndarray, "..."]:
        """Return one array after a check of its type, shape and finiteness.

        Args:
            kind: NumPy type, such as "f4" or "i8"; "U" is text of any length. Numbers must be
                finite.
            shape: sizes separated by blanks, such as "n 3"; "" is a single number. A letter is any
                size, equal in all arrays of this file that use the letter; "_" is any size.

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
