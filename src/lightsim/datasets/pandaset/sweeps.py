"""PandaSet's LiDAR sweeps: points and sensor positions in frame `world`."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lightsim.core.frames import Trajectory
from lightsim.core.sensors import LidarSweep
from lightsim.datasets.columns import number_column, whole_column
from lightsim.datasets.files import read_json, require_object
from lightsim.datasets.first_sweeps import check_frame, full_scale, scale_note
from lightsim.datasets.layout import has_file
from lightsim.datasets.pandaset.rig import Rig, ego_from_pandar64, positions_along
from lightsim.datasets.plausible import LIMITS
from lightsim.datasets.safe_pickle import LabelledTable, Table, read_table
from lightsim.errors import InputError

_LOGGER = logging.getLogger(__name__)
_COLUMNS = ("x", "y", "z", "i", "t", "d")
INTENSITY_MAX = 255.0
"""Largest intensity in PandaSet, of 8 bits."""
_CLASS = re.compile(r"[0-9]{1,6}")
# Largest class id, of int16; PandaSet has 42 classes.
_MAX_CLASS = 2**15 - 1
# Largest difference between the times of a return and its sweep, in seconds: five sweeps.
_MAX_TIME_OFFSET_S = 0.5
# Values of column `d`.
_ROOF = 0  # Pandar64
_FRONT = 1  # PandarGT
_Labels = Int64[np.ndarray, " n"] | None
# Azimuth bins of the scan pattern: 5 degrees each.
_N_BINS = 72


@dataclass(frozen=True, eq=False)
class SweepSource:
    """File of a sweep, with the calibration and ego path for points and origins.

    Args:
        intensity_max: intensity of the strongest return; PandaSet stores bytes.
    """

    path: Path
    class_path: Path | None
    stem: str
    time_ns: int
    ego: Trajectory
    rig: Rig
    intensity_max: float = INTENSITY_MAX


def load_sweep(source: SweepSource) -> LidarSweep:
    """Load the sweep of both LiDARs. Rows with non-finite values are dropped and logged.

    Returns:
        Points and origins in frame `world`; `ring` is -1 (PandaSet does not store it).

    Raises:
        InputError: the file is damaged, empty, or its times are not those of the sweep, or its
            points lie elsewhere.
    """
    table, is_good = read_rows(source.path)
    classes = _read_classes(source, table)[is_good]
    points = np.stack([table[k][is_good] for k in ("x", "y", "z")], axis=1)
    times_ns, device = _times_and_device(table, is_good, source)
    origins = _origins(source, times_ns, device)
    range_m = float(np.median(np.linalg.norm(points - origins, axis=1)))
    got = f"half of them more than {range_m:.4g} m away"
    LIMITS["range"].check(source.path, range_m, got)
    n = len(points)
    return LidarSweep(
        source.stem,
        source.time_ns,
        points.astype(np.float32),
        origins.astype(np.float32),
        np.clip(table["i"][is_good] / source.intensity_max, 0.0, 1.0).astype(np.float32),
        ((times_ns - source.time_ns) * 1e-9).astype(np.float32),
        np.full(n, -1, dtype=np.int16),
        classes,
    )


def with_known_scale(
    sources: dict[int, SweepSource],
) -> tuple[dict[int, SweepSource], tuple[str, ...]]:
    """Return the sweeps with the scale of intensities that the first one shows, and notes.

    Raises:
        InputError: a sweep is broken, or points are not in the world frame.
    """
    if not sources:
        return sources, ()
    first, last = (sources[number] for number in (min(sources), max(sources)))
    rows, is_good = read_rows(first.path)
    scale = full_scale(rows["i"][is_good], INTENSITY_MAX)
    check_frame(load_sweep(first), load_sweep(last), last.path)
    scaled = {number: replace(s, intensity_max=scale) for number, s in sources.items()}
    return scaled, scale_note("lidar", scale, INTENSITY_MAX)


@dataclass(frozen=True, eq=False)
class ScanTiming:
    """Scan pattern: time within a sweep at which the roof LiDAR measures each azimuth.

    Boxes are labelled on these points, so this is also the time at which a box is valid.

    Args:
        offset_s: seconds from the time of the sweep, by azimuth in frame `ego` (72 bins from -180
            degrees).
    """

    offset_s: Float64[np.ndarray, " bins"]

    @staticmethod
    def instantaneous() -> ScanTiming:
        """Return a pattern that measures all directions at the time of the sweep."""
        return ScanTiming(np.zeros(_N_BINS))

    def offsets_s(self, points_ego: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Return the time of points relative to the sweep, in seconds, by their azimuth."""
        return self.offset_s[_bins(points_ego)]


