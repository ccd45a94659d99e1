"""Sweeps of the Velodyne HDL-64E of KITTI and KITTI-360, whose points are not motion compensated.

Rows are x, y, z, reflectance, sorted by laser; neither laser nor time is stored. The time follows
from the azimuth: the scanner triggers the cameras when it faces forward (Geiger et al. 2013,
doi:10.1177/0278364913491297, section 3.1), which is the time stamp of a sweep.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from lightsim.core.frames import RigidTransform
from lightsim.datasets.kitti.text import read_times_ns, stamped_files
from lightsim.datasets.layout import has_file
from lightsim.datasets.recorded import PointFrame, RawSweep, RecordedSweep
from lightsim.errors import InputError
from lightsim.store.reading import read_bytes

# Direction of rotation from above: -1 is clockwise, left before right. The devkit of KITTI-360
# by the authors of both data sets (accumuLaser, CurlVelodyneData) moves points on the left by the
# motion before the time stamp. KISS-ICP (issue 453), CT-ICP (issue 2) and NCore (pull request 109)
# use the same formula, although NCore calls it counter-clockwise. Not measured: no original sweep
# of a moving drive was available.
_TURN = -1.0
# Duration of a revolution, in seconds: 10 Hz.
_NOMINAL_S = 0.1
# Limits of the duration, in seconds; durations beyond them are those of other time stamps.
_LIMITS_S = (0.05, 0.2)
# Bytes of a point.
_POINT_BYTES = 16
# Largest file, in bytes: 4 million points, 30 times those of a sweep.
_MAX_BYTES = 64 << 20


@dataclass(frozen=True)
class Revolution:
    """Timing of one sweep.

    Args:
        seconds: duration.
        before_s: seconds from its start until the scanner faces forward.
    """

    seconds: float = _NOMINAL_S
    before_s: float = _NOMINAL_S / 2

    def offsets_s(self, points_velo: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Return the seconds from the time stamp to the time when each point was scanned."""
        turns = _TURN * np.arctan2(points_velo[:, 1], points_velo[:, 0]) / (2 * np.pi)
        before = self.before_s / self.seconds
        return ((turns + before) % 1.0 - before) * self.seconds


def read_revolutions(folder: Path, times_ns: Mapping[int, int]) -> dict[int, Revolution]:
    """Return the timing of each sweep, from its start and end times if the folder has them.
    Otherwise a sweep is assumed to last until the next one and to start behind the vehicle."""
    stamps = np.array(sorted(times_ns.values()), dtype=np.int64)
    period_s = float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else _NOMINAL_S
    if not _LIMITS_S[0] <= period_s <= _LIMITS_S[1]:
        period_s = _NOMINAL_S
    found = dict.fromkeys(times_ns, Revolution(period_s, period_s / 2))
    paths = [folder / f"timestamps_{end}.txt" for end in ("start", "end")]
    if not all(has_file(path) for path in paths):
        return found
    starts, ends = (read_times_ns(path) for path in paths)
    for number in found.keys() & starts.keys() & ends.keys():
        seconds = (ends[number] - starts[number]) * 1e-9
        before_s = (times_ns[number] - starts[number]) * 1e-9
        if _LIMITS_S[0] <= seconds <= _LIMITS_S[1] and 0.0 <= before_s <= seconds:
            found[number] = Revolution(seconds, before_s)
    return found


def read_sweeps(
    folder: Path,
    times_ns: Mapping[int, int],
    revolutions: Mapping[int, Revolution],
    ego_from_velo: RigidTransform,
) -> tuple[tuple[RecordedSweep, ...], list[str]]:
    """Return the sweeps of a folder velodyne_points, and notes."""
    files, notes = stamped_files(folder / "data", (".bin",), times_ns, "velodyne")
    sweeps = tuple(
        RecordedSweep(
            file.time_ns,
            file.path,
            partial(_load, file.path, ego_from_velo, revolutions[file.number]),
        )
        for file in files
    )
    return sweeps, notes


def _load(path: Path, ego_from_velo: RigidTransform, revolution: Revolution) -> RawSweep:
    data = read_bytes(path, "sweep", _MAX_BYTES)
    if not data or len(data) % _POINT_BYTES:
        raise InputError(
            "the sweep is truncated or damaged",
            where=path,
            got=f"{len(data)} bytes",
            expected=f"a multiple of {_POINT_BYTES}: x, y, z, reflectance in float32",
            remedy="Copy it again from the original data set, or remove it.",
        )
    rows = np.frombuffer(data, dtype="<f4").reshape(-1, 4)
    # Infinite numbers would cause invalid products; rows with NaN are dropped later.
    is_finite = np.isfinite(rows).all(axis=1, keepdims=True)
    table = np.where(is_finite, rows, np.float32(np.nan)).astype(np.float64)
    points = table[:, :3]
    return RawSweep(
        ego_from_velo.apply(points),
        PointFrame.OWN_TIME,
        ego_from_velo.translation_m,
        table[:, 3],
        revolution.offsets_s(points),
    )
