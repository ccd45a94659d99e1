"""File log.json of a lightsim-log/1 folder: clock, place, cameras and LiDARs."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lightsim.core.frames import RigidTransform
from lightsim.core.log import Clock, Place
from lightsim.core.solar import SolarPosition
from lightsim.datasets.files import read_json, require_number
from lightsim.datasets.geo import Located, is_null
from lightsim.datasets.lenses import MODELS, Lens
from lightsim.datasets.lightsim.entries import JsonObject
from lightsim.datasets.pictures import MAX_PIXELS
from lightsim.datasets.plausible import check_intrinsics
from lightsim.datasets.recorded import PointFrame, Readout, ReadoutDirection, StampedMoment
from lightsim.errors import InputError
from lightsim.store.names import is_harmless

LOG_NAME = "log.json"
FORMAT = "lightsim-log/1"
POINT_FRAMES = {
    "raw, at their own times": PointFrame.OWN_TIME,
    "at sweep time": PointFrame.SWEEP_TIME,
    "world": PointFrame.WORLD,
}
"""Entry `points` of a LiDAR."""
_CLOCKS = '"utc", "local+02:00", "utc+18s" (GPS time, for example) or "unknown"'
_LOCAL = re.compile(r"local([+-])([0-9]{2}):([0-9]{2})")
_OFFSET = re.compile(r"utc([+-])([0-9]{1,10})(?:\.([0-9]{1,9}))?s")
_CLASS = re.compile(r"[0-9]{1,5}")
# Largest id of a point class, of int16.
_MAX_CLASS = 2**15 - 1
# Smallest accepted intensity of the strongest return: no unit makes it smaller, and quotients stay
# finite.
_LEAST_INTENSITY = 1e-6
# Longest list of unknown keys in a note.
_KEYS_SHOWN = 6


@dataclass(frozen=True, eq=False)
class CameraEntry:
    """Entry of a camera."""

    lens: Lens
    ego_from_camera: RigidTransform
    readout: Readout


@dataclass(frozen=True, eq=False)
class LidarEntry:
    """Entry of a LiDAR.

    Args:
        stamp: moment of the turn to which a sweep's time refers.
        intensity_max: intensity of the strongest return; None if not given.
        bin_columns: names of the columns of .bin files.
    """

    ego_from_lidar: RigidTransform
    frame: PointFrame
    stamp: StampedMoment
    intensity_max: float | None
    bin_columns: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Header:
    """Content of log.json.

    Args:
        located: place, clock and north, without the GPS track of gps.csv.
        origin_m: origin of the world frame in a larger one, such as UTM.
    """

    name: str
    cameras: Mapping[str, CameraEntry]
    lidars: Mapping[str, LidarEntry]
    located: Located
    origin_m: tuple[float, ...]
    class_names: Mapping[int, str]
    licence: str
    notes: tuple[str, ...]


def read_header(source: Path) -> Header:
    """Read log.json.

    Raises:
        InputError: the file is missing, or an entry is missing or wrong.
    """
    path = source / LOG_NAME
    root = JsonObject(read_json(path), str(path))
    root.choice("format", (FORMAT,))
    cameras = {name: _camera(name, e) for name, e in _named(root, "cameras").items()}
    lidars = {name: _lidar(e) for name, e in _named(root, "lidars").items()}
    notes = [note for _, camera_notes in cameras.values() for note in camera_notes]
    classes = _class_names(root)
    located = _located(root)
    header = Header(
        root.text("name", source.resolve().name),
        {name: entry for name, (entry, _) in cameras.items()},
        {name: entry for name, (entry, _) in lidars.items()},
        located,
        root.numbers("origin_m", "[x, y, z]") if "origin_m" in root else (0.0, 0.0, 0.0),
        classes,
        root.text("licence"),
        root.texts("notes"),
    )
    notes += [note for _, lidar_notes in lidars.values() for note in lidar_notes]
    return replace(header, notes=(*header.notes, *notes, *_unknown_keys(root)))


def _named(root: JsonObject, key: str) -> dict[str, JsonObject]:
    """Return the entries of sensors; their names are names of folders."""
    found = root.objects(key)
    for name in found:
        if not is_harmless(name):
            raise InputError(
                "the name of a sensor must be a valid file name",
                where=f"{root.where}, {key}",
                got=repr(name)[:90],
                expected="letters, digits, '_', '-' and '.', a letter or digit first",
            )
    return found


def _camera(name: str, entry: JsonObject) -> tuple[CameraEntry, tuple[str, ...]]:
    model = entry.choice("model", MODELS)
    width, height = entry.numbers("size_px", "[width, height]")
    if not (width % 1 == height % 1 == 0 and min(width, height) >= 1) or (
        width * height > MAX_PIXELS
    ):
        raise InputError(
            "the size of the pictures is not valid",
            where=entry.where,
            got=f"size_px {width:g}, {height:g}",
            expected=f"whole numbers, at most {MAX_PIXELS} pixels",
        )
    fx, fy, cx, cy = (entry.number(key) for key in ("fx", "fy", "cx", "cy"))
    corner = entry.number("first_pixel_centre")
    if corner not in (0.0, 0.5):
        raise InputError(
            "the entry 'first_pixel_centre' has a wrong value",
            where=entry.where,
            got=corner,
            expected="0.0 (OpenCV: cx, cy count from the centre of the first pixel) or 0.5 (from "
            "its corner)",
        )
    # LightSim's pixels begin at the corner of the first one.
    centre = cx + (0.5 - corner), cy + (0.5 - corner)
    size = int(width), int(height)
    try:
        lens = Lens(model, *size, fx, fy, *centre, entry.number_list("distortion", 8))
    except InputError as error:
        raise InputError(
            error.what, where=entry.where, got=error.got, expected=error.expected
        ) from error
    notes: tuple[str, ...] = ()
    if model in ("pinhole", "brown"):
        # The note names the folder: that of the camera.
        where = Path(entry.where) / name
        notes = check_intrinsics(where, size, (fx, fy), (cx, cy))
    readout = Readout(
        entry.number("readout_s", 0.0),
        ReadoutDirection(entry.choice("readout", list(ReadoutDirection), "top_to_bottom")),
        StampedMoment(entry.choice("time", list(StampedMoment), "middle")),
        entry.number("readout_other_axis_s", 0.0),
    )
    mounting = entry.transform("ego_from_camera", "ego", "camera")
    return CameraEntry(lens, mounting, readout), (*notes, *_unknown_keys(entry))


def _lidar(entry: JsonObject) -> tuple[LidarEntry, tuple[str, ...]]:
    most = entry.optional_number("intensity_max")
    if most is not None and most < _LEAST_INTENSITY:
        raise InputError(
            "the entry 'intensity_max' has a wrong value",
            where=entry.where,
            got=most,
            expected="the intensity of the strongest return, above 0, such as 255",
        )
    lidar = LidarEntry(
        entry.transform("ego_from_lidar", "ego", "lidar"),
        POINT_FRAMES[entry.choice("points", list(POINT_FRAMES))],
        StampedMoment(entry.choice("time", list(StampedMoment), "middle")),
        most,
        entry.texts("bin_columns"),
    )
    return lidar, _unknown_keys(entry)


def _located(root: JsonObject) -> Located:
    place: Place | None = None
    if "place" in root:
        latitude, longitude = root.numbers("place", "[latitude, longitude]")
        if abs(latitude) > 90 or abs(longitude) > 180:
            raise InputError(
                "the place is not on Earth",
                where=root.where,
                got=f"latitude {latitude:g}, longitude {longitude:g}",
                expected="degrees within 90 and 180 of zero",
            )
        if is_null(np.array([latitude]), np.array([longitude])).any():
            raise InputError(
                "the place is 0, 0, in the sea off Africa",
                where=root.where,
                got=f"latitude {latitude:g}, longitude {longitude:g}",
                expected='the place of the drive, or "place": null if it is unknown',
            )
        place = Place(
            latitude,
            longitude,
            root.text("place_source", "log"),
            root.number("place_std_deg", 0.0),
        )
    sun: SolarPosition | None = None
    if "sun_deg" in root:
        sun = SolarPosition(*root.numbers("sun_deg", "[azimuth, elevation]"))
    return Located(
        None,
        place,
        _clock(root),
        root.optional_number("world_x_azimuth_deg"),
        root.optional_number("world_x_azimuth_std_deg"),
        root.text("world_x_azimuth_source", "map"),
        root.optional_number("gps_residual_m"),
        sun,
    )


def _clock(root: JsonObject) -> Clock | None:
    """Return the offset of UTC from the log's times; None if it is unknown."""
    text = root.any("clock", _CLOCKS)
    offset_ns = utc_minus_log_ns(text) if isinstance(text, str) else None
    if text != "unknown" and offset_ns is None:
        raise InputError(
            "the entry 'clock' has a wrong value",
            where=root.where,
            got=f"{text!r:.60}",
            expected=_CLOCKS,
        )
    source, std_s = root.text("clock_source", "log"), root.number("clock_std_s", 1.0)
    return None if offset_ns is None else Clock(offset_ns, source, std_s)


