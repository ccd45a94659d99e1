"""A synthetic street in the layout of KITTI raw: one colour camera, raw sweeps and OXTS records,
without boxes (Geiger et al. 2013, doi:10.1177/0278364913491297)."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from lightsim.core.frames import RigidTransform
from lightsim_lab.synthetic.lidar import Returns, scan
from lightsim_lab.synthetic.plan import StreetConfig
from lightsim_lab.synthetic.rig import LIDAR_HEIGHT_M, SWEEP_S, mount_cameras, world_from_ego
from lightsim_lab.synthetic.street import Street
from lightsim_lab.synthetic.truth import stem_of
from lightsim_lab.synthetic.writer import latitude_longitude_deg

_DATE = "2011_09_26"
_CAMERA = "front_camera"
# KITTI's times are local: Central European Summer Time, 2 hours ahead of UTC.
_CEST_S = 7200.0
# Pose of the LiDAR.
_EGO_FROM_VELO = RigidTransform.from_rotation(
    "ego", "velo", np.eye(3), np.array([0.0, 0.0, LIDAR_HEIGHT_M])
)
# Pose of the GPS/IMU unit, at the height of KITTI's.
_EGO_FROM_IMU = RigidTransform.from_rotation("ego", "imu", np.eye(3), np.array([0.0, 0.0, 0.93]))


def record_as_kitti(street: Street, config: StreetConfig, log: Path, out: Path) -> Path:
    """Write OUT/2011_09_26 with one drive, and return the folder of the drive.

    Args:
        log: folder of the street's log in PandaSet's layout, whose pictures are copied.
    """
    date = out / _DATE
    drive = date / f"{_DATE}_drive_{street.plan.seed:04d}_sync"
    (mounted,) = (m for m in mount_cameras(street.plan, config) if m.camera.name == _CAMERA)
    camera = mounted.camera
    camera_from_velo = mounted.ego_from_camera.inverse() @ _EGO_FROM_VELO
    velo_from_imu = _EGO_FROM_VELO.inverse() @ _EGO_FROM_IMU
    # The first pixel's centre is (0, 0) in KITTI. The camera is its own rectified reference.
    projection = [camera.fx, 0, camera.cx - 0.5, 0, 0, camera.fy, camera.cy - 0.5, 0, 0, 0, 1, 0]
    _write(date / "calib_cam_to_cam.txt", {
        "S_rect_02": [camera.width_px, camera.height_px],
        "R_rect_00": np.eye(3).ravel().tolist(),
        "R_rect_02": np.eye(3).ravel().tolist(),
        "P_rect_02": projection,
    })  # fmt: skip
    for name, transform in (("velo_to_cam", camera_from_velo), ("imu_to_velo", velo_from_imu)):
        _write(date / f"calib_{name}.txt", {
            "R": transform.rotation.ravel().tolist(), "T": transform.translation_m.tolist(),
        })  # fmt: skip
    times_s = [SWEEP_S * k for k in range(config.frame_count)]
    for k, time_s in enumerate(times_s):
        name = f"{k:010d}"
        _copy(log / "camera" / _CAMERA / f"{stem_of(k)}.jpg",
              drive / "image_02" / "data" / f"{name}.jpg")  # fmt: skip
        sweep = drive / "velodyne_points" / "data" / f"{name}.bin"
        sweep.parent.mkdir(parents=True, exist_ok=True)
        if not sweep.exists():
            rng = np.random.default_rng([street.plan.seed, 24, k])
            found = scan(street, config, time_s, rng)
            points = _at_own_times(street, config, time_s, found)
            rows = np.column_stack([points, found.intensity / 255.0]).astype(np.float32)
            rows.tofile(sweep)
        record = drive / "oxts" / "data" / f"{name}.txt"
        record.parent.mkdir(parents=True, exist_ok=True)
        record.write_text(_oxts(street, config, time_s + mounted.time_offset_s))
    taken = [t + mounted.time_offset_s for t in times_s]
    _write_times(drive / "image_02" / "timestamps.txt", street, taken)
    _write_times(drive / "oxts" / "timestamps.txt", street, taken)
    points = drive / "velodyne_points"
    # A sweep starts and ends at the rear; its time stamp is that of the middle, ahead.
    for name, offset_s in (("", -SWEEP_S / 2), ("_start", -SWEEP_S), ("_end", 0.0)):
        _write_times(points / f"timestamps{name}.txt", street, [t + offset_s for t in times_s])
    return drive


def _at_own_times(
    street: Street, config: StreetConfig, time_s: float, found: Returns
) -> Float64[np.ndarray, "n 3"]:
    """Return the points in frame `velo` at the time of each."""
    points = np.empty_like(found.points_world)
    for offset in np.unique(found.offset_s):
        rows = found.offset_s == offset
        pose = world_from_ego(street.plan, config, time_s + float(offset)) @ _EGO_FROM_VELO
        points[rows] = pose.inverse().apply(found.points_world[rows])
    return points


def _oxts(street: Street, config: StreetConfig, time_s: float) -> str:
    """Return a record: latitude, longitude, altitude, roll, pitch, yaw, and 24 zeros."""
    pose = street.plan.enu_from_world @ world_from_ego(street.plan, config, time_s) @ _EGO_FROM_IMU
    yaw, pitch, roll = Rotation.from_matrix(pose.rotation).as_euler("ZYX").tolist()
    latitude_deg, longitude_deg = latitude_longitude_deg(street.plan, pose.translation_m)
    values = [latitude_deg, longitude_deg, float(pose.translation_m[2]), roll, pitch, yaw]
    return " ".join(f"{value:.12f}" for value in [*values, *[0.0] * 24]) + "\n"


def _write_times(path: Path, street: Street, times_s: list[float]) -> None:
    local = [street.plan.start_ns + round((t + _CEST_S) * 1e9) for t in times_s]
    lines = [str(np.datetime64(ns, "ns")).replace("T", " ") for ns in local]
    path.write_text("\n".join(lines) + "\n")


def _write(path: Path, entries: dict[str, list[float]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"{key}: {' '.join(f'{v:.12g}' for v in values)}" for key, values in entries.items()]
    path.write_text("\n".join(lines) + "\n")


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
