"""Point files of LiDARs: 5 float32 for each return (x, y, z, intensity, ring)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from lightsim.core.frames import RigidTransform
from lightsim.datasets.recorded import PointFrame, RawSweep
from lightsim.errors import InputError
from lightsim.store.reading import read_bytes

# Lasers of the HDL-32E.
_LASERS = 32
# Duration of a turn of the HDL-32E, in seconds: 20 Hz.
_TURN_S = 0.05
# Largest size of a sweep, in bytes: 3 million returns; merged clouds have up to 300 thousand.
_MAX_SWEEP_BYTES = 60 << 20
# Largest intensity, of 8 bits.
_INTENSITY_MAX = 255.0
VEHICLE_M = 1.5
"""Distance from the sensor below which returns are of the recording vehicle, or no returns, in
metres. nuScenes has 22 to 24 % there (measured on scene-0061)."""
MERGED = "LIDAR_CONCAT"
"""Channel of the merged cloud of several LiDARs in the T4 format, in frame `ego`; the positions of
the LiDARs are not recorded."""


@dataclass(frozen=True)
class LidarMount:
    """A LiDAR on the vehicle.

    Args:
        origin_ego: start of the beams in frame `ego`.
        has_turn: returns are stored in the order of the turn, 32 in each column.
    """

    channel: str
    ego_from_lidar: RigidTransform
    origin_ego: Float64[np.ndarray, "3"]
    has_turn: bool

    def scan_offset_s(self, points_ego: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Return the times at which directions are scanned, in seconds from the sweep's stamp; 0
        for an unknown pattern.

        A turn starts at the sensor's -x, the vehicle's left, and is clockwise from above.
        """
        if not self.has_turn:
            return np.zeros(len(points_ego))
        x, y, _ = self.ego_from_lidar.inverse().apply(points_ego).T
        phase = (np.pi - np.arctan2(y, x)) / (2 * np.pi) % 1.0
        return (phase - 1.0) * _TURN_S


def has_turn(path: Path) -> bool:
    """Return whether the returns of a sweep are stored in the order of the turn.

    Raises:
        InputError: the file is missing or damaged.
    """
    return _is_ordered(_read(path))


def load_sweep(path: Path, mount: LidarMount) -> RawSweep:
    """Return the returns of a sweep, without those of the vehicle itself.

    Points are in the sensor's frame at the time stamp, which is that of the end of the turn: the
    motion of the ego vehicle is compensated (neurad-studio undoes it by the same rule). The file
    has no times: they follow from the columns.

    Raises:
        InputError: the file is missing or damaged.
    """
    stored = _read(path)
    n = len(stored)
    # Signalling NaN in damaged files.
    with np.errstate(invalid="ignore"):
        points, intensity = stored[:, :3].astype(np.float64), stored[:, 3].astype(np.float64)
    is_finite = np.isfinite(points)
    distance_m = np.linalg.norm(np.where(is_finite, points, 0.0), axis=1)
    is_used = is_finite.all(axis=1) & ((distance_m > VEHICLE_M) | (mount.channel == MERGED))
    offset_s = None
    if mount.has_turn and _is_ordered(stored):
        columns = n // _LASERS
        offset_s = (np.arange(n) // _LASERS / columns - 1.0)[is_used] * _TURN_S
    return RawSweep(
        mount.ego_from_lidar.apply(points[is_used]),
        PointFrame.SWEEP_TIME,
        mount.origin_ego,
        intensity[is_used] / _INTENSITY_MAX,
        offset_s,
        _rings(stored)[is_used],
        full_scale=_INTENSITY_MAX,
    )


def _read(path: Path) -> Float32[np.ndarray, "n 5"]:
    data = read_bytes(path, "sweep", _MAX_SWEEP_BYTES)
    if not data or len(data) % 20:
        raise InputError(
            "the sweep is truncated, or of another format",
            where=path,
            got=f"{len(data)} bytes",
            expected="5 float32 for each return: x, y, z, intensity, ring",
            remedy="Copy the file again from the original data set, or remove it: sweeps may be"
            " missing.",
        )
    return np.frombuffer(data, dtype="<f4").reshape(-1, 5).astype(np.float32)


def _is_ordered(stored: Float32[np.ndarray, "n 5"]) -> bool:
    """Return whether returns are stored column after column, each with all lasers from below."""
    n = len(stored)
    # In float32: a signalling NaN of a damaged file would warn when it is cast to float64.
    rings = (np.arange(n) % _LASERS).astype(np.float32)
    return n % _LASERS == 0 and bool((stored[:, 4] == rings).all())


def _rings(stored: Float32[np.ndarray, "n 5"]) -> np.ndarray:
    """Return the laser of each return; -1 if the column has other numbers."""
    rings = stored[:, 4]
    with np.errstate(invalid="ignore"):
        is_ring = (rings >= 0) & (rings < 256) & (rings == np.floor(rings))
    return np.where(is_ring, rings, -1).astype(np.int64)
