"""Reader of nuScenes tables (Caesar et al. 2020, doi:10.1109/CVPR42600.2020.01164).

TIER IV's T4 format and Lyft Level 5 have the same tables, in folders of other names.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from lightsim.core.frames import Trajectory
from lightsim.core.log import DrivingLog, FindEgoVehicle, Place
from lightsim.core.reading import LogReading
from lightsim.datasets.assemble import assemble
from lightsim.datasets.geo import Located, gps_track, place_at
from lightsim.datasets.lenses import Lens
from lightsim.datasets.nuscenes.boxes import read_tracks
from lightsim.datasets.nuscenes.sweeps import (
    MERGED,
    VEHICLE_M,
    LidarMount,
    has_turn,
    load_sweep,
)
from lightsim.datasets.nuscenes.table_rows import Row
from lightsim.datasets.nuscenes.tables import (
    SceneTables,
    cut_out,
    other_place,
    table_folders,
)
from lightsim.datasets.pictures import image_size, load_image, stored_picture
from lightsim.datasets.plausible import LIMITS, check_intrinsics, check_mounting
from lightsim.datasets.reader import LogReader
from lightsim.datasets.recorded import (
    RecordedCamera,
    RecordedLog,
    RecordedPicture,
    RecordedSweep,
)
from lightsim.errors import InputError
from lightsim.store.names import is_harmless
from lightsim.store.reading import is_file

# Latitude and longitude of the origins of nuScenes' maps, whose x is east and y is north
# (nuscenes-devkit, scripts/export_poses.py).
_MAP_ORIGINS_DEG = {
    "boston-seaport": (42.336849169438615, -71.05785369873047),
    "singapore-onenorth": (1.2882100868743724, 103.78475189208984),
    "singapore-hollandvillage": (1.2993652317780957, 103.78217697143555),
    "singapore-queenstown": (1.2782562240223188, 103.76741409301758),
}
# One standard deviation of a place: the map of Boston is off by up to 50 m (nuscenes-devkit#960).
_PLACE_STD_DEG = 0.0005
# Difference between two poses of one time that deserves a note, in metres.
_SAME_POSE_M = 0.1
# Largest height of a path that is planar, in metres; nuScenes has rounding only.
_PLANAR_M = 0.001
# Largest picture or sweep, in bytes: a picture of 80 megapixels has 240 MB without compression.
_MAX_FILE_BYTES = 512 << 20
_LICENCE = "CC BY-NC-SA 4.0 (nuScenes, Motional; non-commercial)"


@dataclass(frozen=True, eq=False)
class _Channel:
    """Rows of sample_data of one sensor in time order, with their files, and notes."""

    name: str
    modality: str
    calibration: Row
    files: tuple[tuple[int, Path], ...]
    notes: tuple[str, ...]


def read_nuscenes(reading: LogReading, find_ego_vehicle: FindEgoVehicle) -> DrivingLog:
    """Read a scene; pictures and sweeps are loaded on demand.

    Args:
        reading: options; the source is the data set's folder, or a folder of tables in it.
        find_ego_vehicle: finds the ego vehicle in the pictures of all cameras.

    Raises:
        InputError: something is missing or broken; the message names the file.
    """
    _, tables = cut_out(reading)
    channels = _channels(tables)
    ego, has_heights, ego_notes = _ego_path(tables)
    cameras = [_camera(c) for c in channels if c.modality == "camera" and c.files]
    roof = [camera.ego_from_camera.translation_m for camera, _ in cameras]
    lidars = {
        c.name: (_mount(c, roof), c.files) for c in channels if c.modality == "lidar" and c.files
    }
    mounts = [mount for mount, _ in lidars.values()]
    actors, actor_notes = read_tracks(tables, ego, _of_labels(mounts))
    recorded = RecordedLog(
        _name(tables),
        tuple(camera for camera, _ in cameras),
        ego,
        {name: _sweeps(mount, files) for name, (mount, files) in lidars.items()},
        actors,
        _located(tables),
        notes=(
            *ego_notes,
            *(note for channel in channels for note in channel.notes),
            *(note for _, notes in cameras for note in notes),
            *(note for mount in mounts for note in _lidar_notes(mount)),
            *actor_notes,
        ),
        licence=_LICENCE if tables.folder.name.startswith("v1.") else "",
        has_heights=has_heights,
    )
    return assemble(recorded, reading, find_ego_vehicle)


def _files(reading: LogReading) -> Iterator[Path]:
    """Yield the pictures and sweeps of the chosen scene."""
    for channel in _channels(cut_out(reading)[1]):
        if channel.modality in ("camera", "lidar"):
            yield from (path for _, path in channel.files)


def _derived(reading: LogReading) -> dict[str, Path]:
    """Return the file with the scene's rows of the tables: those of all scenes are slow to hash."""
    path, rows = cut_out(reading)
    return {f"tables of {rows.scene.text('token')}": path}


