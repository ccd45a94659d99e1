"""Target skies: parses the words of `--sky` and resolves them to a dome in scene units.

A sky is a file, a sun position, a time, or the estimated sky under which the log was recorded.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, UInt8

from lightsim.build.workspace import Workspace
from lightsim.core.camera import PinholeCamera
from lightsim.core.checks import check_number
from lightsim.core.dome import SkyDome
from lightsim.core.frames import RigidTransform
from lightsim.core.log import GeoReference
from lightsim.core.sky_choice import SkyChoice
from lightsim.core.solar import parse_utc
from lightsim.core.twin import SkyEstimate
from lightsim.errors import InputError
from lightsim.lighting.night import is_night_panorama
from lightsim.lighting.scenery import without_scenery
from lightsim.lighting.sky.clear_sky import clear_sky
from lightsim.lighting.target_sky import (
    dome_from_array,
    scale_to_source,
    towards_sun,
    with_edited_sun,
)
from lightsim.masks.sky import estimate_sky_matte
from lightsim.simulation.scene_luminance import SceneLuminance
from lightsim.simulation.target_sky import SkyFacts, TargetSky
from lightsim.store.artefact import hash_file
from lightsim.store.images import read_sky
from lightsim.store.reading import is_file, is_folder

_LOGGER = logging.getLogger(__name__)
FORMS = (
    "a .hdr or .exr file (FILE.exr#LAYER selects a layer), sun:AZIMUTH,ELEVATION[,TURBIDITY],"
    " time:ISO (such as 2019-05-11T01:59:16Z) or source"
)
_LAYER = re.compile(r"(?P<path>.*\.(exr|hdr))#(?P<layer>.+)", re.DOTALL | re.IGNORECASE)
_SUFFIX = re.compile(r"\.[a-z]\w{1,4}$", re.IGNORECASE)
# Folder and name of the estimated sky in a work folder.
_ESTIMATED_SKY_PATH = ("sky", "source.exr")
# Number of rows of a clear sky without a log: pixels of 0.7 degrees. With a log, that of its sky.
SKY_HEIGHT_PX = 256
# Turbidity of clear skies where none is given: an ordinary clear day.
_DEFAULT_TURBIDITY = 3.0
# Smallest --sky-scale; its inverse is the largest. Skies are stored in units from cd/m2 to
# arbitrary ones: nine orders of magnitude include them all.
_MIN_SCALE = 1e-9
# Maximum number of characters of --sky in an error message, for readability.
_MAX_QUOTED = 200
# Version of `read_sky` in the key of frames: increased when it returns another dome.
_READER_VERSION = 2
# Smaller rotations, in degrees, are skipped: they only blur a dome whose columns are 0.7 degrees
# wide. The north of a synthetic log is estimated to 0.003 degrees (the shipped street), so its true
# skies stay unchanged.
_SAME_NORTH_DEG = 0.02


@dataclass(frozen=True)
class SkyRequest:
    """A `SkyChoice` after parsing; of `path`, `sun` and `time_ns` at most one is given, and none
    for the source sky.

    Args:
        choice: the words.
        path: sky file; a leading ~ is expanded.
        layer: layer of an OpenEXR file; empty for the whole picture.
        sun: azimuth from true north and elevation, degrees, and turbidity of a clear sky.
        time_ns: UTC time of a clear sky, nanoseconds.
        scale: scaling mode or factor.
        moved_sun: azimuth from true north and elevation to which the sun is moved, degrees.
    """

    choice: SkyChoice
    path: Path | None
    layer: str
    sun: tuple[float, float, float] | None
    time_ns: int | None
    scale: Literal["auto", "none"] | float
    moved_sun: tuple[float, float] | None

    @property
    def name(self) -> str:
        """Folder name: stem and layer of the file, or the text of the option, in characters that
        all file systems accept. The name of an estimated sky begins with its work folder's name."""
        words = self.choice.sky if self.path is None else f"{self.path.stem}_{self.layer}"
        # All builds give the estimated sky the same file name, which therefore identifies no sky.
        if self.path is not None and self.path.parts[-2:] == _ESTIMATED_SKY_PATH:
            words = f"{self.path.absolute().parts[-3]}_{words}"
        return re.sub(r"[^\w.+-]+", "_", words).strip("._-") or "sky"

    def require_file(self) -> None:
        """Raise an InputError that lists the known forms if a sky file does not exist."""
        if self.path is None or is_file(self.path):
            return
        words = self.choice.sky
        where = f"--sky {words[:_MAX_QUOTED]}"
        if is_folder(self.path):
            raise InputError(
                "the sky is a folder", where=where, expected=FORMS, remedy="Name one file in it."
            )
        spelling = words.removesuffix(f"#{self.layer}")
        # Text that resembles a path is reported as a wrong path, not as a misspelt form.
        if "/" in spelling or spelling.startswith("~") or _SUFFIX.search(spelling):
            raise InputError("no such file", where=where, expected=FORMS, remedy="Check the path.")
        word = words.partition(":")[0].strip().lower()
        raise InputError(
            "the sky is neither a file nor a known form",
            where=where,
            expected=FORMS,
            remedy=f"Write {word} in lower case, without blanks."
            if word in ("sun", "time", "source")
            else None,
        )


