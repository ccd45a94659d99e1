"""Reader of the folder `lightsim-log/1`, the contract for everybody's log
(docs/reference/lightsim-log.md).

Layout: log.json, ego.csv, images/<camera>/<time_ns>.jpg|png, sweeps/<lidar>/<time_ns>.npz|ply|pcd|
bin or points.ply; optional: boxes.csv, gps.csv, camera_poses.csv, masks/<camera>.png.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from lightsim.core.frames import Trajectory
from lightsim.core.log import DrivingLog, FindEgoVehicle
from lightsim.core.reading import LogReading
from lightsim.datasets.assemble import assemble
from lightsim.datasets.layout import has_file, has_folder, subfolders, visible_entries
from lightsim.datasets.lightsim.header import (
    LOG_NAME,
    CameraEntry,
    Header,
    check_clock,
    read_header,
)
from lightsim.datasets.lightsim.stamped import stamped_files
from lightsim.datasets.lightsim.sweeps import read_sweeps
from lightsim.datasets.lightsim.tables import (
    BOXES_NAME,
    EGO_NAME,
    GPS_NAME,
    PICTURES_NAME,
    PicturePose,
    read_boxes,
    read_ego,
    read_gps,
    read_picture_poses,
)
from lightsim.datasets.pictures import check_size, load_image
from lightsim.datasets.plausible import LIMITS
from lightsim.datasets.points_cloud import POINTS_NAME, points_note, points_sweep
from lightsim.datasets.reader import LogReader
from lightsim.datasets.recorded import (
    RecordedCamera,
    RecordedLog,
    RecordedPicture,
    RecordedSweep,
)
from lightsim.errors import InputError
from lightsim.store.images import read_grey8, read_size
from lightsim.store.reading import is_file, is_folder

IMAGES, SWEEPS, MASKS = "images", "sweeps", "masks"
_SUFFIXES = (".png", ".jpg", ".jpeg")
# Largest fraction of a picture that shows the ego vehicle: masks of other tools are white where
# pixels are valid.
_MOST_MASKED = 0.75
# Largest number of folders in which a recording is looked for.
_MOST = 1000


def _is_log(folder: Path) -> bool:
    # A work folder's artefact `log` has a log.json, too, but neither pictures nor an ego path.
    return is_file(folder / LOG_NAME) and (is_file(folder / EGO_NAME) or is_folder(folder / IMAGES))


def _other_place(source: Path) -> tuple[str, Path] | None:
    for parent in islice(source.absolute().parents, 3):
        if _is_log(parent):
            return f"a part of the recording {parent}", parent
    try:
        below = [path for path in islice(visible_entries(source), _MOST) if _is_log(path)]
    except InputError:
        return None
    return (f"a folder of {len(below)} recordings", below[0]) if below else None


def read_lightsim_log(reading: LogReading, find_ego_vehicle: FindEgoVehicle) -> DrivingLog:
    """Read a lightsim-log/1 folder; pictures and sweeps are loaded on demand.

    Raises:
        InputError: something is missing or broken; the message names the file.
    """
    source = Path(reading.source)
    header = read_header(source)
    ego, ego_notes = read_ego(source / EGO_NAME)
    check_clock(header.located.clock, ego.start_ns, source / EGO_NAME)
    poses = read_picture_poses(source / PICTURES_NAME)
    cameras: list[RecordedCamera] = []
    notes = [*header.notes, *ego_notes, *_folder_notes(source, header)]
    for name, entry in header.cameras.items():
        camera, camera_notes = _camera(source, name, entry, poses)
        _check_poses(source, camera, ego)
        cameras.append(camera)
        notes += camera_notes
    notes += _lost_poses(cameras, poses)
    sweeps, sweep_notes = _sweeps(source, header)
    notes += sweep_notes
    points = source / POINTS_NAME
    if not any(sweeps.values()) and has_file(points):
        sweeps = {"points": (points_sweep(points, cameras, ego),)}
        notes.append(points_note(points))
    elif has_file(points):
        notes.append(f"{POINTS_NAME} is not used: the log has LiDAR sweeps")
    actors, actor_notes = read_boxes(source / BOXES_NAME, ego)
    track = read_gps(source / GPS_NAME, ego.start_ns)
    recorded = RecordedLog(
        header.name,
        tuple(cameras),
        ego,
        sweeps,
        actors,
        replace(header.located, track=track),
        header.class_names,
        (*notes, *actor_notes),
        header.licence,
    )
    log = assemble(recorded, reading, find_ego_vehicle)
    x, y, z = (a + b for a, b in zip(log.origin_m, header.origin_m, strict=True))
    # A log that LightSim wrote repeats notes of the recording.
    return replace(log, origin_m=(x, y, z), notes=tuple(dict.fromkeys(log.notes)))


READER = LogReader(_is_log, read_lightsim_log, _other_place)


def _camera(
    source: Path, name: str, entry: CameraEntry, poses: dict[tuple[str, int], PicturePose]
) -> tuple[RecordedCamera, tuple[str, ...]]:
    """Return a camera with its pictures, and notes."""
    paths, notes = stamped_files(source / IMAGES / name, _SUFFIXES)
    size = entry.lens.width_px, entry.lens.height_px
    pictures: list[RecordedPicture] = []
    for time_ns, path in paths.items():
        check_size(path, size, "size_px in log.json")
        pose = poses.get((name, time_ns))
        pictures.append(
            RecordedPicture(
                time_ns,
                path,
                partial(load_image, path, *size),
                None if pose is None else pose.world_from_camera,
                None if pose is None else pose.motion_world,
            )
        )
    if not pictures:
        notes += (f"{name}: no picture in {IMAGES}/{name}",)
    camera = RecordedCamera(
        name,
        entry.lens,
        entry.ego_from_camera,
        tuple(pictures),
        entry.readout,
        _mask(source / MASKS / f"{name}.png", size),
    )
    return camera, notes


def _check_poses(source: Path, camera: RecordedCamera, ego: Trajectory) -> None:
    """Check that the pictures' own poses and velocities are those of a camera on the vehicle."""
    for picture in camera.pictures:
        if picture.world_from_camera is None:
            continue
        where = f"{source / PICTURES_NAME}, {camera.name} at {picture.time_ns} ns"
        nominal = ego.held(picture.time_ns) @ camera.ego_from_camera
        gap_m = math.dist(picture.world_from_camera.translation_m, nominal.translation_m)
        LIMITS["fellow camera"].check(where, gap_m, f"{gap_m:.4g} m from the ego path")
        if picture.motion_world is not None:
            speed, rate = (float(np.linalg.norm(v)) for v in picture.motion_world)
            LIMITS["speed"].check(where, speed, f"{speed:.4g} m/s")
            LIMITS["turn"].check(where, float(np.degrees(rate)), f"{rate:.4g} rad/s")


