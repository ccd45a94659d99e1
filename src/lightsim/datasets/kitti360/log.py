"""Reader of KITTI-360 (Liao et al. 2022, doi:10.1109/TPAMI.2022.3179507).

Layout of the root: calibration/*, data_2d_raw/<drive>/image_0x/{data_rect or data_rgb}/*.png,
data_3d_raw/<drive>/velodyne_points/data/*.bin, data_poses/<drive>/poses.txt and
data_3d_bboxes/train*/<drive>.xml. SOURCE is the root, and --scene names the drive.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import Clock, DrivingLog, FindEgoVehicle, Place
from lightsim.core.reading import LogReading
from lightsim.datasets.assemble import assemble
from lightsim.datasets.geo import Located
from lightsim.datasets.kitti.log import CEST_NS, LICENCE
from lightsim.datasets.kitti.oxts import IMU_ABOVE_ROAD_M
from lightsim.datasets.kitti.pictures import check_pixels, read_camera
from lightsim.datasets.kitti.text import (
    Table,
    entry,
    nearest_rotations,
    read_rows,
    read_table,
    read_times_ns,
    rigid,
)
from lightsim.datasets.kitti.velodyne import read_revolutions, read_sweeps
from lightsim.datasets.kitti360.boxes import read_boxes
from lightsim.datasets.layout import has_file, has_folder, subfolders
from lightsim.datasets.lenses import Lens
from lightsim.datasets.plausible import check_intrinsics, check_mounting
from lightsim.datasets.reader import LogReader
from lightsim.datasets.recorded import RecordedCamera, RecordedLog
from lightsim.datasets.scenes import chosen_scene
from lightsim.errors import InputError
from lightsim.store.reading import is_file, is_folder

_PINHOLES, _FISHEYES = ("image_00", "image_01"), ("image_02", "image_03")
# Stamps have no zone. They are taken as local time, as in KITTI; whether they are UTC is not known,
# and an hour is the standard deviation of a choice between two clocks 2 hours apart.
_CLOCK = Clock(-CEST_NS, "assumed: local time (CEST)", 3600.0)
_CLOCK_NOTE = "time stamps have no zone: taken as local time (CEST); --utc overrides them"
# Latitude and longitude of the world frame's origin, a lake in Karlsruhe (kitti360Scripts,
# convertOxtsToPose.py).
_ORIGIN_DEG = (48.9843445, 8.4295857)
# Radius of the sphere of the Mercator projection, in metres (the same source).
_EARTH_M = 6378137.0
# Largest coefficient of a lens; KITTI-360 has 2.2.
_MAX_COEFFICIENT = 20.0
# Limits of a fisheye's view along the width of its pictures, in radians; KITTI-360 has 3.4.
_FISHEYE_RAD = (1.0, 7.0)


def read_kitti360(reading: LogReading, find_ego_vehicle: FindEgoVehicle) -> DrivingLog:
    """Read a drive; each side fisheye is given as several pinhole views.

    Raises:
        InputError: something is missing or broken; the message names the file.
    """
    root = Path(reading.source)
    drive = chosen_scene(_scenes(root), reading)
    rig_path, velo_path = (
        root / "calibration" / name for name in ("calib_cam_to_pose.txt", "calib_cam_to_velo.txt")
    )
    rig = read_table(rig_path)
    cameras: list[RecordedCamera] = []
    notes: list[str] = [_CLOCK_NOTE]
    for name in (*_PINHOLES, *_FISHEYES):
        lens, cam_from_camera, lens_notes = _lens(root / "calibration", name)
        camera, camera_notes = read_camera(
            root / "data_2d_raw" / drive / name,
            "data_rect" if name in _PINHOLES else "data_rgb",
            lens,
            _ego_from_cam(rig, name, rig_path) @ cam_from_camera,
        )
        cameras.append(camera)
        notes += [*lens_notes, *camera_notes]
    velo = read_rows(velo_path, 12)[0].reshape(3, 4)
    velo_from_cam = rigid("velo", "cam", velo[:, :3], velo[:, 3], velo_path)
    ego_from_velo = _ego_from_cam(rig, "image_00", rig_path) @ velo_from_cam.inverse()
    check_mounting(velo_path, ego_from_velo.translation_m)
    times_ns = _frame_times_ns(root, drive)
    ego, posed_ns, ego_notes = _read_ego(root / "data_poses" / drive / "poses.txt", times_ns)
    points = root / "data_3d_raw" / drive / "velodyne_points"
    sweeps, sweep_notes = read_sweeps(
        points, times_ns, read_revolutions(points, times_ns), ego_from_velo
    )
    labels = _labels_path(root, drive)
    actors, actor_notes = ((), []) if labels is None else read_boxes(labels, posed_ns)
    recorded = RecordedLog(
        drive,
        tuple(cameras),
        ego,
        {"velodyne": sweeps},
        actors,
        Located(None, _place(ego), _CLOCK, 90.0),
        notes=(*notes, *ego_notes, *sweep_notes, *actor_notes),
        licence=LICENCE,
    )
    return assemble(recorded, reading, find_ego_vehicle)


def _ego_from_cam(rig: Table, name: str, path: Path) -> RigidTransform:
    """Return the pose of an unrectified camera; its frame is `cam`."""
    matrix = entry(rig, name, (3, 4), path)
    return _ego_from_imu() @ rigid("imu", "cam", matrix[:, :3], matrix[:, 3], path)


def _ego_from_imu() -> RigidTransform:
    """Return the transform from the unit's frame, whose axes are forward, right and down."""
    return RigidTransform.from_rotation(
        "ego", "imu", np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, IMU_ABOVE_ROAD_M])
    )