def measure_timing(source: SweepSource) -> ScanTiming:
    """Measure the scan pattern from the times of points in one sweep.

    The Pandar64 has the same pattern in every sweep. The PandarGT is not synchronised (it drifts by
    3 ms per sweep in sequence 002) and is left out.

    Raises:
        InputError: as `load_sweep`.
    """
    table, is_good = read_rows(source.path)
    times_ns, device = _times_and_device(table, is_good, source)
    is_roof = device == _ROOF
    if not is_roof.any():
        return ScanTiming.instantaneous()
    points = np.stack([table[k][is_good] for k in ("x", "y", "z")], axis=1)
    pose = source.ego.at(source.time_ns, hold_s=_MAX_TIME_OFFSET_S)
    rays_ego = pose.inverse().rotate(points - _origins(source, times_ns, device))
    bins = _bins(rays_ego[is_roof])
    offsets_s = ((times_ns - source.time_ns) * 1e-9)[is_roof]
    table_s = np.full(_N_BINS, np.nan)
    for i in np.unique(bins):
        # The median: few points in the bin of the seam belong to the other end of the revolution.
        table_s[i] = np.median(offsets_s[bins == i])
    filled = np.flatnonzero(np.isfinite(table_s))
    # Bins without points (open sky, for example) get the time of the
    # nearest bin, across the seam at 180 degrees, too.
    gap = np.abs((np.arange(_N_BINS)[:, None] - filled + _N_BINS // 2) % _N_BINS - _N_BINS // 2)
    return ScanTiming(table_s[filled[np.argmin(gap, axis=1)]])


def _bins(points_ego: Float64[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    azimuth = np.arctan2(points_ego[:, 1], points_ego[:, 0])
    return (np.floor((azimuth / (2 * np.pi) + 0.5) * _N_BINS)).astype(np.int64) % _N_BINS


def read_rows(path: Path) -> tuple[LabelledTable, Bool[np.ndarray, " n"]]:
    """Read the stored rows of a sweep's file, and a mask of the rows that `load_sweep` uses.

    Raises:
        InputError: the file is damaged, or no row is valid.
    """
    table = read_table(path, _COLUMNS)
    table |= {name: number_column(table, name, path) for name in _COLUMNS}
    n = len(table["x"])
    is_good = np.ones(n, dtype=bool)
    for name in _COLUMNS:
        is_good &= np.isfinite(table[name])
    for name in ("x", "y", "z"):
        is_good &= np.abs(table[name].astype(np.float64)) < LIMITS["coordinate"].most
    # Exporters write 0, 0, 0 for missing returns.
    is_good &= (table["x"] != 0) | (table["y"] != 0) | (table["z"] != 0)
    if not is_good.any():
        raise InputError(
            "the sweep has no valid point",
            where=path,
            got=f"{n} rows",
            remedy="Remove the file: sweeps may be missing.",
        )
    if not is_good.all():
        _LOGGER.warning(
            "%s: dropped %d of %d points that are not finite, zero or beyond any LiDAR's range",
            path, int(n - is_good.sum()), n,
        )  # fmt: skip
    return table, is_good


def _times_and_device(
    table: Table, is_good: Bool[np.ndarray, " n"], source: SweepSource
) -> tuple[Int64[np.ndarray, " m"], Int64[np.ndarray, " m"]]:
    """Return time in nanoseconds and LiDAR (0 roof, 1 front) of every valid point."""
    seconds = table["t"][is_good].astype(np.float64)
    offset_s = seconds - source.time_ns * 1e-9
    worst = float(np.abs(offset_s).max())
    if worst > _MAX_TIME_OFFSET_S:
        raise InputError(
            "the points' times are not those of the sweep",
            where=source.path,
            got=f"up to {worst:.3g} s from lidar/timestamps.json",
            expected=f"at most {_MAX_TIME_OFFSET_S} s",
        )
    device = table["d"][is_good]
    if not np.isin(device, (_ROOF, _FRONT)).all():
        raise InputError(
            "the column 'd' names an unknown LiDAR",
            where=source.path,
            got=np.unique(device)[:5].tolist(),
            expected="0 (Pandar64) or 1 (PandarGT)",
        )
    # Doubles of seconds since 1970 resolve 0.2 microseconds: further digits are noise.
    return np.round(seconds * 1e6).astype(np.int64) * 1000, device.astype(np.int64)


def _origins(
    source: SweepSource, times_ns: Int64[np.ndarray, " n"], device: Int64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3"]:
    transform = ego_from_pandar64()
    roof = positions_along(source.ego, transform.translation_m.copy(), times_ns)
    front = positions_along(source.ego, transform.apply(source.rig.front_lidar_pandar64), times_ns)
    return np.where((device == _FRONT)[:, None], front, roof)


def _read_classes(source: SweepSource, sweep: LabelledTable) -> np.ndarray:
    """Return the class of each row of a sweep, stored or sorted or filtered as the sweep may be."""
    n = len(sweep["x"])
    if source.class_path is None:
        return np.full(n, -1, dtype=np.int16)
    table = read_table(source.class_path, ("class",))
    rows = _matching_rows(sweep.row_labels, n, table.row_labels, len(table["class"]))
    if rows is None:
        raise InputError(
            "the classes do not match the sweep's points",
            where=source.class_path,
            got=f"{len(table['class'])} rows",
            expected=f"{n}, one for each point of {source.path.name}",
            remedy="Sweep and classes must be of one sequence; copy both again.",
        )
    classes = whole_column(table, "class", source.class_path, -1, _MAX_CLASS)
    return classes[rows].astype(np.int16)


def _matching_rows(
    labels: _Labels, n: int, other_labels: _Labels, other_n: int
) -> Int64[np.ndarray, " n"] | slice | None:
    """Return the row of another table for each row of a table; None if they do not match.

    Labels of rows decide where one of the tables was sorted or filtered; otherwise, row by row.
    """
    if labels is None and other_labels is None:
        return slice(None) if n == other_n else None
    own = np.arange(n) if labels is None else labels
    other = np.arange(other_n) if other_labels is None else other_labels
    is_plain = np.array_equal(own, np.arange(n)) and np.array_equal(other, np.arange(other_n))
    if not is_plain and other_n and len(np.unique(own)) == n and len(np.unique(other)) == other_n:
        order = np.argsort(other)
        rows = order[np.minimum(np.searchsorted(other, own, sorter=order), other_n - 1)]
        if np.array_equal(other[rows], own):
            return rows
    return slice(None) if n == other_n else None


def read_class_names(path: Path) -> dict[int, str]:
    """Read the names of point classes by id; empty if the sequence has no such labels.

    Raises:
        InputError: the file is broken.
    """
    if not has_file(path):
        return {}
    names = require_object(read_json(path), path)
    if not all(_CLASS.fullmatch(key) and isinstance(name, str) for key, name in names.items()):
        raise InputError(
            "the class names are not a table of number: name",
            where=path,
            got=f"{names!r:.60}",
            expected='such as {"1": "Smoke"}',
        )
    return {int(key): name for key, name in names.items()}
