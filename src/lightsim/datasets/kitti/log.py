"""Reader of KITTI raw data (Geiger et al. 2013, doi:10.1177/0278364913491297), rectified drives.

Layout: <date>/{calib_cam_to_cam, calib_velo_to_cam, calib_imu_to_velo}.txt and
<date>/<drive>_sync/{image_0x, oxts, velodyne_points}/{data/<frame>.*, timestamps.txt},
tracklet_labels.xml. SOURCE is a drive, its date, or the folder of all dates.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from lightsim.core.frames import RigidTransform
from lightsim.core.log import Clock, DrivingLog, FindEgoVehicle
from lightsim.core.reading import LogReading
from lightsim.datasets.assemble import assemble
from lightsim.datasets.geo import Located
from lightsim.datasets.kitti.oxts import ego_from_imu, read_oxts
from lightsim.datasets.kitti.pictures import check_pixels, read_camera
from lightsim.datasets.kitti.text import Table, entry, read_table, read_times_ns, rigid
from lightsim.datasets.kitti.tracklets import read_tracklets
from lightsim.datasets.kitti.velodyne import read_revolutions, read_sweeps
from lightsim.datasets.layout import has_file, has_folder
from lightsim.datasets.lenses import Lens
from lightsim.datasets.plausible import check_intrinsics, check_mounting
from lightsim.datasets.reader import LogReader
from lightsim.datasets.recorded import RecordedCamera, RecordedLog
from lightsim.datasets.scenes import chosen_scene
from lightsim.errors import InputError
from lightsim.store.reading import is_file, is_folder

_COLOUR, _GREY = ("image_02", "image_03"), ("image_00", "image_01")
_CALIBRATION = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
_DATE = re.compile(r"\d{4}_\d\d_\d\d", re.ASCII)
_UNRECTIFIED = "_extract"
LICENCE = "CC BY-NC-SA 3.0"
CEST_NS = 7_200_000_000_000
"""Central European Summer Time is 2 hours ahead of UTC."""
# All drives are of September and October 2011; a shadow of drive 0023 confirms the zone. The error
# of the recording computer's clock is unknown: 60 s are an assumption.
_CLOCK = Clock(-CEST_NS, "local time (CEST)", 60.0)
# Error of the unit's heading, in degrees (OXTS RT3003 data sheet: 0.1 degrees).
_NORTH_STD_DEG = 0.1


def read_kitti(reading: LogReading, find_ego_vehicle: FindEgoVehicle) -> DrivingLog:
    """Read a drive; the grey cameras only if --cameras names them.

    Raises:
        InputError: something is missing or broken; the message names the file.
    """
    drive = _drive(reading)
    cam_path, velo_path, imu_path = (drive.resolve().parent / name for name in _CALIBRATION)
    cameras_table = read_table(cam_path)
    ego_from_velo = ego_from_imu() @ _rigid("velo", "imu", imu_path).inverse()
    check_mounting(imu_path, ego_from_velo.translation_m)
    ego_from_cam0 = ego_from_velo @ _rigid("cam0", "velo", velo_path).inverse()
    cameras: list[RecordedCamera] = []
    notes: list[str] = []
    for name in _camera_names(drive, reading):
        lens, cam0_from_camera, lens_notes = _rectified(cameras_table, name[-2:], cam_path)
        camera, camera_notes = read_camera(
            drive / name, "data", lens, ego_from_cam0 @ cam0_from_camera
        )
        cameras.append(camera)
        notes += [*lens_notes, *camera_notes]
    ego, place, ego_notes = read_oxts(drive / "oxts")
    times_ns, time_notes = _sweep_times_ns(drive, cameras)
    revolutions = read_revolutions(drive / "velodyne_points", times_ns)
    sweeps, sweep_notes = read_sweeps(
        drive / "velodyne_points", times_ns, revolutions, ego_from_velo
    )
    labels = drive / "tracklet_labels.xml"
    actors, actor_notes = (
        read_tracklets(labels, times_ns, revolutions, ego, ego_from_velo)
        if has_file(labels)
        else ((), [])
    )
    recorded = RecordedLog(
        drive.resolve().name,
        tuple(cameras),
        ego,
        {"velodyne": sweeps},
        actors,
        Located(None, place, _CLOCK, 90.0, _NORTH_STD_DEG),
        notes=(*notes, *ego_notes, *time_notes, *sweep_notes, *actor_notes),
        licence=LICENCE,
    )
    return assemble(recorded, reading, find_ego_vehicle)


def _rectified(
    table: Table, number: str, path: Path
) -> tuple[Lens, RigidTransform, tuple[str, ...]]:
    """Return the lens of a rectified camera, `cam0_from_camera`, and notes.

    Pictures of all cameras are turned to the axes of rectified camera 0, by R_rect_00; the last
    column of P_rect is the camera's position there, times the intrinsic matrix.
    """
    width, height = check_pixels(entry(table, f"S_rect_{number}", (2,), path), path)
    p = entry(table, f"P_rect_{number}", (3, 4), path)
    fx, fy, cx, cy = (float(p[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    notes = check_intrinsics(path / f"P_rect_{number}", (width, height), (fx, fy), (cx, cy))
    away = p[2, 3]
    camera_from_rect = np.array([(p[0, 3] - cx * away) / fx, (p[1, 3] - cy * away) / fy, away])
    rect_from_cam0 = entry(table, "R_rect_00", (3, 3), path)
    # The centre of the first pixel is (0, 0) in KITTI, as in OpenCV.
    lens = Lens("pinhole", width, height, fx, fy, cx + 0.5, cy + 0.5)
    camera_from_cam0 = rigid("camera", "cam0", rect_from_cam0, camera_from_rect, path)
    return lens, camera_from_cam0.inverse(), notes


def _rigid(dst: str, src: str, path: Path) -> RigidTransform:
    table = read_table(path)
    rotation, translation_m = entry(table, "R", (3, 3), path), entry(table, "T", (3,), path)
    return rigid(dst, src, rotation, translation_m, path)


def _sweep_times_ns(
    drive: Path, cameras: list[RecordedCamera]
) -> tuple[Mapping[int, int], list[str]]:
    """Return the times at which the scanner faces forward, by frame, and notes."""
    path = drive / "velodyne_points" / "timestamps.txt"
    if has_file(path):
        return read_times_ns(path), []
    for camera in cameras:
        times = drive / camera.name / "timestamps.txt"
        if has_folder(times.parent) and has_file(times):
            words = f"sweeps and boxes have no times of their own: those of {camera.name} are used"
            return read_times_ns(times), [words]
    return {}, []


def _camera_names(drive: Path, reading: LogReading) -> list[str]:
    wanted = [name for name in _GREY if name in reading.cameras]
    colour = [name for name in _COLOUR if is_folder(drive / name)]
    return [*colour, *wanted] or [name for name in _GREY if is_folder(drive / name)]


def _is_drive(folder: Path) -> bool:
    # Without its poses a drive is known by the calibration beside it.
    is_kitti = is_folder(folder / "oxts") or is_file(folder.absolute().parent / _CALIBRATION[0])
    return is_kitti and any(is_folder(folder / name) for name in (*_COLOUR, *_GREY))


def _drives(folder: Path) -> dict[str, Path]:
    """Return the rectified drives of a date or of all dates."""
    dates = [path for path in _entries(folder) if _DATE.fullmatch(path.name)]
    return {
        path.name: path
        for date in ([folder] if is_file(folder / _CALIBRATION[0]) else dates)
        for path in _entries(date)
        if not path.name.endswith(_UNRECTIFIED) and _is_drive(path)
    }


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def _drive(reading: LogReading) -> Path:
    source = Path(reading.source)
    if _is_drive(source):
        if reading.scene:
            chosen_scene((source.resolve().name,), reading)
        if source.resolve().name.endswith(_UNRECTIFIED):
            raise InputError(
                "the drive is not rectified",
                where=source,
                expected="a drive with the ending _sync",
                remedy="Download 'synced+rectified data' of the drive.",
            )
        return source
    drives = _drives(source)
    return drives[chosen_scene(drives, reading)]


def _detect(source: Path) -> bool:
    return _is_drive(source) or bool(_drives(source))


def _other_place(source: Path) -> tuple[str, Path] | None:
    inside = next((path for path in source.resolve().parents[:2] if _is_drive(path)), None)
    return None if inside is None else ("a part of a KITTI drive", inside)


def _files(reading: LogReading) -> Iterator[Path]:
    """Yield the files of the drive, and the calibration beside it."""
    drive = _drive(reading)
    yield from (path for path in drive.rglob("*") if path.is_file())
    yield from filter(is_file, (drive.resolve().parent / name for name in _CALIBRATION))


READER = LogReader(_detect, read_kitti, _other_place, _files)