READER = LogReader(
    lambda source: bool(table_folders(source)), read_nuscenes, other_place, _files, _derived
)


def _name(tables: SceneTables) -> str:
    """Return the name of the scene, or of the folder for a name that is no file name."""
    name = tables.scene.text("name")
    return name if is_harmless(name) else tables.root.resolve().name


def _channels(tables: SceneTables) -> list[_Channel]:
    """Return the sensors by name; files that do not exist are noted."""
    rows_by_calibration: dict[str, list[Row]] = {}
    for row in tables.rows("sample_data"):
        rows_by_calibration.setdefault(row.text("calibrated_sensor_token"), []).append(row)
    channels: dict[str, _Channel] = {}
    for token, rows in rows_by_calibration.items():
        calibration = tables.find("calibrated_sensor", token, rows[0].where)
        sensor_token = calibration.text("sensor_token")
        sensor = tables.find("sensor", sensor_token, calibration.where)
        name, modality = sensor.text("channel"), sensor.text("modality")
        if name in channels:
            raise InputError(
                "a sensor has two calibrations in one scene",
                where=calibration.where,
                got=name,
                expected="one row of calibrated_sensor for each sensor of a scene",
            )
        channels[name] = _channel(name, modality, calibration, rows, tables.root)
    return [channels[name] for name in sorted(channels)]


def _channel(name: str, modality: str, calibration: Row, rows: list[Row], root: Path) -> _Channel:
    by_time: dict[int, Row] = {}
    for row in rows:
        by_time.setdefault(row.time_ns(), row)
    valid = {t: row for t, row in sorted(by_time.items()) if row.values.get("is_valid", True)}
    paths = [(time_ns, row.path(root)) for time_ns, row in valid.items()]
    if modality == "camera":
        paths = [(time_ns, stored_picture(path)) for time_ns, path in paths]
    files = tuple((time_ns, path) for time_ns, path in paths if _exists(path))
    counts = {
        "repeat a time stamp": len(rows) - len(by_time),
        "are marked as invalid": len(by_time) - len(valid),
        "have no file": len(paths) - len(files),
    }
    notes = tuple(
        f"{name}: {count} of {len(rows)} rows of sample_data {what} and are not used"
        for what, count in counts.items()
        if count and modality in ("camera", "lidar")
    )
    return _Channel(name, modality, calibration, files, notes)


def _exists(path: Path) -> bool:
    """Return whether a file exists; one that is too large to be hashed is an error."""
    if not is_file(path):
        return False
    size = path.stat().st_size
    if size > _MAX_FILE_BYTES:
        raise InputError(
            "the file is too large for a picture or a sweep",
            where=path,
            got=f"{size} bytes",
            expected=f"at most {_MAX_FILE_BYTES} bytes",
        )
    return True


def _ego_path(tables: SceneTables) -> tuple[Trajectory, bool, tuple[str, ...]]:
    """Return `world_from_ego` of the poses of all sensors, whether it has heights, and notes."""
    rows = tables.rows("ego_pose")
    if not rows:
        raise InputError(
            "the scene has no ego poses",
            where=tables.table("ego_pose"),
            expected="one for each row of sample_data",
        )
    times_ns = np.array([row.time_ns() for row in rows], dtype=np.int64)
    matrices = np.stack([row.pose("world", "ego").matrix for row in rows])
    # Sensors that fire at one time have a pose each, of the same place.
    times_ns, first, at = np.unique(times_ns, return_index=True, return_inverse=True)
    apart_m = np.abs(matrices[:, :3, 3] - matrices[first][at, :3, 3]).max(axis=1)
    notes: list[str] = []
    if (apart_m > _SAME_POSE_M).any():
        notes.append(
            f"{int((apart_m > _SAME_POSE_M).sum())} ego poses differ from another one of the same"
            f" time, by up to {apart_m.max():.1f} m, and are not used"
        )
    # Localisation of nuScenes is planar (nuscenes-devkit#721); rotations have pitch and roll.
    has_heights = len(times_ns) < 2 or bool(np.abs(matrices[:, 2, 3]).max() >= _PLANAR_M)
    if not has_heights:
        notes.append("positions are planar: z is 0 everywhere, so that slopes are not recorded")
    return Trajectory("world", "ego", times_ns, matrices[first]), has_heights, tuple(notes)


