"""The target sky that a user names: a file, a sun position, a time, or the source's own."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from lightsim.build.workspace import Workspace
from lightsim.core.camera import PinholeCamera
from lightsim.core.checks import check_number
from lightsim.core.dome import SkyDome, find_sun
from lightsim.core.frames import RigidTransform
from lightsim.core.log import GeoReference
from lightsim.core.sky_choice import FORMS, SkyChoice
from lightsim.core.twin import SkyEstimate
from lightsim.errors import InputError
from lightsim.lighting.night import looks_like_night
from lightsim.lighting.scenery import without_scenery
from lightsim.lighting.sun.direction import SunDirection, sun_from_geo
from lightsim.lighting.target_sky import (
    dome_from_array,
    parse_time,
    scale_to_source,
    target_sky,
    towards_sun,
    with_edited_sun,
)
from lightsim.masks.sky import estimate_sky_matte
from lightsim.simulation.seen_light import SeenLight
from lightsim.store.artefact import hash_file
from lightsim.store.images import read_sky
from lightsim.store.reading import is_file, is_folder
from lightsim.store.sky import read_heading

_LOGGER = logging.getLogger(__name__)
SKY_HEIGHT_PX = 256
_MAX_WORDS = 200
"""Characters of --sky that an error shows, so that what is wrong with them is shown, too."""
_READER = 2
"""Version of `read_sky`, part of what frames are made from: raised when it gives another dome."""
_SAME_NORTH_DEG = 0.02
"""Smaller turns are not made: they only blur a dome whose columns are 0.7 degrees wide. The north
of a synthetic log is found to 0.003 degrees (the shipped street): its true skies stay as they are.
"""


@dataclass(frozen=True, eq=False)
class TargetSky:
    """The sky to render with, in scene units, and what was done to get there.

    Args:
        dome: gives the light.
        behind: what cameras see of a file that shows a place of its own; None is the dome.
        is_source: it is the sky under which the log was recorded.
    """

    dome: SkyDome
    facts: dict[str, Any]
    behind: SkyDome | None = None
    is_source: bool = False


def made_from_sky(choice: SkyChoice) -> dict[str, Any]:
    """What decides the sky's light; moving or renaming its file does not.

    Raises:
        InputError: the words are neither a file nor a known form.
    """
    _check_file(choice)
    if choice.path is None:
        return asdict(choice)
    key = {"sky": hash_file(choice.path), "reader": _READER}
    return {**asdict(choice), **key} | ({"layer": choice.layer} if choice.layer else {})


def resolve_sky(
    choice: SkyChoice, workspace: Workspace, seen: SeenLight | None = None
) -> TargetSky:
    """The dome that a user's words name, for the log of a workspace: a file that knows its north
    is turned to the log's; then it is turned as asked, scaled, and then its
    sun edited, so that the rest of the sky is as bright as without the edit.

    Args:
        seen: of the workspace, shared by skies that are scaled by it.

    Raises:
        InputError: the words or the file are wrong, the sun is below the horizon, or there is none
            to edit.
    """
    geo = workspace.log.geo
    dome, facts = _dome_of(choice, geo, workspace.sky)
    if choice.path is not None:
        dome, turned = _turned_to_north(dome, choice.path, geo)
        facts["notes"] += turned
    if choice.yaw_deg:
        dome = dome.rotated(-choice.yaw_deg)
    seen = seen or SeenLight(workspace)
    source = workspace.sky.dome
    dome, factor = scale_to_source(dome, source, choice.scale_mode, seen.mean_luminance)
    facts |= {"yaw_deg": choice.yaw_deg, "scale": choice.scale, "scale_factor": factor}
    if choice.path is not None and choice.scale_mode == "auto":
        facts["notes"].append(_note_scale(dome, choice.path, factor))
    if choice.has_edited_sun:
        dome, edited = _with_edited_sun(dome, choice, geo)
        facts |= edited
    behind = None
    if choice.path is not None:
        behind, hidden = without_scenery(dome, picture_matte)
        facts["scenery_fraction"] = hidden
    is_source = choice.sky == "source" and not choice.yaw_deg and not choice.has_edited_sun
    is_source = is_source and factor == 1.0
    return TargetSky(dome, facts | _light_facts(dome), behind, is_source)


def picture_matte(
    srgb8: UInt8[np.ndarray, "h w 3"], camera: PinholeCamera, pose: RigidTransform
) -> Float32[np.ndarray, "h w"]:
    """Sky of a picture without LiDAR."""
    return estimate_sky_matte(srgb8, camera, pose, np.zeros((0, 3)), None).expected


def _turned_to_north(
    dome: SkyDome, path: Path, geo: GeoReference | None
) -> tuple[SkyDome, list[str]]:
    """A file's dome in the log's frame `world`, and notes; as stored where a north is unknown."""
    file_deg, log_deg = read_heading(path), None if geo is None else geo.heading_deg
    if file_deg is not None and log_deg is not None:
        # Seen from above, +x of the file's world lies this far counter-clockwise from the log's;
        # headers hold 32 bits.
        yaw_deg = (float(np.float32(log_deg)) - file_deg + 180.0) % 360.0 - 180.0
        if abs(yaw_deg) < _SAME_NORTH_DEG:
            return dome, []
        return dome.rotated(yaw_deg), [f"turned by {yaw_deg:.2f} degrees to the log's north"]
    unknown = "the file" if file_deg is None else "the log"
    note = (
        f"{unknown} does not tell where north is: the sky's centre column is taken to look along"
        " world +x; --sky-yaw-deg turns it"
    )
    _LOGGER.warning("%s: %s", path, note)
    return dome, [note]


def _note_scale(dome: SkyDome, path: Path, factor: float) -> str:
    """What "auto" did to a file's level; a warning where that makes a night as bright as a day."""
    note = (
        f"multiplied by {factor:.3g}, so that the street is as bright as recorded (--sky-scale"
        " auto); --sky-scale none keeps the file's own level, a number sets the factor"
    )
    is_night = looks_like_night(dome)
    if is_night:
        note = f"looks like a night panorama; {note}"
    _LOGGER.log(logging.WARNING if is_night else logging.INFO, "%s: %s", path, note)
    return note