def _lens(folder: Path, name: str) -> tuple[Lens, RigidTransform, tuple[str, ...]]:
    """Return the lens of a camera, `cam_from_camera`, and notes.

    Poses are those of unrectified cameras; rectification turns them by R_rect (kitti360Scripts,
    issue 28). The centre of the first pixel is (0, 0).
    """
    if name in _FISHEYES:
        return _fisheye(folder / f"{name}.yaml"), RigidTransform.identity("cam", "camera"), ()
    path, number = folder / "perspective.txt", name[-2:]
    table = read_table(path)
    width, height = check_pixels(entry(table, f"S_rect_{number}", (2,), path), path)
    p = entry(table, f"P_rect_{number}", (3, 4), path)
    fx, fy, cx, cy = (float(p[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    notes = check_intrinsics(path / f"P_rect_{number}", (width, height), (fx, fy), (cx, cy))
    rect_from_cam = entry(table, f"R_rect_{number}", (3, 3), path)
    lens = Lens("pinhole", width, height, fx, fy, cx + 0.5, cy + 0.5)
    return lens, rigid("camera", "cam", rect_from_cam, np.zeros(3), path).inverse(), notes


def _fisheye(path: Path) -> Lens:
    table = read_table(path)
    keys = (
        "image_width", "image_height", "gamma1", "gamma2", "u0", "v0", "xi", "k1", "k2", "p1", "p2",
    )  # fmt: skip
    width, height, *rest = (float(entry(table, key, (1,), path)[0]) for key in keys)
    gamma1, gamma2, u0, v0, xi, *distortion = rest
    size = check_pixels(np.array([width, height]), path)
    focal = min(gamma1, gamma2) / (1.0 + max(xi, 0.0))
    is_lens = 0.0 <= xi <= _MAX_COEFFICIENT and max(map(abs, distortion)) <= _MAX_COEFFICIENT
    is_lens &= focal > 0 and _FISHEYE_RAD[0] <= width / focal <= _FISHEYE_RAD[1]
    is_lens &= max(gamma1, gamma2) < 2 * min(gamma1, gamma2) and 0 < u0 < width and 0 < v0 < height
    if not is_lens:
        raise InputError(
            "the intrinsics are not those of a fisheye lens",
            where=path,
            got=", ".join(f"{key} {value:g}" for key, value in zip(keys[2:], rest, strict=True)),
            expected=f"xi of 0 to {_MAX_COEFFICIENT:g}, and a view of {_FISHEYE_RAD[0]:g} to"
            f" {_FISHEYE_RAD[1]:g} rad along {size[0]} px",
        )
    return Lens("mei", *size, gamma1, gamma2, u0 + 0.5, v0 + 0.5, (xi, *distortion))


def _frame_times_ns(root: Path, drive: str) -> Mapping[int, int]:
    """Return the times of frames, which are those of the poses.

    The devkit takes the pose of a frame for the time at which the scanner faces forward and
    triggers the cameras (accumuLaser, CurlParametersFromPoses).
    """
    folders = [root / "data_2d_raw" / drive / name for name in (*_PINHOLES, *_FISHEYES)]
    folders.append(root / "data_3d_raw" / drive / "velodyne_points")
    for folder in folders:
        if has_folder(folder) and has_file(folder / "timestamps.txt"):
            return read_times_ns(folder / "timestamps.txt")
    raise InputError(
        "the drive has no time stamps",
        where=folders[0] / "timestamps.txt",
        got="no such file",
        remedy="Copy it from the original data set.",
    )


def _read_ego(
    path: Path, times_ns: Mapping[int, int]
) -> tuple[Trajectory, Mapping[int, int], list[str]]:
    """Return `world_from_ego`, the times of frames with a pose, and notes.

    The file has poses of frames in which the vehicle moves (kitti360Scripts, issues 96, 102).
    """
    rows = read_rows(path, 13)
    by_time = {
        times_ns[int(row[0])]: (int(row[0]), row[1:]) for row in rows if int(row[0]) in times_ns
    }
    if not by_time:
        raise InputError(
            "no pose has a time stamp",
            where=path,
            got=f"{len(rows)} poses",
            expected="numbers of frames in the first column, as in timestamps.txt",
        )
    ordered = sorted(by_time.items())
    poses = np.tile(np.eye(4), (len(ordered), 1, 1))
    poses[:, :3] = np.stack([row.reshape(3, 4) for _, (_, row) in ordered])
    poses[:, :3, :3] = nearest_rotations(poses[:, :3, :3].copy(), path)
    times = np.array([time for time, _ in ordered], dtype=np.int64)
    ego = Trajectory("world", "ego", times, poses @ _ego_from_imu().inverse().matrix)
    notes = [f"{len(rows) - len(ordered)} poses without a time stamp of their own are not used"]
    missing = len(times_ns) - len(ordered)
    return (
        ego,
        {number: time for time, (number, _) in ordered},
        notes * (len(rows) > len(ordered))
        + [f"no pose for {missing} of {len(times_ns)} frames, as while the vehicle stands"]
        * (missing > 0),
    )


def _place(ego: Trajectory) -> Place:
    """Return the place of the first pose, by the inverse of the world frame's projection."""
    latitude_deg, longitude_deg = _ORIGIN_DEG
    radius_m = _EARTH_M * np.cos(np.radians(latitude_deg))
    x, y = (ego.positions_m[0, :2] / radius_m).tolist()
    origin = np.log(np.tan(np.radians(90.0 + latitude_deg) / 2))
    latitude = 2 * np.degrees(np.arctan(np.exp(np.clip(origin + y, -5, 5)))) - 90.0
    longitude = (longitude_deg + np.degrees(x) + 180.0) % 360.0 - 180.0
    return Place(float(latitude), float(longitude), "gps")


def _labels_path(root: Path, drive: str) -> Path | None:
    folders = (root / "data_3d_bboxes" / part for part in ("train", "train_full"))
    return next(filter(is_file, (folder / f"{drive}.xml" for folder in folders)), None)


def _scenes(root: Path) -> list[str]:
    return [path.name for path in subfolders(root / "data_poses")]


def _detect(source: Path) -> bool:
    return is_file(source / "calibration" / "perspective.txt") and is_folder(source / "data_poses")


def _other_place(source: Path) -> tuple[str, Path] | None:
    inside = next((path for path in source.resolve().parents[:3] if _detect(path)), None)
    return None if inside is None else ("a part of KITTI-360; add --scene DRIVE", inside)


def _files(reading: LogReading) -> Iterator[Path]:
    root = Path(reading.source)
    drive = chosen_scene(_scenes(root), reading)
    folders = [root / part / drive for part in ("data_2d_raw", "data_3d_raw", "data_poses")]
    for folder in (root / "calibration", *folders):
        yield from (path for path in folder.rglob("*") if path.is_file())
    labels = _labels_path(root, drive)
    if labels is not None:
        yield labels


READER = LogReader(_detect, read_kitti360, _other_place, _files)