def _lost_poses(
    cameras: Sequence[RecordedCamera], poses: Mapping[tuple[str, int], PicturePose]
) -> list[str]:
    """Return a note on poses in camera_poses.csv that are those of no picture."""
    pictures = {(camera.name, p.time_ns) for camera in cameras for p in camera.pictures}
    lost = [key for key in poses if key not in pictures]
    if not lost:
        return []
    return [f"{PICTURES_NAME}: {len(lost)} of {len(poses)} poses belong to no picture, such as "
            f"{lost[0][0][:40]} at {lost[0][1]} ns: times must be those of the files"]  # fmt: skip


def _mask(path: Path, size: tuple[int, int]) -> Bool[np.ndarray, "h w"] | None:
    """Return the mask of a camera, white where it shows the ego vehicle; None without the file."""
    if not has_folder(path.parent) or not has_file(path):
        return None
    found = read_size(path)
    if found != size:
        raise InputError(
            "the mask's size differs from size_px in log.json",
            where=path,
            got=f"{found[0]}x{found[1]} px",
            expected=f"{size[0]}x{size[1]} px",
        )
    grey = read_grey8(path)
    # Masks of 0 and 1 are as common as those of 0 and 255.
    mask = grey > (127 if grey.max() > 1 else 0)
    if mask.mean() > _MOST_MASKED:
        raise InputError(
            "the mask hides most of the pictures",
            where=path,
            got=f"{mask.mean():.0%} of the pixels are white",
            expected="white where the ego vehicle is, black elsewhere",
            remedy="Invert the mask.",
        )
    return mask


def _sweeps(
    source: Path, header: Header
) -> tuple[dict[str, tuple[RecordedSweep, ...]], tuple[str, ...]]:
    sweeps: dict[str, tuple[RecordedSweep, ...]] = {}
    notes: tuple[str, ...] = ()
    for name, lidar in header.lidars.items():
        sweeps[name], lidar_notes = read_sweeps(source / SWEEPS / name, lidar)
        notes += lidar_notes
    return sweeps, notes


def _folder_notes(source: Path, header: Header) -> list[str]:
    """Return notes on folders of sensors that log.json does not name."""
    notes: list[str] = []
    for part, known in ((IMAGES, header.cameras), (SWEEPS, header.lidars)):
        others = [path.name for path in subfolders(source / part) if path.name not in known]
        if others:
            shown = ", ".join(name[:40] for name in others[:3] if name.isprintable())
            notes.append(f"{part}: {len(others)} folders are not named in {LOG_NAME} and are not"
                         f" used: {shown}")  # fmt: skip
    masks = visible_entries(source / MASKS) if has_folder(source / MASKS) else []
    known_masks = {f"{name}.png" for name in header.cameras}
    lost = [path.name for path in masks if path.name not in known_masks and path.name.isprintable()]
    if lost:
        notes.append(f"{MASKS}: files without a camera of their name are not used:"
                     f" {', '.join(lost[:3])[:120]}")  # fmt: skip
    return notes
