"""Scenes of DGP: their place in a data set, their JSON document and its entries.

Format: dgp/proto/{scene,sample,geometry}.proto of github.com/TRI-ML/dgp, written as JSON.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.core.frames import RigidTransform
from lightsim.core.reading import LogReading
from lightsim.datasets.files import read_json, require_list, require_numbers, require_object
from lightsim.datasets.layout import has_file, visible_entries
from lightsim.datasets.pictures import stored_picture
from lightsim.datasets.scenes import chosen_scene
from lightsim.errors import InputError
from lightsim.store.reading import is_folder

# Number of folders below SOURCE that are searched for a first scene.
_SEARCHED = 20
# Plausible years of a recording; stamps that are 10 times too large lie in the 25th century.
_YEARS = (2010, 2040)
_REMEDY = "Copy the file again from the original data set."


@dataclass(frozen=True, eq=False)
class Datum:
    """One picture or point cloud.

    Args:
        where: the entry, for messages.
        body: the entry's content, with filename, annotations, and size or format.
    """

    sensor: str
    time_ns: int
    path: Path
    world_from_sensor: RigidTransform
    body: Mapping[str, Any]
    where: str


@dataclass(frozen=True, eq=False)
class Scene:
    """Content of a scene's document.

    Args:
        path: the document; its folder is the scene.
        clouds, pictures: existing files of each sensor in time order, each time once.
        calibration_path: file of sensor poses and intrinsics.
        ontologies: key of the class names of each type of annotation.
    """

    path: Path
    clouds: Mapping[str, tuple[Datum, ...]]
    pictures: Mapping[str, tuple[Datum, ...]]
    calibration_path: Path
    ontologies: Mapping[str, Any]
    notes: tuple[str, ...]

    @property
    def folder(self) -> Path:
        return self.path.parent


def is_scene(folder: Path) -> bool:
    """Return whether a folder has the layout of a DGP scene."""
    return is_folder(folder / "calibration") and any(folder.glob("scene_*.json"))


def is_dgp(folder: Path) -> bool:
    """Return whether a folder is a DGP scene, or a data set with a folder for each scene."""
    return is_scene(folder) or any(map(is_scene, islice(_folders(folder), _SEARCHED)))


def other_place(source: Path) -> tuple[str, Path] | None:
    """Return a description and the folder of a scene above or below a wrong SOURCE, or None."""
    for parent in islice(source.absolute().parents, 3):
        if is_scene(parent):
            return f"a part of the scene {parent}", parent
    for inner in islice(_folders(source), _SEARCHED):
        if is_dgp(inner):
            return f"a folder with the data set {inner.name}", inner
    return None


def chosen_folder(reading: LogReading) -> Path:
    """Return the folder of the scene that SOURCE and --scene name.

    Raises:
        InputError: there is no such scene, or several and none is chosen.
    """
    source = Path(reading.source)
    if is_scene(source):
        if reading.scene and reading.scene != source.resolve().name:
            raise InputError(
                "SOURCE is another scene",
                where=source,
                got=f"--scene {reading.scene}",
                remedy="Leave --scene out, or give the folder of the whole data set.",
            )
        return source
    names = [path.name for path in _folders(source) if is_scene(path)]
    return source / chosen_scene(names, reading)


def read_scene(folder: Path) -> Scene:
    """Read the document of a scene.

    Raises:
        InputError: it is broken, its times are implausible, or it names a file outside the scene.
    """
    documents = sorted(folder.glob("scene_*.json"), key=lambda p: (-p.stat().st_size, p.name))
    path = documents[0]
    notes: list[str] = []
    if len(documents) > 1:
        notes.append(f"{len(documents)} scene documents: the largest one, {path.name}, is used")
    document = require_object(read_json(path), path)
    samples = require_list(document.get("samples"), f"{path}, samples")
    keys = [require_object(s, f"{path}, samples").get("calibration_key") for s in samples]
    if any(key != keys[0] for key in keys):
        notes.append("the scene has several calibrations: the first one is used for all frames")
    entries = require_list(document.get("data"), f"{path}, data")
    microseconds, scale_note = _plausible_ns(
        [_stamp_us(entry, f"{path}, data[{i}]") for i, entry in enumerate(entries)], path
    )
    found: dict[str, list[Datum]] = {"point_cloud": [], "image": []}
    others = 0
    for i, (entry, time_ns) in enumerate(zip(entries, microseconds, strict=True)):
        where = f"{path}, data[{i}]"
        content = require_object(entry.get("datum"), f"{where}, datum")
        kind = next((kind for kind in found if kind in content), None)
        if kind is None:
            others += 1
            continue
        found[kind].append(_datum(folder, entry["id"], time_ns, content[kind], where))
    if others:
        notes.append(f"{others} entries are neither pictures nor point clouds and are not used")
    clouds, pictures = (_by_sensor(found[kind], notes) for kind in ("point_cloud", "image"))
    return Scene(
        path,
        clouds,
        pictures,
        file_inside(folder, f"calibration/{keys[0]}.json", f"{path}, samples[0]"),
        require_object(document.get("ontologies", {}), f"{path}, ontologies"),
        (*scale_note, *notes),
    )


def file_inside(folder: Path, name: Any, where: object) -> Path:
    """Return the path of a file that a document names.

    Raises:
        InputError: the name leads out of the folder, or is no path.
    """
    parts = name.split("/") if isinstance(name, str) else []
    if not parts or any(p in ("", ".", "..") or "\\" in p or not p.isprintable() for p in parts):
        raise InputError(
            "a file's name leads out of the scene",
            where=where,
            got=repr(name)[:80],
            expected=f"a relative path below {folder}",
            remedy="Do not use this folder if it came from an unknown source.",
        )
    return folder / name


def read_pose(value: Any, dst: str, src: str, where: object) -> RigidTransform:
    """Return `dst_from_src` of a pose of DGP.

    Raises:
        InputError: a number is missing or not finite, or the quaternion has no length.
    """
    pose = require_object(value, where)
    translation = require_numbers(pose.get("translation"), ("x", "y", "z"), where)
    quaternion = require_numbers(pose.get("rotation"), ("qw", "qx", "qy", "qz"), where)
    length = float(np.linalg.norm(quaternion))
    # Other lengths are another quantity; rounding is removed by the normalisation.
    if not 0.5 < length < 2.0:
        raise InputError(
            "the rotation is not a unit quaternion",
            where=where,
            got=f"length {length:.3g}",
            remedy=_REMEDY,
        )
    return RigidTransform.from_quaternion(dst, src, quaternion, translation)


def _folders(source: Path) -> list[Path]:
    try:
        return [path for path in visible_entries(source) if is_folder(path)]
    except InputError:
        return []


def _datum(folder: Path, ids: Any, time_ns: int, value: Any, where: str) -> Datum:
    body = require_object(value, where)
    path = stored_picture(file_inside(folder, body.get("filename"), f"{where}, filename"))
    # A sensor moves: its pose is that of its own stamp, in the world frame of the scene already.
    pose = read_pose(body.get("pose"), "world", "sensor", f"{where}, pose")
    return Datum(ids["name"], time_ns, path, pose, body, where)


def _stamp_us(entry: Any, where: str) -> int:
    """Return the microseconds since 1970 of an entry's stamp, of any year."""
    ids = require_object(require_object(entry, where).get("id"), f"{where}, id")
    name, stamp = ids.get("name"), ids.get("timestamp")
    if not isinstance(name, str) or not 0 < len(name) <= 80 or not name.isprintable():
        raise InputError(
            "the sensor has no name", where=f"{where}, id", got=repr(name)[:60], expected="text"
        )
    try:
        moment = datetime.fromisoformat(str(stamp))
    except ValueError as error:
        raise InputError(
            "the time stamp cannot be read",
            where=f"{where}, id",
            got=repr(stamp)[:60],
            expected="a UTC time such as 2019-06-27T14:30:25.002790Z",
            remedy=_REMEDY,
        ) from error
    # Integers: a float cannot represent microseconds of the year 2464.
    since = moment.replace(tzinfo=moment.tzinfo or UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds


def _plausible_ns(stamps_us: Sequence[int], path: Path) -> tuple[list[int], tuple[str, ...]]:
    """Return times in nanoseconds, and a note if they are in another unit than stated.

    DGP's test scenes count 0.1 us as if they were 1 us, which gives the year 2464 instead of 2019;
    the scenes of DDAD do not [measured].
    """
    least_us, most_us = (
        round(datetime(year, 1, 1, tzinfo=UTC).timestamp() * 1e6) for year in _YEARS
    )
    for divisor in (1, 10):
        if all(least_us * divisor <= us < most_us * divisor for us in stamps_us):
            note = "the time stamps are 10 times too large (0.1 us, not 1 us): divided by 10"
            return [us * 1000 // divisor for us in stamps_us], () if divisor == 1 else (note,)
    raise InputError(
        "the time stamps are implausible",
        where=path,
        got=f"{min(stamps_us) * 1e-6:.0f} to {max(stamps_us) * 1e-6:.0f} s since 1970",
        expected=f"times of the years {_YEARS[0]} to {_YEARS[1] - 1}",
        remedy=_REMEDY,
    )


def _by_sensor(data: Sequence[Datum], notes: list[str]) -> dict[str, tuple[Datum, ...]]:
    """Return the existing files of each sensor in time order, each time once; add notes."""
    by_sensor: dict[str, dict[int, Datum]] = {}
    missing: dict[str, int] = {}
    doubled: dict[str, int] = {}
    for datum in sorted(data, key=lambda d: (d.sensor, d.time_ns)):
        known = by_sensor.setdefault(datum.sensor, {})
        if not has_file(datum.path):
            missing[datum.sensor] = missing.get(datum.sensor, 0) + 1
        elif datum.time_ns in known:
            doubled[datum.sensor] = doubled.get(datum.sensor, 0) + 1
        else:
            known[datum.time_ns] = datum
    notes += [f"{sensor}: {n} files are missing" for sensor, n in missing.items()]
    notes += [f"{sensor}: {n} entries repeat a time stamp and are not used"
              for sensor, n in doubled.items()]  # fmt: skip
    return {sensor: tuple(known.values()) for sensor, known in by_sensor.items() if known}
