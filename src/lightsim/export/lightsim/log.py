"""Writer of lightsim-log/1 folders (docs/reference/lightsim-log.md): any log that can be read.

The folder is the log as LightSim has it: pinhole pictures, each with its own pose and time, and
LiDAR returns in frame `world`, each with its sensor's position and time. `datasets.lightsim` reads
it back without loss.
"""

from __future__ import annotations

import csv
import os
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import CameraFrame, LidarSweep
from lightsim.datasets.csv_table import pose_cells
from lightsim.datasets.lightsim.header import FORMAT, LOG_NAME, clock_word
from lightsim.datasets.lightsim.log import IMAGES, MASKS, SWEEPS
from lightsim.datasets.lightsim.tables import (
    BOXES,
    BOXES_NAME,
    EGO_NAME,
    PICTURES_NAME,
    POSES,
    VELOCITIES,
)
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.store.arrays import save_arrays
from lightsim.store.artefact import write_json
from lightsim.store.atomic import unwritable, whole_file
from lightsim.store.images import write_png

_LIDAR = "lidar"


def write_lightsim_log(log: DrivingLog, out: Path, progress: Progress) -> None:
    """Write a log as a lightsim-log/1 folder, which appears whole or not at all.

    Pictures are written as PNG, and sweeps as .npz without compression.

    Raises:
        InputError: the folder exists and is not empty, or a picture or sweep cannot be read.
        ArtefactError: the folder cannot be written.
    """
    # Links are resolved: the folder itself is made, never a link replaced.
    out = Path(os.path.realpath(out))
    _check_free(out)
    partial = out.with_name(f".{out.name}.partial")
    try:
        # Left by an interrupted run.
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        fill_folder(log, partial, progress)
        os.replace(partial, out)
    except OSError as error:
        raise unwritable(out, error) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _check_free(out: Path) -> None:
    is_free = not out.exists() or (out.is_dir() and not any(out.iterdir()))
    if not is_free:
        raise InputError(
            "the folder for the log contains other files",
            where=out,
            expected="no folder, or an empty one",
            remedy="Choose another --out.",
        )


def fill_folder(log: DrivingLog, folder: Path, progress: Progress) -> None:
    """Write all files of a log; files of an interrupted export of the same log are replaced."""
    frames = _by_camera(log)
    origins = _write_sweeps(log, folder, progress)
    write_json(folder / LOG_NAME, _header(log, frames, origins))
    _write_csv(
        folder / EGO_NAME,
        POSES,
        ((time_ns, *pose_cells(log.ego.at(time_ns))) for time_ns in log.ego.times_ns.tolist()),
    )
    _write_csv(
        folder / PICTURES_NAME,
        ("camera", *POSES, *VELOCITIES),
        (_picture_row(frame) for frame in log.frames),
    )
    if log.actors:
        _write_csv(folder / BOXES_NAME, (*BOXES, "kind", "is_moving"), _box_rows(log))
    for name, mask in log.ego_vehicle_masks.items():
        (folder / MASKS).mkdir(exist_ok=True)
        write_png(folder / MASKS / f"{name}.png", mask.astype(np.uint8) * 255)
    for name in frames:
        (folder / IMAGES / name).mkdir(parents=True, exist_ok=True)
    for frame in progress.track(log.frames, "write pictures", len(log.frames)):
        write_png(folder / picture_name(frame), frame.load_srgb8())


def picture_name(frame: CameraFrame) -> str:
    """Return the file of a picture, relative to the log's folder."""
    return f"{IMAGES}/{frame.camera_name}/{frame.time_ns}.png"


def _by_camera(log: DrivingLog) -> dict[str, tuple[CameraFrame, ...]]:
    """Return the frames of every camera; each needs a time of its own, which names its file.

    Raises:
        InputError: two pictures of one camera have one time, or a time is negative.
    """
    frames = {name: log.frames_of(name) for name in log.cameras}
    for name, own in frames.items():
        times = {frame.time_ns for frame in own}
        if len(times) < len(own) or min(times, default=0) < 0:
            raise InputError(
                "the pictures of a camera cannot be named by their times",
                where=f"{log.name}, {name}",
                got="negative times" if len(times) == len(own) else "two pictures of one time",
                expected="one picture at each time, in nanoseconds from 0",
            )
    return frames


def _header(
    log: DrivingLog,
    frames: dict[str, tuple[CameraFrame, ...]],
    lidar_ego_m: Sequence[float] | None,
) -> dict[str, Any]:
    mounting = np.eye(4)
    mounting[:3, 3] = lidar_ego_m or (0.0, 0.0, 0.0)
    lidar = {
        "ego_from_lidar": mounting,
        "points": "world",
        "time": "middle",
        "intensity_max": 1.0,
    }
    return {
        "format": FORMAT,
        "name": log.name,
        "licence": log.licence,
        **_located(log),
        "origin_m": list(log.origin_m),
        "point_classes": {str(number): name for number, name in log.semantic_names.items()},
        "cameras": {n: _camera(log, log.cameras[n], own) for n, own in frames.items()},
        "lidars": {} if lidar_ego_m is None else {_LIDAR: lidar},
        "notes": [note[:1000] for note in log.notes],
    }


