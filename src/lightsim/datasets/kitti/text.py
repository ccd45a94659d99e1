"""Text files of KITTI and KITTI-360: tables of numbers, time stamps, and numbered files."""

from __future__ import annotations

import codecs
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from lightsim.core.frames import RigidTransform
from lightsim.datasets.files import MAX_NUMBER
from lightsim.datasets.layout import has_file, has_folder, visible_entries
from lightsim.errors import InputError
from lightsim.store.reading import read_bytes

Table = Mapping[str, Float64[np.ndarray, " n"]]
"""Numbers of a text file by the key of their line."""
# Largest text file, in bytes: the poses of an hour take 6 MB.
_MAX_BYTES = 32 << 20
_TIME = re.compile(r"(\d{4})-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?", re.ASCII)
# Years in which vehicles had such sensors.
_YEARS = (1980, 2100)
# Largest error of a rotation of a calibration, which has 7 digits.
_MAX_SHEAR = 1e-3
_REMEDY = "Copy the file again from the original data set."


def read_lines(path: Path) -> list[str]:
    """Return the lines of an ASCII file.

    Raises:
        InputError: the file is missing, too large or not ASCII.
    """
    try:
        data = read_bytes(path, "text file", _MAX_BYTES).removeprefix(codecs.BOM_UTF8)
        return data.decode("ascii").splitlines()
    except UnicodeDecodeError as error:
        raise InputError("the file is no text", where=path, got=error, remedy=_REMEDY) from error


def read_table(path: Path) -> Table:
    """Return the lines of the form `key: numbers`; other lines are ignored, such as dates."""
    table: dict[str, np.ndarray] = {}
    for line in read_lines(path):
        key, _, words = line.partition(":")
        numbers = _numbers(words)
        if numbers is not None and len(numbers):
            table[key.strip()] = numbers
    return table


def entry(table: Table, key: str, shape: tuple[int, ...], path: Path) -> np.ndarray:
    """Return the numbers of a key, in a shape.

    Raises:
        InputError: the key is missing, or has another number of numbers.
    """
    found = table.get(key)
    if found is None or len(found) != np.prod(shape):
        raise InputError(
            f"the file has no valid '{key}'",
            where=path,
            got="no such line, or no finite numbers" if found is None else f"{len(found)} numbers",
            expected=f"'{key}:' and {np.prod(shape)} finite numbers",
            remedy=_REMEDY,
        )
    return found.reshape(shape)


def read_rows(path: Path, columns: int) -> Float64[np.ndarray, "n m"]:
    """Return lines with an equal number of numbers.

    Raises:
        InputError: there is none, or a line has another number of numbers.
    """
    rows: list[np.ndarray] = []
    for number, line in enumerate(read_lines(path), 1):
        numbers = _numbers(line)
        if numbers is not None and not len(numbers):
            continue
        if numbers is None or len(numbers) != columns:
            raise InputError(
                "the line is no row of the table",
                where=f"{path}, line {number}",
                got=line[:60],
                expected=f"{columns} finite numbers",
                remedy=_REMEDY,
            )
        rows.append(numbers)
    if not rows:
        raise InputError("the file has no rows", where=path, remedy=_REMEDY)
    return np.stack(rows)


def _numbers(words: str) -> Float64[np.ndarray, " n"] | None:
    """Return the numbers of a line; None if one is not a finite number."""
    try:
        numbers = np.array([float(word) for word in words.split()], dtype=np.float64)
    except ValueError:
        return None
    return numbers if (np.abs(numbers) <= MAX_NUMBER).all() else None


