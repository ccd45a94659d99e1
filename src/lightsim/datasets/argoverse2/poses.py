"""Poses and calibration of Argoverse 2, from its Feather files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.core.frames import RigidTransform, Trajectory, matrices_from_quaternions
from lightsim.datasets.argoverse2.sweeps import EGO_FROM_AXLE
from lightsim.datasets.columns import number_column, whole_column
from lightsim.datasets.feather import read_feather
from lightsim.datasets.files import MAX_NUMBER
from lightsim.datasets.lenses import Lens
from lightsim.datasets.plausible import LIMITS, check_intrinsics, check_mounting
from lightsim.datasets.safe_pickle import Table
from lightsim.errors import InputError

POSES = "city_SE3_egovehicle.feather"
"""Poses of the ego vehicle in the city's frame, at the times of all sensors."""
MOUNTING = "calibration/egovehicle_SE3_sensor.feather"
INTRINSICS = "calibration/intrinsics.feather"
QUATERNION = ("qw", "qx", "qy", "qz")
TRANSLATION = ("tx_m", "ty_m", "tz_m")
MAX_TIME_NS = 1 << 62
"""Largest accepted time stamp, in nanoseconds."""
# Largest number of poses: ten minutes at 170 Hz; the longest logs have 117 s.
_MAX_POSES = 100_000
# Longest accepted drive, in seconds. Some poses are a nanosecond apart, which interpolation in
# seconds of double precision resolves over a few hours.
_MAX_DRIVE_S = 3600.0
# Largest number of sensors.
_MAX_SENSORS = 100
# Largest picture side, in pixels.
_MAX_SIDE_PX = 20_000


def read_ego(log: Path) -> tuple[Trajectory, tuple[str, ...]]:
    """Return `world_from_ego` in the city's frame, and notes.

    Raises:
        InputError: the file is damaged, or a pose is not finite or too far away.
    """
    path = log / POSES
    numbers = ("timestamp_ns", *QUATERNION, *TRANSLATION)
    table = read_feather(path, numbers, max_rows=_MAX_POSES)
    times_ns = whole_column(table, "timestamp_ns", path, 0, MAX_TIME_NS)
    matrices = matrices_of(table, path)
    if not len(times_ns):
        raise InputError("the file has no poses", where=path, expected="one row or more")
    times_ns, first = np.unique(times_ns, return_index=True)
    _check_span(times_ns, path)
    matrices = matrices[first] @ EGO_FROM_AXLE.inverse().matrix
    distances_m = np.abs(matrices[:, :3, 3]).max(axis=1)
    row = int(np.argmax(distances_m))
    LIMITS["coordinate"].check(
        f"{path}, row {first[row]}", float(distances_m[row]), f"{distances_m[row]:.4g} m"
    )
    doubled = len(table["timestamp_ns"]) - len(times_ns)
    notes = (f"{doubled} ego poses have the time of another one and are not used",)
    return Trajectory("world", "ego", times_ns, matrices), notes if doubled else ()


def _check_span(times_ns: Int64[np.ndarray, " n"], path: Path) -> None:
    seconds = float(times_ns[-1] - times_ns[0]) * 1e-9
    if seconds > _MAX_DRIVE_S:
        raise InputError(
            "the times of the poses are not of one drive",
            where=path,
            got=f"{times_ns[0]} to {times_ns[-1]} ns",
            expected=f"at most {_MAX_DRIVE_S:g} s from the first to the last",
            remedy="Download the file again from the original data set.",
        )


def read_mounting(log: Path) -> Mapping[str, RigidTransform]:
    """Return `ego_from_sensor` of all sensors.

    Raises:
        InputError: the file is damaged, or a sensor is not on the vehicle.
    """
    path = log / MOUNTING
    table = read_feather(
        path, (*QUATERNION, *TRANSLATION), max_rows=_MAX_SENSORS, texts=("sensor_name",)
    )
    found: dict[str, RigidTransform] = {}
    for name, matrix in zip(table["sensor_name"], matrices_of(table, path), strict=True):
        check_mounting(f"{path}, {name}", matrix[:3, 3])
        found[name] = RigidTransform("ego", "camera", EGO_FROM_AXLE.matrix @ matrix)
    return found


def read_lenses(log: Path) -> Mapping[str, Lens]:
    """Return the lenses of all cameras.

    The pictures are already undistorted: k1, k2 and k3 are those of the real lens, and are not
    applied (av2-api issues 219 and 226, "All camera imagery is provided in an undistorted format").
    The principal point counts from the centre of the first pixel: av2-api's image positions range
    from 0 to width - 1 (PinholeCamera.cull_to_view_frustum).

    Raises:
        InputError: the file is damaged, or intrinsics are implausible.
    """
    path = log / INTRINSICS
    names = ("fx_px", "fy_px", "cx_px", "cy_px")
    table = read_feather(
        path, (*names, "width_px", "height_px"), max_rows=_MAX_SENSORS, texts=("sensor_name",)
    )
    sizes = [whole_column(table, name, path, 1, _MAX_SIDE_PX) for name in ("width_px", "height_px")]
    values = finite_columns(table, names, path)
    found: dict[str, Lens] = {}
    for name, width, height, row in zip(table["sensor_name"], *sizes, values, strict=True):
        fx, fy, cx, cy = row.tolist()
        # The name of the camera in place of a file: intrinsics of all cameras are in one.
        check_intrinsics(path / f"{name}", (int(width), int(height)), (fx, fy), (cx, cy))
        found[name] = Lens("pinhole", int(width), int(height), fx, fy, cx + 0.5, cy + 0.5)
    return found


def matrices_of(table: Table, path: Path) -> Float64[np.ndarray, "n 4 4"]:
    """Return the transforms of the rows of a table, with quaternion and translation.

    Raises:
        InputError: a number is not finite, or a quaternion has no length near 1.
    """
    values = finite_columns(table, (*QUATERNION, *TRANSLATION), path)
    lengths = np.linalg.norm(values[:, :4], axis=1)
    # Wide limits, since quaternions are normalised below: other lengths are another quantity.
    is_bad = ~((lengths > 0.5) & (lengths < 2.0))
    if is_bad.any():
        row = int(np.flatnonzero(is_bad)[0])
        raise InputError(
            "the rotation is not a unit quaternion",
            where=f"{path}, row {row}",
            got=f"length {lengths[row]:.3g}",
            remedy="Download the file again from the original data set.",
        )
    matrices = np.tile(np.eye(4), (len(values), 1, 1))
    if len(values):
        matrices[:, :3, :3] = matrices_from_quaternions(values[:, :4])
    matrices[:, :3, 3] = values[:, 4:]
    return matrices


def finite_columns(table: Table, names: tuple[str, ...], path: Path) -> Float64[np.ndarray, "n k"]:
    """Return columns of numbers side by side.

    Raises:
        InputError: a number is not finite or too large.
    """
    values = np.stack([number_column(table, name, path) for name in names], axis=1)
    with np.errstate(invalid="ignore"):
        values = values.astype(np.float64)
    # NaN fails the comparison.
    is_bad = ~(np.abs(values) <= MAX_NUMBER)
    if is_bad.any():
        row, column = (int(i) for i in np.argwhere(is_bad)[0])
        raise InputError(
            f"the column '{names[column]}' contains a number that is not finite or too large",
            where=f"{path}, row {row}",
            got=values[row, column],
            remedy="Remove the row, or download the file again from the original data set.",
        )
    return values