def parse_sky(choice: SkyChoice) -> SkyRequest:
    """Parse the words of a sky, without reading files.

    Raises:
        InputError: a number, time or scale is malformed or out of range.
    """
    if not choice.sky.strip():
        raise InputError("no sky is named", where="--sky", got=repr(choice.sky), expected=FORMS)
    path, layer, sun, time_ns = None, "", None, None
    if choice.sky.startswith("sun:"):
        numbers = _sun_numbers(choice.sky.removeprefix("sun:"), choice.sky, FORMS, (2, 3))
        sun = (numbers[0], numbers[1], (*numbers, _DEFAULT_TURBIDITY)[2])
    elif choice.sky.startswith("time:"):
        time_ns = parse_time(choice.sky)
    elif choice.sky != "source":
        file = choice.sky
        match = _LAYER.fullmatch(file)
        # A file that exists is taken by its whole name, "#" included.
        if match is not None and not os.path.isfile(os.path.expanduser(file)):
            file, layer = match["path"], match["layer"]
        path = Path(os.path.expanduser(file))
    moved = None
    if choice.move_sun:
        numbers = _sun_numbers(choice.move_sun, "--move-sun", "AZIMUTH,ELEVATION in degrees", (2,))
        moved = (numbers[0], numbers[1])
    return SkyRequest(choice, path, layer, sun, time_ns, _parse_scale(choice.scale), moved)


def _parse_scale(text: str) -> Literal["auto", "none"] | float:
    if text == "auto" or text == "none":
        return text
    try:
        factor = float(text)
    except ValueError as error:
        raise InputError(
            "the sky scale is not valid",
            where="--sky-scale",
            got=text,
            expected="auto, none or a number",
        ) from error
    check_number("--sky-scale", factor, _MIN_SCALE, 1.0 / _MIN_SCALE)
    return factor