def read_times_ns(path: Path) -> dict[int, int]:
    """Return time stamps in nanoseconds, by the number of the frame.

    They are times of day without a zone, here converted as if they were UTC. Empty lines are
    frames that a sensor lost (tomas789/kitti2bag, issue 4).

    Raises:
        InputError: a line is no time, or there is none.
    """
    lines = {n: line.strip() for n, line in enumerate(read_lines(path)) if line.strip()}
    try:
        for line in lines.values():
            found = _TIME.fullmatch(line)
            if found is None or not _YEARS[0] <= int(found[1]) < _YEARS[1]:
                raise ValueError(f"'{line[:40]}'")
        stamps = np.array(list(lines.values()), dtype="datetime64[ns]").astype(np.int64)
    except ValueError as error:
        raise InputError(
            "a line is no time stamp",
            where=path,
            got=error,
            expected="such as 2011-09-26 13:17:59.287203584, of 1980 to 2099",
            remedy=_REMEDY,
        ) from error
    if not len(stamps):
        raise InputError("the file has no time stamps", where=path, remedy=_REMEDY)
    return dict(zip(lines, stamps.tolist(), strict=True))


@dataclass(frozen=True)
class StampedFile:
    """A file of one frame."""

    number: int
    time_ns: int
    path: Path


def stamped_files(
    folder: Path, suffixes: tuple[str, ...], times_ns: Mapping[int, int], name: str
) -> tuple[list[StampedFile], list[str]]:
    """Return the files of a folder that are named by indices of frames, in time order, and notes.

    Args:
        name: of the sensor, for notes.

    Raises:
        InputError: the files are counted from 1.
    """
    if not has_folder(folder):
        return [], []
    files = [
        (int(path.stem), path)
        for path in visible_entries(folder)
        if path.suffix.lower() in suffixes and path.stem.isascii() and path.stem.isdigit()
        and len(path.stem) <= 10 and has_file(path)
    ]  # fmt: skip
    numbers = {number for number, _ in files}
    if 0 in times_ns and 0 not in numbers and max(times_ns) + 1 in numbers:
        raise InputError(
            "the files are counted from 1",
            where=folder,
            got=f"numbers {min(numbers)} to {max(numbers)}",
            expected=f"0 to {max(times_ns)}, as the lines of the time stamps",
            remedy="Rename the files, each to the number of its time stamp.",
        )
    found = [StampedFile(n, times_ns[n], path) for n, path in files if n in times_ns]
    found.sort(key=lambda file: (file.time_ns, file.number))
    # Of two files with one time, the first is used: velocities would be infinite.
    kept = [f for i, f in enumerate(found) if i == 0 or f.time_ns > found[i - 1].time_ns]
    counts = (
        (len(files) - len(found), "have no time stamp"),
        (len(found) - len(kept), "repeat a time stamp"),
    )
    return kept, [f"{name}: {n} files {words} and are not used" for n, words in counts if n]


def rigid(
    dst: str,
    src: str,
    rotation: Float64[np.ndarray, "3 3"],
    translation_m: Float64[np.ndarray, "3"],
    where: object,
) -> RigidTransform:
    """Return the transform with the rotation nearest to one with rounded numbers.

    Raises:
        InputError: the matrix is no rotation.
    """
    return RigidTransform.from_rotation(
        dst, src, nearest_rotations(rotation[None], where)[0], translation_m
    )


def nearest_rotations(
    matrices: Float64[np.ndarray, "n 3 3"], where: object
) -> Float64[np.ndarray, "n 3 3"]:
    """Return the rotations nearest to matrices with rounded numbers.

    Raises:
        InputError: a matrix is no rotation.
    """
    products = matrices @ matrices.transpose(0, 2, 1)
    is_bad = np.abs(products - np.eye(3)).max(axis=(1, 2)) > _MAX_SHEAR
    is_bad |= np.linalg.det(matrices) < 0
    if is_bad.any():
        raise InputError(
            "a matrix is no rotation",
            where=where,
            got=matrices[is_bad][0].round(4).tolist(),
            expected="orthonormal rows, right-handed",
            remedy=_REMEDY,
        )
    u, _, vt = np.linalg.svd(matrices)
    return u @ vt