def _camera(channel: _Channel) -> tuple[RecordedCamera, tuple[str, ...]]:
    """Return a camera and notes. Cameras of nuScenes (Basler acA1600-60gc) have global shutters."""
    row = channel.calibration
    where = row.table / channel.name / "camera_intrinsic"
    size = image_size(channel.files[0][1])
    k = row.matrix("camera_intrinsic")
    if abs(k[0, 1]) > 1e-6 or not np.allclose(k[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        raise InputError(
            "the camera matrix is not valid",
            where=where,
            got=k.tolist(),
            expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
        )
    fx, fy, cx, cy = k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    notes = check_intrinsics(where, size, (fx, fy), (cx, cy))
    # The T4 format only: k1, k2, p1, p2, k3.
    distortion = row.values.get("camera_distortion") or []
    bent = tuple(row.numbers("camera_distortion", len(distortion)).tolist()) if distortion else ()
    model = "brown" if any(bent) else "pinhole"
    try:
        # OpenCV's convention: the origin is the centre of the first pixel, its corner in LightSim.
        lens = Lens(model, *size, fx, fy, cx + 0.5, cy + 0.5, bent if any(bent) else ())
    except InputError as error:
        raise error.at(where) from error
    pictures = tuple(
        RecordedPicture(time_ns, path, partial(load_image, path, *size))
        for time_ns, path in channel.files
    )
    return RecordedCamera(channel.name, lens, row.pose("ego", "camera"), pictures), notes


def _mount(channel: _Channel, roof_m: list[Float64[np.ndarray, "3"]]) -> LidarMount:
    """Return a LiDAR; a merged cloud starts at the mean of `roof_m`, the cameras' positions."""
    row = channel.calibration
    pose = row.pose("ego", "lidar")
    check_mounting(row.where, pose.translation_m)
    is_merged = channel.name == MERGED and bool(roof_m)
    origin = np.mean(roof_m, axis=0) if is_merged else pose.translation_m
    return LidarMount(channel.name, pose, origin, has_turn(channel.files[0][1]))


def _sweeps(mount: LidarMount, files: tuple[tuple[int, Path], ...]) -> tuple[RecordedSweep, ...]:
    return tuple(
        RecordedSweep(time_ns, path, partial(load_sweep, path, mount)) for time_ns, path in files
    )


def _of_labels(mounts: list[LidarMount]) -> LidarMount | None:
    """Return the LiDAR whose sweeps are labelled: that with a known turn."""
    return next((mount for mount in mounts if mount.has_turn), None)


def _lidar_notes(mount: LidarMount) -> tuple[str, ...]:
    if mount.channel == MERGED:
        note = (
            f"{MERGED} is merged from several LiDARs: their positions are not recorded, and beams"
            " are assumed to start at the mean position of the cameras"
        )
    else:
        note = (
            f"{mount.channel}: returns within {VEHICLE_M:g} m, of the vehicle itself, are not used"
        )
    if mount.has_turn:
        return (note,)
    return note, f"{mount.channel}: points have no times of their own; that of the sweep is used"


def _located(tables: SceneTables) -> Located:
    """Return place, time and north: time stamps are true UTC."""
    rows = tables.rows("log")
    poses = tables.rows("ego_pose")
    location = str(rows[0].values.get("location")) if rows else ""
    origin = _MAP_ORIGINS_DEG.get(location)
    if origin is not None:
        east_m, north_m, _ = poses[0].numbers("translation", 3).tolist()
        farthest_m = max(abs(east_m), abs(north_m))
        got = f"position {east_m:.6g}, {north_m:.6g} m"
        LIMITS["coordinate"].check(poses[0].where, farthest_m, got)
        latitude, longitude = place_at(*origin, east_m, north_m)
        place = Place(latitude, longitude, f"origin of the map {location}", _PLACE_STD_DEG)
        return Located(place=place, world_x_azimuth_deg=90.0)
    # The T4 format has latitude, longitude and altitude if an INS recorded them.
    fixes = [(row.time_ns(), row.numbers("geocoordinate", 3)) for row in poses
             if row.values.get("geocoordinate")]  # fmt: skip
    if not fixes:
        return Located()
    by_time = dict(sorted(fixes, key=lambda fix: fix[0]))
    track = np.stack(list(by_time.values()))
    times_ns = np.array(list(by_time), dtype=np.int64)
    table = tables.table("ego_pose")
    fixes_at = [f"{table}, at {time_ns} ns" for time_ns in by_time]
    return Located(track=gps_track(times_ns, track[:, 0], track[:, 1], fixes_at.__getitem__))