def _sun_numbers(text: str, where: str, expected: str, counts: Sequence[int]) -> tuple[float, ...]:
    """Return the numbers of "AZIMUTH,ELEVATION[,...]", degrees, azimuth in [0, 360)."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in counts or not np.isfinite(numbers).all():
        raise InputError("the sun cannot be read", where=where, got=text, expected=expected)
    if not 0 < numbers[1] <= 90:
        raise InputError(
            "the sun's elevation is out of range",
            where=where,
            got=numbers[1],
            expected="above 0 and at most 90 degrees",
            remedy="Night and twilight are not modelled; give an HDR file for them.",
        )
    return (numbers[0] % 360.0, *numbers[1:])


def parse_time(spec: str) -> int:
    """Return the UTC nanoseconds of time:ISO; a time without an offset is UTC.

    Raises:
        InputError: it is not an ISO 8601 time of the years 1900 to 2199.
    """
    return parse_utc(spec.removeprefix("time:"), spec, FORMS)


def made_from_sky(choice: SkyChoice) -> dict[str, Any]:
    """Return the part of an artefact key that determines the sky's light; a file is identified by
    its content, not by its path.

    Raises:
        InputError: the words are neither a file nor a known form.
    """
    request = parse_sky(choice)
    request.require_file()
    if request.path is None:
        return asdict(choice)
    key = {"sky": hash_file(request.path), "reader": _READER_VERSION}
    return {**asdict(choice), **key} | ({"layer": request.layer} if request.layer else {})


def resolve_sky(
    choice: SkyChoice, workspace: Workspace, log_light: SceneLuminance | None = None
) -> TargetSky:
    """Return the target sky for the log of a workspace, in frame `world`.

    The order is: rotation of a file to the log's north, the user's rotation, scaling, then the
    edit of the sun, so that the rest of the sky is as bright as without the edit.

    Args:
        log_light: light of the workspace's log, reused by several skies.

    Raises:
        InputError: the words or the file are wrong, the sun is below the horizon, or the sky has no
            sun to edit.
    """
    request, geo, source = parse_sky(choice), workspace.log.geo, workspace.sky
    dome, facts = _unscaled(request, geo, source)
    if request.path is not None:
        dome, facts = _turned_to_north(dome, facts, geo)
    if choice.yaw_deg:
        dome = dome.rotated(-choice.yaw_deg)
    measure = (log_light or SceneLuminance(workspace)).mean_luminance
    # The factor is determined before the sun is edited, so that an edit leaves the sky unchanged.
    dome, factor = scale_to_source(dome, source.dome, request.scale, measure)
    facts = replace(facts, yaw_deg=choice.yaw_deg, scale=choice.scale, scale_factor=factor)
    if request.path is not None and request.scale == "auto":
        facts = facts.noted(_note_scale(dome, request.path, factor))
    if choice.has_edited_sun:
        dome, facts = _with_edited_sun(dome, facts, request, geo)
    # Only files can contain scenery; clear skies and the source sky do not.
    behind = None
    if request.path is not None:
        behind, hidden = without_scenery(dome, picture_matte)
        facts = replace(facts, scenery_fraction=hidden)
    # Frames under the unchanged source sky are the recorded pictures and need no relighting.
    is_unchanged = not choice.yaw_deg and not choice.has_edited_sun and factor == 1.0
    is_source = choice.sky == "source" and is_unchanged
    return TargetSky(dome, facts, request.name, behind, is_source)


def sky_without_log(choice: SkyChoice) -> TargetSky:
    """Return a sky without a log: world axes are east, north, up; the radiance is not scaled, and
    notes are not logged."""
    request = parse_sky(choice)
    return TargetSky(*_unscaled(request, None, None), request.name)


def _unscaled(
    request: SkyRequest, geo: GeoReference | None, source: SkyEstimate | None
) -> tuple[SkyDome, SkyFacts]:
    """Return the dome of a file, of a sun position or time, or of the source, before any change."""
    facts = SkyFacts(request.choice.sky, request.path)
    if request.path is not None:
        request.require_file()
        file = read_sky(request.path, request.layer, is_logged=source is not None)
        facts = replace(facts, notes=file.notes, file_heading_deg=file.heading_deg)
        return dome_from_array(file.radiance, str(request.path)), facts
    sun = clear_sun(request, geo)
    if sun is None:
        return _source_sky(source, facts)
    azimuth_deg, elevation_deg, turbidity = sun
    direction, assumed = towards_sun(azimuth_deg, elevation_deg, geo)
    # A clear sky has the resolution of the source sky, so that both are sampled alike.
    height_px = SKY_HEIGHT_PX if source is None else source.dome.height_px
    name = f"clear sky, sun at {azimuth_deg:.1f}, {elevation_deg:.1f}, turbidity {turbidity:g}"
    facts = replace(
        facts,
        description=name,
        utc_ns=request.time_ns,
        assumed=assumed,
        azimuth_deg=azimuth_deg,
        elevation_deg=elevation_deg,
        turbidity=turbidity,
    )
    return clear_sky(direction, turbidity, height_px=height_px), facts


def clear_sun(request: SkyRequest, geo: GeoReference | None) -> tuple[float, float, float] | None:
    """Return azimuth and elevation of the sun, degrees, and turbidity of a clear sky; None for a
    file and for the source sky.

    Raises:
        InputError: the log has no place for a time, or the sun is below the horizon then.
    """
    if request.sun is not None or request.time_ns is None:
        return request.sun
    return (*_sun_at(request, geo), _DEFAULT_TURBIDITY)


def _source_sky(source: SkyEstimate | None, facts: SkyFacts) -> tuple[SkyDome, SkyFacts]:
    if source is None:
        raise InputError(
            "no twin with an estimated sky is given",
            where="source",
            expected="sun:AZIMUTH,ELEVATION[,TURBIDITY] or an HDR file",
        )
    return source.dome, replace(
        facts,
        description="the estimated source sky",
        azimuth_deg=source.sun_azimuth_deg,
        elevation_deg=source.sun_elevation_deg,
        origin=source.origin,
    )


def _sun_at(request: SkyRequest, geo: GeoReference | None) -> tuple[float, float]:
    """Return azimuth and elevation, degrees, of the sun at the log's place and a `time:`."""
    assert request.time_ns is not None
    position = None if geo is None else geo.sun_at_utc(request.time_ns)
    if position is None:
        place = "the log has no geographic position" if geo is not None else "no log is given"
        build = ", or build with --place LATITUDE,LONGITUDE" if geo is not None else ""
        raise InputError(
            f"{place}, so the sun cannot be computed from a time",
            where=request.choice.sky,
            remedy=f"Use sun:AZIMUTH,ELEVATION instead{build}.",
        )
    if position.elevation_deg <= 0:
        raise InputError(
            "the sun is below the horizon then: twilight and night skies are not modelled",
            where=request.choice.sky,
            got=f"an elevation of {position.elevation_deg:.1f} degrees at the log's place",
            remedy="Choose another time (UTC without an offset), or give an HDR file.",
        )
    return position.azimuth_deg, position.elevation_deg