def _located(log: DrivingLog) -> dict[str, Any]:
    geo = log.geo
    if geo is None:
        return {"clock": "unknown", "place": None, "world_x_azimuth_deg": None}
    found: dict[str, Any] = {
        "clock": clock_word(geo.clock),
        "place": None,
        "world_x_azimuth_deg": geo.heading_deg,
        "world_x_azimuth_std_deg": geo.heading_residual_deg,
        "world_x_azimuth_source": geo.heading_origin,
        "gps_residual_m": geo.heading_residual_m,
    }
    if geo.clock is not None:
        found |= {"clock_source": geo.clock.origin, "clock_std_s": geo.clock.std_s}
    if geo.place is not None:
        place = geo.place
        found |= {
            "place": [place.latitude_deg, place.longitude_deg],
            "place_source": place.origin,
            "place_std_deg": place.std_deg,
        }
    if geo.given_sun is not None:
        found["sun_deg"] = [geo.given_sun.azimuth_deg, geo.given_sun.elevation_deg]
    return found


def _camera(
    log: DrivingLog, camera: PinholeCamera, frames: Sequence[CameraFrame]
) -> dict[str, Any]:
    shutter = next((frame.shutter for frame in frames if frame.shutter is not None), None)
    down_s = 0.0 if shutter is None else shutter.readout_s
    across_s = 0.0 if shutter is None else shutter.readout_across_s
    is_by_rows = abs(down_s) >= abs(across_s)
    main_s, other_s = (down_s, across_s) if is_by_rows else (across_s, down_s)
    ways = ("top_to_bottom", "bottom_to_top") if is_by_rows else ("left_to_right", "right_to_left")
    return {
        "model": "pinhole",
        "size_px": [camera.width_px, camera.height_px],
        **{key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy")},
        "distortion": [],
        "first_pixel_centre": 0.5,
        "ego_from_camera": _mounting(log, frames).matrix,
        "readout_s": abs(main_s),
        "readout": ways[0 if main_s >= 0 else 1],
        "readout_other_axis_s": other_s,
        "time": "middle",
    }


def _mounting(log: DrivingLog, frames: Sequence[CameraFrame]) -> RigidTransform:
    """Return the mean `ego_from_camera` of the pictures, each of which has a pose of its own."""
    poses = [log.ego.held(f.time_ns).inverse() @ f.world_from_camera for f in frames]
    return RigidTransform.from_rotation(
        "ego",
        "camera",
        Rotation.from_matrix([pose.rotation for pose in poses]).mean().as_matrix(),
        np.median([pose.translation_m for pose in poses], axis=0),
    )


def _write_sweeps(log: DrivingLog, folder: Path, progress: Progress) -> tuple[float, ...] | None:
    """Write the sweeps and return the LiDAR's position in frame `ego`; None without sweeps."""
    if not log.sweeps:
        return None
    target = folder / SWEEPS / _LIDAR
    target.mkdir(parents=True, exist_ok=True)
    places: list[np.ndarray] = []
    for lazy in progress.track(log.sweeps, "write sweeps", len(log.sweeps)):
        sweep = lazy.load()
        save_arrays(target / f"{lazy.time_ns}.npz", _columns(sweep))
        middle = np.median(sweep.origins_world.astype(np.float64), axis=0)
        places.append(log.ego.held(lazy.time_ns).inverse().apply(middle))
    return tuple(np.median(places, axis=0).tolist())


def _columns(sweep: LidarSweep) -> dict[str, np.ndarray]:
    columns = {
        "xyz": sweep.points_world,
        "origin": sweep.origins_world,
        "intensity": sweep.intensity,
        "time_offset_s": sweep.time_offset_s,
        "ring": sweep.ring,
        "class": sweep.semantic_class,
    }
    # Ids that are all unknown are left out.
    return {name: c for name, c in columns.items() if c.dtype.kind == "f" or (c >= 0).any()}


def _picture_row(frame: CameraFrame) -> tuple[object, ...]:
    motion = (0.0,) * 6
    if frame.shutter is not None:
        shutter = frame.shutter
        motion = (*shutter.velocity_m_s.tolist(), *shutter.angular_velocity_rad_s.tolist())
    return (frame.camera_name, frame.time_ns, *pose_cells(frame.world_from_camera), *motion)


def _box_rows(log: DrivingLog) -> Iterable[tuple[object, ...]]:
    for actor in log.actors:
        for time_ns, matrix in zip(
            actor.trajectory.times_ns.tolist(), actor.trajectory.matrices, strict=True
        ):
            pose = pose_cells(RigidTransform("world", "actor", matrix))
            size = actor.size_lwh_m.tolist()
            moves = int(actor.is_moving)
            yield (time_ns, actor.actor_id, actor.label, *pose, *size, str(actor.kind), moves)


def _write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)
