"""Reader of Argoverse 2 logs (Wilson et al. 2021, arXiv:2301.00493): the Sensor data set, and
Trust, but Verify.

Layout of a log: calibration/*.feather, city_SE3_egovehicle.feather, annotations.feather,
sensors/lidar/TIME.feather, sensors/cameras/NAME/TIME.jpg and map/, in one of the folders train,
val and test. Its documentation is the user guide at argoverse.github.io/user-guide.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from lightsim.core.actors import ActorTrack
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import DrivingLog, FindEgoVehicle
from lightsim.core.reading import LogReading
from lightsim.datasets.argoverse2.places import located
from lightsim.datasets.argoverse2.poses import (
    INTRINSICS,
    MOUNTING,
    POSES,
    read_ego,
    read_lenses,
    read_mounting,
)
from lightsim.datasets.argoverse2.sweeps import LIDARS, ScanTiming, load_sweep
from lightsim.datasets.argoverse2.tracks import BOXES, read_boxes, tracks_of
from lightsim.datasets.assemble import assemble
from lightsim.datasets.layout import has_file, subfolders, visible_entries
from lightsim.datasets.lenses import Lens
from lightsim.datasets.pictures import image_size, load_image
from lightsim.datasets.reader import LogReader
from lightsim.datasets.recorded import (
    RecordedCamera,
    RecordedLog,
    RecordedPicture,
    RecordedSweep,
)
from lightsim.errors import InputError
from lightsim.store.reading import is_file, is_folder

LICENCE = "CC BY-NC-SA 4.0 with the Argoverse terms of use (argoverse.org/about.html#terms-of-use)"
CAMERAS = "sensors/cameras"
SWEEPS = "sensors/lidar"
RING_CAMERAS = (
    "ring_front_center", "ring_front_left", "ring_front_right", "ring_rear_left",
    "ring_rear_right", "ring_side_left", "ring_side_right",
)  # fmt: skip
"""Cameras that are read by default; ring_front_center has portrait pictures."""
STEREO_CAMERAS = ("stereo_front_left", "stereo_front_right")
"""Grey cameras, which are read if --cameras names them."""
_SPLITS = ("train", "val", "test")
_PICTURES, _TABLES = (".jpg", ".jpeg", ".png"), (".feather",)
# Digits of the largest time stamp in a file name, in nanoseconds.
_MAX_DIGITS = 18
# Number of folders that are looked at to recognise a data set.
_LOOKED_AT = 20
# Number of names that a message lists.
_SHOWN = 6


def read_argoverse2(reading: LogReading, find_ego_vehicle: FindEgoVehicle) -> DrivingLog:
    """Read an Argoverse 2 log; pictures and sweeps are loaded on demand.

    Args:
        reading: options; the source is the folder of a log, or one with many logs and --scene.
        find_ego_vehicle: finds the ego vehicle in the pictures of all cameras.

    Raises:
        InputError: something is missing or broken; the message names the file.
    """
    folder = log_folder(reading)
    pictures, picture_notes = _pictures(folder, reading.cameras)
    ego, ego_notes = read_ego(folder)
    mounting, lenses = read_mounting(folder), read_lenses(folder)
    cameras = tuple(
        _camera(folder, name, files, mounting, lenses) for name, files in pictures.items()
    )
    sweeps, sweep_notes = read_sweeps(folder, mounting)
    actors, actor_notes = read_actors(folder, ego, sweeps)
    east, north, _ = ego.positions_m[0].tolist()
    place, place_notes = located(folder, (east, north))
    recorded = RecordedLog(
        folder.resolve().name,
        cameras,
        ego,
        {"lidar": sweeps},
        actors,
        place,
        notes=(*picture_notes, *ego_notes, *sweep_notes, *actor_notes, *place_notes),
        licence=LICENCE,
    )
    return assemble(recorded, reading, find_ego_vehicle)


def is_log(folder: Path) -> bool:
    """Return whether a folder has the layout of an Argoverse 2 log."""
    return is_file(folder / MOUNTING) or is_file(folder / POSES)


def log_folder(reading: LogReading) -> Path:
    """Return the folder of the log that SOURCE and --scene choose.

    Raises:
        InputError: no log, or more than one, has this name.
    """
    source, scene = Path(reading.source), reading.scene
    folders = [source] if is_log(source) else _logs_below(source)
    named = [folder for folder in folders if folder.resolve().name == scene]
    found = named or [f for f in folders if f.resolve().name.startswith(scene)]
    if len(found) == 1:
        return found[0]
    names = sorted(folder.resolve().name for folder in found or folders)
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    raise InputError(
        "SOURCE has many logs" if found else "there is no log of this name",
        where=source,
        got=f"--scene {scene}" if scene else f"{len(names)} logs",
        expected=f"--scene with the name, or the first letters, of one of {len(names)} logs:"
        f" {', '.join(names[:_SHOWN])}{more}",
    )


def _logs_below(source: Path) -> list[Path]:
    """Return the logs in a folder, or in its folders train, val and test."""
    parents = [source, *(source / split for split in _SPLITS if is_folder(source / split))]
    return [
        path for parent in parents for path in visible_entries(parent)
        if is_folder(path) and is_log(path)
    ]  # fmt: skip


def _is_source(source: Path) -> bool:
    if is_log(source):
        return True
    parents = [source, *(source / split for split in _SPLITS)]
    return any(is_log(path) for parent in parents for path in islice(_entries(parent), _LOOKED_AT))


def _entries(folder: Path) -> Iterator[Path]:
    try:
        with os.scandir(folder) as entries:
            yield from (Path(entry.path) for entry in entries)
    except (OSError, ValueError):
        return


def _other_place(source: Path) -> tuple[str, Path] | None:
    """Return the log of which SOURCE is a part; None if there is none."""
    parents = islice(source.absolute().parents, 3)
    return next(((f"a part of the log {p}", p) for p in parents if is_log(p)), None)


def _files(reading: LogReading) -> Iterator[Path]:
    """Yield the files that determine a log."""
    folder = log_folder(reading)
    unused = {name for name in STEREO_CAMERAS if name not in reading.cameras}
    yield from (folder / name for name in (POSES, BOXES) if is_file(folder / name))
    for part in ("calibration", "map", SWEEPS, CAMERAS):
        for path in (folder / part).rglob("*"):
            if path.is_file() and path.parent.name not in unused:
                yield path


READER = LogReader(_is_source, read_argoverse2, _other_place, _files)


def _stamped(folder: Path, suffixes: tuple[str, ...]) -> tuple[dict[int, Path], list[str]]:
    """Return the files of a folder by the time stamp in their name, in time order, and notes."""
    found: dict[int, Path] = {}
    others: list[str] = []
    for path in visible_entries(folder) if is_folder(folder) else []:
        stem = path.stem
        is_time = stem.isascii() and stem.isdigit() and len(stem) <= _MAX_DIGITS
        if is_time and path.suffix.lower() in suffixes and int(stem) not in found:
            found[int(stem)] = path
        else:
            others.append(path.name)
    more = f" and {len(others) - _SHOWN} more" if len(others) > _SHOWN else ""
    notes = [f"{folder.name}: {', '.join(n[:40] for n in others[:_SHOWN])}{more} are not used:"
             " file names are time stamps in nanoseconds"] if others else []  # fmt: skip
    return dict(sorted(found.items())), notes


def _pictures(
    folder: Path, wanted: tuple[str, ...]
) -> tuple[dict[str, dict[int, Path]], tuple[str, ...]]:
    """Return the pictures of each camera by time, and notes.

    Raises:
        InputError: there are none.
    """
    names = [path.name for path in subfolders(folder / CAMERAS)]
    stereo = [name for name in names if name in STEREO_CAMERAS and name not in wanted]
    found: dict[str, dict[int, Path]] = {}
    notes: list[str] = []
    for name in (name for name in names if name not in stereo):
        found[name], camera_notes = _stamped(folder / CAMERAS / name, _PICTURES)
        notes += camera_notes
    if not any(found.values()):
        split = folder.resolve().parent.name
        url = f"s3://argoai-argoverse/av2/sensor/{split if split in _SPLITS else 'SPLIT'}"
        raise InputError(
            "the log has no pictures",
            where=folder / CAMERAS,
            got=f"folders {', '.join(names)}" if names else "no such folder, or an empty one",
            expected=f"{CAMERAS}/{RING_CAMERAS[0]}/TIME.jpg and six other ring cameras",
            remedy="Download the whole log of the Sensor data set (the Lidar data set has no"
            f" pictures): s5cmd --no-sign-request cp '{url}/{folder.resolve().name}/*'"
            f" {folder}",
        )
    missing = [name for name in RING_CAMERAS if not found.get(name)]
    if missing and not wanted:
        notes.append(f"no pictures of {', '.join(missing)}")
    if stereo:
        notes.append(f"{', '.join(stereo)}: grey pictures, read only if --cameras names them")
    return {name: files for name, files in found.items() if files}, tuple(notes)


def _camera(
    folder: Path,
    name: str,
    files: Mapping[int, Path],
    mounting: Mapping[str, RigidTransform],
    lenses: Mapping[str, Lens],
) -> RecordedCamera:
    """Return a camera; its pictures are opened for their size only.

    All cameras have global shutters, with exposures that are centred on the LiDARs' scan of their
    view (user guide, "Sensor Suite"); each picture has its own time, at 20 Hz, whereas LiDARs have
    10 Hz (av2-api issues 112 and 155). It is not documented which moment of the exposure the stamp
    names.

    Raises:
        InputError: the camera is not calibrated, or a picture is broken or of another size.
    """
    for table, path in ((mounting, MOUNTING), (lenses, INTRINSICS)):
        if name not in table:
            raise InputError(
                f"the camera '{name}' is not calibrated",
                where=folder / path,
                got=", ".join(table)[:300],
                remedy="Download the file again, or remove the folder of the camera"
                " (calibration of stereo cameras is missing in some logs: av2-api issue 274).",
            )
    lens = lenses[name]
    size = (lens.width_px, lens.height_px)
    for path in files.values():
        if image_size(path) != size:
            raise InputError(
                "the picture's size differs from that of its intrinsics",
                where=path,
                got="{}x{} px".format(*image_size(path)),
                expected="{}x{} px".format(*size),
                remedy="Use pictures of the original size: --image-scale reduces them.",
            )
    pictures = tuple(
        RecordedPicture(time_ns, path, partial(load_image, path, *size))
        for time_ns, path in files.items()
    )
    return RecordedCamera(name, lens, mounting[name], pictures)


def read_sweeps(
    folder: Path, mounting: Mapping[str, RigidTransform]
) -> tuple[tuple[RecordedSweep, ...], tuple[str, ...]]:
    """Return the sweeps of a log, each of both LiDARs, and notes.

    Raises:
        InputError: the LiDARs are not calibrated.
    """
    files, notes = _stamped(folder / SWEEPS, _TABLES)
    missing = [name for name in LIDARS if name not in mounting]
    if files and missing:
        raise InputError(
            f"the LiDAR '{missing[0]}' is not calibrated",
            where=folder / MOUNTING,
            got=", ".join(mounting)[:300],
            expected=" and ".join(LIDARS),
        )
    if not files:
        return (), tuple(notes)
    origins_ego = np.stack([mounting[name].translation_m for name in LIDARS])
    sweeps = tuple(
        RecordedSweep(time_ns, path, partial(load_sweep, path, origins_ego))
        for time_ns, path in files.items()
    )
    return sweeps, tuple(notes)


def read_actors(
    folder: Path, ego: Trajectory, sweeps: tuple[RecordedSweep, ...]
) -> tuple[tuple[ActorTrack, ...], tuple[str, ...]]:
    """Return the actors of a log in the city's frame, and notes; the logs of the split test, of the
    Lidar data set and of Trust, but Verify have none.

    Args:
        ego: `world_from_ego`.
        sweeps: the first one is loaded for the times of scanning, which are equal in all.

    Raises:
        InputError: the boxes or the first sweep are broken.
    """
    timing = ScanTiming.of(sweeps[0].load()) if sweeps else None
    notes: tuple[str, ...] = ()
    if sweeps and timing is None:
        notes = ("returns have no times of their own (Trust, but Verify): positions of the LiDARs"
                 " are those at the start of each sweep",)  # fmt: skip
    path = folder / BOXES
    if not has_file(path):
        return (), notes
    actors, actor_notes = tracks_of(read_boxes(path), ego, timing)
    return actors, (*notes, *actor_notes)