def _turned_to_north(
    dome: SkyDome, facts: SkyFacts, geo: GeoReference | None
) -> tuple[SkyDome, SkyFacts]:
    """Return a file's dome in the log's frame `world`, with a note; unchanged if the north of the
    file or of the log is unknown."""
    file_deg, log_deg = facts.file_heading_deg, None if geo is None else geo.heading_deg
    if file_deg is not None and log_deg is not None:
        # Angle from the log's +x to the file's +x, counter-clockwise when viewed from above. The
        # header stores 32 bits, so the log's heading is rounded alike.
        yaw_deg = (float(np.float32(log_deg)) - file_deg + 180.0) % 360.0 - 180.0
        if abs(yaw_deg) < _SAME_NORTH_DEG:
            return dome, facts
        note = f"turned by {yaw_deg:.2f} degrees to the log's north"
        return dome.rotated(yaw_deg), facts.noted(note)
    unknown = "the file" if file_deg is None else "the log"
    note = (
        f"{unknown} has no north: the sky's centre column is assumed to look along world +x;"
        " --sky-yaw-deg turns it"
    )
    _LOGGER.warning("%s: %s", facts.path, note)
    return dome, facts.noted(note)


def _note_scale(dome: SkyDome, path: Path, factor: float) -> str:
    """Log and return the factor of automatic scaling; a warning if the sky looks like night, which
    is then as bright as the recording."""
    note = (
        f"multiplied by {factor:.3g}, so that the street is as bright as recorded (--sky-scale"
        " auto); --sky-scale none keeps the file's own level, a number sets the factor"
    )
    is_night = is_night_panorama(dome)
    if is_night:
        note = f"looks like a night panorama; {note}"
    _LOGGER.log(logging.WARNING if is_night else logging.INFO, "%s: %s", path, note)
    return note


def _with_edited_sun(
    dome: SkyDome, facts: SkyFacts, request: SkyRequest, geo: GeoReference | None
) -> tuple[SkyDome, SkyFacts]:
    factor, direction = request.choice.sun_factor, None
    facts = replace(facts, sun_factor=factor)
    if request.moved_sun is not None:
        azimuth_deg, elevation_deg = request.moved_sun
        direction, assumed = towards_sun(azimuth_deg, elevation_deg, geo)
        facts = replace(facts, azimuth_deg=azimuth_deg, elevation_deg=elevation_deg)
        facts = replace(facts, assumed=assumed or facts.assumed)
    return with_edited_sun(dome, direction, factor), facts


def picture_matte(
    srgb8: UInt8[np.ndarray, "h w 3"], camera: PinholeCamera, pose: RigidTransform
) -> Float32[np.ndarray, "h w"]:
    """Return the sky fraction of each pixel of a picture, estimated without LiDAR."""
    return estimate_sky_matte(srgb8, camera, pose, np.zeros((0, 3)), None).expected
