"""LiDAR sweeps of Argoverse 2, and the times at which they scan a direction."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from lightsim.core.frames import RigidTransform
from lightsim.datasets.columns import number_column, whole_column
from lightsim.datasets.feather import read_feather
from lightsim.datasets.recorded import PointFrame, RawSweep
from lightsim.datasets.sweep_points import without_missing

# Height of the rear axle, the origin of Argoverse 2's ego frame, above the road, in metres: median
# of the axle above the map's ground height over the 2,706 poses of log 7fab2350 (standard deviation
# .03 m). The radius of the tyres is .33 m.
_AXLE_M = 0.32
EGO_FROM_AXLE = RigidTransform.from_rotation(
    "ego", "axle", np.eye(3), np.array([0.0, 0.0, _AXLE_M])
)
"""From the data set's ego frame, at the rear axle, to LightSim's, on the road below it."""
LIDARS = ("up_lidar", "down_lidar")
"""LiDARs of a sweep: lasers 0 to 31 are those of the upper one, 32 to 63 those of the lower one
(Sweep in av2-api, src/av2/structures/sweep.py; av2-api issue 77)."""
# Lasers of one LiDAR.
_LASERS = 32
# Largest number of returns of a sweep: the two LiDARs have some 100,000.
_MAX_RETURNS = 2_000_000
# Largest intensity, of 8 bits.
_INTENSITY_MAX = 255.0
# Width of the sectors in which scan times are averaged, in degrees. Chosen: 1.4 ms of a turn.
_SECTOR_DEG = 5


def load_sweep(path: Path, origins_ego: Float64[np.ndarray, "2 3"]) -> RawSweep:
    """Load the returns of both LiDARs. They are compensated for the ego's motion to the sweep's
    time stamp, which is that of its start (av2-api, Sweep; issues 204 and 227).

    Coordinates are stored as float16, whose steps are 3 cm from 32 m on, and 6 cm from 64 m on.

    Args:
        origins_ego: positions of `LIDARS`.

    Raises:
        InputError: the file is damaged, or a column is missing or has values out of range.
    """
    numbers = ("x", "y", "z", "intensity", "laser_number")
    table = read_feather(path, numbers, max_rows=_MAX_RETURNS, optional=("offset_ns",))
    laser = whole_column(table, "laser_number", path, 0, len(LIDARS) * _LASERS - 1)
    columns = {name: number_column(table, name, path) for name in table}
    with np.errstate(invalid="ignore"):
        # Signalling NaNs of float16; such rows are dropped later.
        points = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
        intensity = columns["intensity"].astype(np.float64) / _INTENSITY_MAX
    offset_s = columns["offset_ns"].astype(np.float64) * 1e-9 if "offset_ns" in columns else None
    return RawSweep(
        without_missing(points) + EGO_FROM_AXLE.translation_m,
        PointFrame.SWEEP_TIME,
        origins_ego[laser // _LASERS],
        intensity,
        offset_s,
        laser,
        full_scale=_INTENSITY_MAX,
    )


@dataclass(frozen=True)
class ScanTiming:
    """Mean time after the start of a sweep at which the LiDARs scan each sector of azimuth.

    The two LiDARs turn half a turn apart, so that they scan each direction twice in a sweep, 50 ms
    apart. Boxes are drawn around the returns of both scans as they are stored, which follow the
    ego's motion but not the actor's (num_interior_pts counts them exactly), so that the time of a
    box is taken as the mean of both scans, 30 to 80 ms after the time stamp. Of the returns that
    labels count in boxes of vehicles above 9 m/s in log 7fab2350, 92 % are then inside their box at
    the time of the scan, but 44 % with boxes at the time stamp.
    """

    sector_s: Float64[np.ndarray, " k"]

    @staticmethod
    def of(sweep: RawSweep) -> ScanTiming | None:
        """Measure the scan times of a sweep; None if its returns have no times."""
        if sweep.time_offset_s is None or sweep.ring is None or not len(sweep.points):
            return None
        count = 360 // _SECTOR_DEG
        is_good = np.isfinite(sweep.points).all(axis=1) & (np.abs(sweep.time_offset_s) < 1.0)
        sectors = _sectors((sweep.points - sweep.origins_ego)[is_good])
        # A sector of one LiDAR: each LiDAR has the same weight.
        cells = sectors + count * (sweep.ring[is_good] // _LASERS)
        number = np.bincount(cells, minlength=2 * count)
        total = np.bincount(cells, sweep.time_offset_s[is_good], minlength=2 * count)
        means = (total / np.maximum(number, 1)).reshape(2, count)
        has_returns = (number > 0).reshape(2, count)
        found = has_returns.sum(axis=0)
        if not found.any():
            return None
        sector_s = (means * has_returns).sum(axis=0) / np.maximum(found, 1)
        return ScanTiming(np.where(found > 0, sector_s, sector_s[found > 0].mean()))

    def offsets_s(self, points_ego: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        """Return the seconds from the start of a sweep to the scan of each point."""
        return self.sector_s[_sectors(points_ego)]


def _sectors(points: Float[np.ndarray, "n 3"]) -> np.ndarray:
    azimuth_deg = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    return (np.floor(azimuth_deg / _SECTOR_DEG).astype(np.int64)) % (360 // _SECTOR_DEG)
