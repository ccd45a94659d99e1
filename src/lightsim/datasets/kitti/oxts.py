"""Ego path of KITTI from its GPS/IMU unit, an OXTS RT3003: one text file for each frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import Place
from lightsim.datasets.geo import east_north_m, is_null
from lightsim.datasets.kitti.text import read_rows, read_times_ns, stamped_files
from lightsim.errors import InputError

IMU_ABOVE_ROAD_M = 0.93
"""Height of the unit above the road (Geiger et al. 2013, figure 3)."""
# Numbers in each file, in the order of dataformat.txt: lat, lon (degrees), alt (m), roll, pitch,
# yaw (rad; yaw is 0 towards east and counter-clockwise), and 24 others.
_FIELDS = 30
# Largest values of the first six numbers; Mercator's projection ends near the poles.
_LIMITS = np.array([85.0, 180.0, 1e4, np.pi, np.pi, 2 * np.pi]) + 1e-3


def read_oxts(folder: Path) -> tuple[Trajectory, Place, list[str]]:
    """Return `world_from_ego` in a world frame with x east, y north and z up, the place of the
    first record, and notes.

    Positions are on the tangent plane of WGS 84. The devkit's Mercator projection, on a sphere,
    would shorten paths to the east by 0.2 % and lengthen those to the north by 0.1 % in Karlsruhe.

    Raises:
        InputError: there is no record, or one is implausible.
    """
    files, notes = stamped_files(
        folder / "data", (".txt",), read_times_ns(folder / "timestamps.txt"), "oxts"
    )
    if not files:
        raise InputError("the log has no poses", where=folder, expected="data/0000000000.txt, ...")
    records = np.stack([read_rows(file.path, _FIELDS)[0, :6] for file in files])
    is_bad = (np.abs(records) > _LIMITS).any(axis=1) | is_null(records[:, 0], records[:, 1])
    if is_bad.any():
        i = int(np.flatnonzero(is_bad)[0])
        raise InputError(
            "a record of the GPS/IMU unit is out of range",
            where=files[i].path,
            got=records[i].tolist(),
            expected="latitude and longitude in degrees (0, 0 is no fix), altitude in metres,"
            " angles in radians",
        )
    times_ns = np.array([file.time_ns for file in files], dtype=np.int64)
    trajectory = Trajectory("world", "ego", times_ns, _poses(records))
    return trajectory, Place(float(records[0, 0]), float(records[0, 1])), notes


def _poses(records: Float64[np.ndarray, "n 6"]) -> Float64[np.ndarray, "n 4 4"]:
    poses = np.tile(np.eye(4), (len(records), 1, 1))
    # Pitch is positive front down and roll left side up: right-handed about y (left) and x.
    poses[:, :3, :3] = Rotation.from_euler("ZYX", records[:, [5, 4, 3]]).as_matrix()
    poses[:, :2, 3] = east_north_m(records[:, 0].copy(), records[:, 1].copy())
    poses[:, 2, 3] = records[:, 2]
    return poses @ ego_from_imu().inverse().matrix


def ego_from_imu() -> RigidTransform:
    """Return the transform to the ego frame: axes of the unit, its origin on the road."""
    return RigidTransform.from_rotation(
        "ego", "imu", np.eye(3), np.array([0.0, 0.0, IMU_ABOVE_ROAD_M])
    )