def _with_edited_sun(
    dome: SkyDome, choice: SkyChoice, geo: GeoReference | None
) -> tuple[SkyDome, dict[str, Any]]:
    facts: dict[str, Any] = {"sun_factor": choice.sun_factor}
    direction = None
    if choice.sun_position is not None:
        azimuth_deg, elevation_deg = choice.sun_position
        direction, assumed = towards_sun(azimuth_deg, elevation_deg, geo)
        facts |= {"azimuth_deg": azimuth_deg, "elevation_deg": elevation_deg, **assumed}
    return with_edited_sun(dome, direction, choice.sun_factor), facts


def sky_alone(choice: SkyChoice) -> TargetSky:
    """Return a sky without a log: world axes are taken as east, north, up; nothing is scaled, and
    notes are not logged."""
    dome, facts = _dome_of(choice, None, None)
    return TargetSky(dome, facts | _light_facts(dome))


def sun_of_command(
    time: str | None,
    latitude_deg: float | None,
    longitude_deg: float | None,
    heading_deg: float | None,
) -> SunDirection | None:
    """The sun of a place, a time and a heading (azimuth of world +x), or None if none is given.

    Raises:
        InputError: only some of them are given, or the time is not ISO 8601.
    """
    given = (time, latitude_deg, longitude_deg, heading_deg)
    if all(value is None for value in given):
        return None
    if time is None or latitude_deg is None or longitude_deg is None or heading_deg is None:
        raise InputError(
            "the sun needs all of --time, --latitude, --longitude and --heading-deg",
            remedy="Give all four, or none to find the sun in the picture.",
        )
    check_number("--latitude", latitude_deg, -90.0, 90.0)
    check_number("--longitude", longitude_deg, -180.0, 180.0)
    check_number("--heading-deg", heading_deg, -360.0, 360.0)
    time_ns = parse_time(f"time:{time}")
    yaw_rad = np.radians(90.0 - heading_deg)
    enu_from_world = RigidTransform.from_yaw("enu", "world", float(yaw_rad), np.zeros(3))
    geo = GeoReference(latitude_deg, longitude_deg, time_ns, enu_from_world, "given", None)
    return sun_from_geo(geo, time_ns)


def _dome_of(
    choice: SkyChoice, geo: GeoReference | None, source: SkyEstimate | None
) -> tuple[SkyDome, dict[str, Any]]:
    """The dome as its words or its file give it, and what is to be recorded."""
    facts: dict[str, Any] = {"sky": choice.sky}
    if choice.path is None:
        height_px = SKY_HEIGHT_PX if source is None else source.dome.height_px
        dome, description, found = target_sky(
            choice.sky, geo=geo, source=source, height_px=height_px
        )
        return dome, facts | {"description": description, **found}
    _check_file(choice)
    file = read_sky(choice.path, choice.layer, is_logged=source is not None)
    dome = dome_from_array(file.radiance, str(choice.path))
    if not dome.horizontal_irradiance().max() > 0:
        raise InputError(
            "all light of the sky lies below the horizon",
            where=choice.path,
            expected="the sky in the upper half of the picture",
            remedy="Turn the picture the right way up; row 0 is the zenith.",
        )
    return dome, facts | {"notes": list(file.notes)}


def _light_facts(dome: SkyDome) -> dict[str, Any]:
    sun = dome.sun or find_sun(dome.radiance)
    level = dome.horizontal_irradiance()
    # Light of the sky alone: a sun stands for all that its disc holds.
    from_sun = 0.0 if sun is None else sun.irradiance * max(0.0, float(sun.direction_world[2]))
    return {
        "horizontal_irradiance": level.tolist(),
        "sky_irradiance": np.maximum(level - from_sun, 0.0).tolist(),
        "sun_direction_world": None if sun is None else sun.direction_world.tolist(),
        "sun_irradiance": None if sun is None else sun.irradiance.tolist(),
    }


def _check_file(choice: SkyChoice) -> None:
    path, where = choice.path, f"--sky {choice.sky[:_MAX_WORDS]}"
    if path is None or is_file(path):
        return
    if is_folder(path):
        raise InputError(
            "the sky is a folder", where=where, expected=FORMS, remedy="Name one file in it."
        )
    if choice.is_like_path:
        raise InputError("no such file", where=where, expected=FORMS, remedy="Check the path.")
    word = choice.sky.partition(":")[0].strip().lower()
    raise InputError(
        "the sky is neither a file nor a known form",
        where=where,
        expected=FORMS,
        remedy=f"Write {word} in lower case, without blanks."
        if word in ("sun", "time", "source")
        else None,
    )
