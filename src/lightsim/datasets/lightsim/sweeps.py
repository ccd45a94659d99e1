"""Sweeps of a lightsim-log/1 folder."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.datasets.files import MAX_NUMBER
from lightsim.datasets.lightsim.header import LidarEntry
from lightsim.datasets.lightsim.stamped import stamped_files
from lightsim.datasets.point_files import SUFFIXES, Columns, as_doubles, read_points
from lightsim.datasets.recorded import PointFrame, RawSweep, RecordedSweep, StampedMoment
from lightsim.datasets.sweep_points import without_missing
from lightsim.errors import InputError

# Duration of a turn of a LiDAR with a single sweep, in seconds: 10 Hz.
_TURN_S = 0.1
# Greatest intensities that sensors use: fractions, bytes, 16 bits.
_SCALES = (1.0, 255.0, 65535.0)
_INTENSITY, _TIME, _RING, _CLASS = "intensity", "time_offset_s", "ring", "class"

_KNOWN = ("xyz", "origin", _INTENSITY, _TIME, _RING, _CLASS)


def read_sweeps(
    folder: Path, lidar: LidarEntry
) -> tuple[tuple[RecordedSweep, ...], tuple[str, ...]]:
    """Return the sweeps of a LiDAR in time order, and notes; points are read on demand.

    Raises:
        InputError: the folder or its first file is broken.
    """
    paths, notes = stamped_files(folder, SUFFIXES)
    if not paths:
        return (), notes
    times = np.array(list(paths), dtype=np.int64)
    turn_s = float(np.median(np.diff(times))) * 1e-9 if len(times) > 1 else _TURN_S
    # Sweeps of one LiDAR have the same columns: the first one is examined.
    first = read_points(next(iter(paths.values())), lidar.bin_columns)
    others = [column for column in first if column not in _KNOWN]
    if others:
        notes += (f"{folder.name}: columns that are not used: {', '.join(others)[:80]}",)
    if _INTENSITY not in first:
        notes += (f"{folder.name}: no {_INTENSITY}: it is 0 for all points",)
    has_times = _TIME in first
    if not has_times:
        when = {StampedMoment.START: "half a turn after", StampedMoment.END: "half a turn before"}
        words = when.get(lidar.stamp, "at")
        notes += (f"{folder.name}: no {_TIME}: all points of a sweep count as measured {words} its"
                  " time",)  # fmt: skip
    if lidar.intensity_max is None:
        most = (
            float(np.nanmax(as_doubles(first[_INTENSITY]), initial=0.0))
            if _INTENSITY in first
            else 0.0
        )
        scale = next((scale for scale in _SCALES if most <= scale), _SCALES[-1])
        if scale != 1.0:
            notes += (f"{folder.name}: no intensity_max: intensities up to {most:.4g} are divided"
                      f" by {scale:g}",)  # fmt: skip
        lidar = replace(lidar, intensity_max=scale)
    sign = {StampedMoment.START: 0.5, StampedMoment.END: -0.5}.get(lidar.stamp, 0.0)
    # Five sweeps are the largest offset that any reader accepts (sweep_points.py).
    middle_s = sign * min(turn_s, 2 * _TURN_S)
    sweeps = tuple(
        RecordedSweep(time_ns, path, partial(_load, path, lidar, middle_s))
        for time_ns, path in paths.items()
    )
    return sweeps, notes


def _load(path: Path, lidar: LidarEntry, middle_s: float) -> RawSweep:
    """Return the returns of a file, in frame `ego` or `world`.

    Args:
        middle_s: seconds from the sweep's time to the middle of its turn.
    """
    columns = read_points(path, lidar.bin_columns)
    xyz = as_doubles(columns["xyz"])
    # Rows with NaN are dropped later; infinite ones would warn in between.
    xyz[~(np.abs(xyz) < MAX_NUMBER)] = np.nan
    n = len(xyz)
    offset_s = _numbers(columns, _TIME, path)
    if offset_s is None:
        offset_s = np.full(n, middle_s)
    intensity, most = _numbers(columns, _INTENSITY, path), lidar.intensity_max or 1.0
    return RawSweep(
        without_missing(xyz)
        if lidar.frame is PointFrame.WORLD
        else lidar.ego_from_lidar.apply(xyz),
        lidar.frame,
        lidar.ego_from_lidar.translation_m,
        # Clipped first: a damaged value would overflow in the division.
        np.zeros(n) if intensity is None else np.clip(intensity, -MAX_NUMBER, MAX_NUMBER) / most,
        offset_s,
        _ids(columns, _RING, path),
        _ids(columns, _CLASS, path),
        _origins(columns, lidar),
        most,
    )


def _origins(columns: Columns, lidar: LidarEntry) -> Float64[np.ndarray, "n 3"] | None:
    """Return the sensor's position for each point; only points in the world may have it."""
    if "origin" not in columns or lidar.frame is not PointFrame.WORLD:
        return None
    return as_doubles(columns["origin"])


def _numbers(columns: Columns, name: str, path: Path) -> Float64[np.ndarray, " n"] | None:
    if name not in columns:
        return None
    if columns[name].ndim != 1:
        raise _wrong(name, path, list(columns[name].shape), "one number a point")
    return as_doubles(columns[name])


def _ids(columns: Columns, name: str, path: Path) -> Int64[np.ndarray, " n"] | None:
    values = _numbers(columns, name, path)
    if values is None:
        return None
    # NaN fails the comparisons.
    is_good = (values >= -1) & (values < 2**15)
    is_good[is_good] = values[is_good] % 1 == 0
    if not is_good.all():
        i = int(np.argmin(is_good))
        raise _wrong(name, path, f"{values[i]:g} in row {i}", f"whole numbers, -1 to {2**15 - 1}")
    return values.astype(np.int64)


def _wrong(name: str, path: Path, got: object, expected: str) -> InputError:
    return InputError(
        f"the column '{name}' contains a wrong value", where=path, got=got, expected=expected
    )