def utc_minus_log_ns(clock: str) -> int | None:
    """Return the offset that the entry `clock` means; None for another text."""
    if clock == "utc":
        return 0
    local, offset = _LOCAL.fullmatch(clock), _OFFSET.fullmatch(clock)
    if local is not None:
        sign, hours, minutes = local.groups()
        log_minus_utc_ns = (int(hours) * 60 + int(minutes)) * 60 * 10**9
    elif offset is not None:
        sign, seconds, digits = offset.groups()
        log_minus_utc_ns = int(seconds) * 10**9 + int((digits or "").ljust(9, "0"))
    else:
        return None
    return log_minus_utc_ns if sign == "-" else -log_minus_utc_ns


def clock_word(clock: Clock | None) -> str:
    """Return the entry `clock`; inverse of `utc_minus_log_ns`."""
    if clock is None:
        return "unknown"
    if clock.utc_minus_log_ns == 0:
        return "utc"
    seconds, digits = divmod(abs(clock.utc_minus_log_ns), 10**9)
    sign = "-" if clock.utc_minus_log_ns > 0 else "+"
    return f"utc{sign}{seconds}.{digits:09d}s"


def _class_names(root: JsonObject) -> dict[int, str]:
    names = JsonObject(root.any("point_classes", "") if "point_classes" in root else {},
                       f"{root.where}, point_classes")  # fmt: skip
    found: dict[int, str] = {}
    for key in names:
        if not _CLASS.fullmatch(key) or int(key) > _MAX_CLASS:
            raise InputError(
                "the id of a point class is not valid",
                where=names.where,
                got=repr(key)[:40],
                expected=f"a number from 0 to {_MAX_CLASS}",
            )
        found[int(key)] = names.text(key)
    return found


def _unknown_keys(entry: JsonObject) -> tuple[str, ...]:
    unknown = entry.unknown()
    if not unknown:
        return ()
    more = len(unknown) - _KEYS_SHOWN
    shown = ", ".join(unknown[:_KEYS_SHOWN]) + (f" and {more} more" if more > 0 else "")
    place = entry.where.split(f"{LOG_NAME}, ")[-1].rpartition("/")[2]
    return (f"{place}: unknown entries are ignored: {shown}",)


def check_clock(clock: Clock | None, first_ns: int, where: Path) -> None:
    """Check that the times of a log with UTC lie between 1980 and 2100.

    Raises:
        InputError: they are of another unit, or of another clock.
    """
    if clock is None:
        return
    utc_s = require_number((first_ns + clock.utc_minus_log_ns) * 1e-9, where)
    if not 3.1e8 < utc_s < 4.2e9:
        raise InputError(
            "a time is not in nanoseconds of UTC between 1980 and 2100",
            where=where,
            got=f"{first_ns} ns",
            expected='times that fit the entry "clock" of log.json',
            remedy='Write nanoseconds since 1970, or "clock": "unknown".',
        )
