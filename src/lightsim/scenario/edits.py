"""SCENARIO.json: edits of a log, read and checked before anything is loaded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.core.sky_choice import SkyChoice
from lightsim.errors import ArtefactError, InputError
from lightsim.store.artefact import read_json
from lightsim.store.entries import Entries

VERSION = 1  # Version of the format, docs/reference/scenario-json.md.
EVERY_ACTOR = ("all-moving", "all")
_REMEDY = "Correct the scenario; docs/reference/scenario-json.md has the format."
_FORMAT = ("version", "name", "sky", "edits")
# Further entries of written scenario.json files, which are accepted as input again.
_WRITTEN = (
    "sky_yaw_deg", "sky_scale", "move_sun", "sun_factor", "seed", "target_sky", "options",
    "profile", "notes", "cameras", "ego", "actors", "frames",
)  # fmt: skip
_POSE = ("x_m", "y_m", "z_m", "yaw_deg")
FARTHEST_M = 1e5
"""Largest coordinate of a waypoint, in metres: world coordinates are local to the log."""


@dataclass(frozen=True, kw_only=True)
class Waypoint:
    """Pose of an actor, or of the ego vehicle, at a time.

    Args:
        time_s: seconds from the first picture of the log.
        x_m, y_m: centre of the box (ego: origin of its frame), frame `world`.
        z_m: underside of the box (ego: origin of its frame); None: on the ground.
        yaw_deg: heading from world +x, counter-clockwise from above; None: along the path.
    """

    time_s: float = 0.0
    x_m: float
    y_m: float
    z_m: float | None = None
    yaw_deg: float | None = None


Path3 = tuple[Waypoint, ...]
"""One waypoint: a standing actor for the whole log; several: a drive from the first time to the
last."""


@dataclass(frozen=True)
class Remove:
    """Remove an actor of the log; or "all-moving", "all"."""

    where: str
    actor: str


@dataclass(frozen=True)
class Move:
    """Move an actor of the log: along waypoints, or its own track shifted by (ahead, left, up) in
    its own axes."""

    where: str
    actor: str
    waypoints: Path3 = ()
    offset_m: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Insert:
    """Insert an asset as a new actor."""

    where: str
    asset: str
    actor_id: str
    waypoints: Path3


@dataclass(frozen=True)
class Ego:
    """Move the ego vehicle; see `Move`."""

    where: str
    waypoints: Path3 = ()
    offset_m: tuple[float, float, float] | None = None


Edit = Remove | Move | Insert | Ego


@dataclass(frozen=True)
class ScenarioRequest:
    """Content of SCENARIO.json.

    Args:
        name: name of the result.
        sky: the chosen sky; for a written scenario with all of its settings.
        edits: edits in the order of application.
        spelt: the edits as JSON values of the file.
        source: the file; for error messages, and to find assets beside it.
    """

    name: str
    sky: SkyChoice
    edits: tuple[Edit, ...]
    spelt: tuple[Mapping[str, Any], ...]
    source: Path


def read_scenario_request(path: Path) -> ScenarioRequest:
    """Read a scenario from a file.

    Raises:
        InputError: the file is missing or broken, of another version, or an entry is unknown,
            missing, of another type or out of range; the message names file and edit.
    """
    try:
        value = read_json(path)
    except ArtefactError as error:
        raise InputError(error.what, where=path, got=error.got, remedy=_REMEDY) from error
    return parse_scenario(value, path)


def parse_scenario(value: Any, source: Path) -> ScenarioRequest:
    """Read a scenario from parsed JSON; raises as `read_scenario_request`."""
    file = Entries(value, source, InputError, _REMEDY)
    file.allow((*_FORMAT, *_WRITTEN))
    version = file.number("version")
    if version != VERSION:
        raise InputError(
            "the scenario has another version", where=source, got=f"{version:g}", expected=VERSION
        )
    edits = file.objects("edits")
    return ScenarioRequest(
        file.text("name") if "name" in file else source.stem,
        _sky(file),
        tuple(_edit(entry, number) for number, entry in enumerate(edits, start=1)),
        tuple(entry.mapping() for entry in edits),
        source,
    )


def _sky(file: Entries) -> SkyChoice:
    """Return the chosen sky; by default the source sky."""
    if "sky" not in file or file.is_null("sky"):
        return SkyChoice("source")
    return SkyChoice(
        file.text("sky"),
        file.number("sky_yaw_deg") if "sky_yaw_deg" in file else 0.0,
        file.text("sky_scale") if "sky_scale" in file else "auto",
        file.text("move_sun") if "move_sun" in file else "",
        file.number("sun_factor") if "sun_factor" in file else 1.0,
    )


def _edit(entry: Entries, number: int) -> Edit:
    do = entry.word("do", ("remove", "move", "insert", "ego"))
    where = f"{entry.where} (edit {number}, {do})"
    if do == "remove":
        entry.allow(("do", "actor"))
        return Remove(where, entry.text("actor"))
    if do == "move":
        entry.allow(("do", "actor", "trajectory", "at", "offset_m"))
        _require_one_of(entry, where, ("trajectory", "at", "offset_m"))
        return Move(where, entry.text("actor"), _waypoints(entry), _offset(entry))
    if do == "insert":
        entry.allow(("do", "asset", "id", "trajectory", "at"))
        _require_one_of(entry, where, ("trajectory", "at"))
        name = entry.text("id") if "id" in entry else f"inserted-{number}"
        return Insert(where, entry.text("asset"), name, _waypoints(entry))
    entry.allow(("do", "trajectory", "offset_m"))
    _require_one_of(entry, where, ("trajectory", "offset_m"))
    return Ego(where, _waypoints(entry), _offset(entry))


def _require_one_of(entry: Entries, where: str, keys: tuple[str, ...]) -> None:
    given = [key for key in keys if key in entry]
    if len(given) != 1:
        raise InputError(
            "the edit requires exactly one of its alternative entries",
            where=where,
            got=" and ".join(given) or "none",
            expected=f"one of {', '.join(keys)}",
            remedy=_REMEDY,
        )


def _offset(entry: Entries) -> tuple[float, float, float] | None:
    if "offset_m" not in entry:
        return None
    ahead, left, up = entry.numbers("offset_m", (3,)).tolist()
    _check_near(entry, ahead, left, up)
    return ahead, left, up


def _waypoints(entry: Entries) -> Path3:
    if "at" in entry:
        place = entry.object("at")
        place.allow(_POSE)
        if "yaw_deg" not in place:
            raise InputError(
                "a stationary actor needs a heading",
                where=place.where,
                expected="'yaw_deg'",
                remedy=_REMEDY,
            )
        return (_waypoint(place, 0.0),)
    if "trajectory" not in entry:
        return ()
    poses = entry.objects("trajectory")
    if len(poses) < 2:
        raise InputError(
            "a trajectory needs two waypoints or more",
            where=f"{entry.where}, 'trajectory'",
            got=len(poses),
            remedy="Give 'at' for a stationary actor.",
        )
    for pose in poses:
        pose.allow(("time_s", *_POSE))
    waypoints = tuple(_waypoint(pose, pose.number("time_s")) for pose in poses)
    _check_path(entry, waypoints)
    return waypoints


def _waypoint(pose: Entries, time_s: float) -> Waypoint:
    x_m, y_m = pose.number("x_m"), pose.number("y_m")
    z_m = pose.number("z_m") if "z_m" in pose else None
    _check_near(pose, x_m, y_m, z_m or 0.0)
    yaw_deg = pose.number("yaw_deg") if "yaw_deg" in pose else None
    return Waypoint(time_s=time_s, x_m=x_m, y_m=y_m, z_m=z_m, yaw_deg=yaw_deg)


def _check_near(entry: Entries, *metres: float) -> None:
    if max(abs(m) for m in metres) > FARTHEST_M:
        raise InputError(
            "the position is out of range",
            where=entry.where,
            got=list(metres),
            expected=f"metres between -{FARTHEST_M:g} and {FARTHEST_M:g}",
        )


def _check_path(entry: Entries, waypoints: Path3) -> None:
    where = f"{entry.where}, 'trajectory'"
    times_s = np.array([w.time_s for w in waypoints])
    if (np.diff(times_s) <= 0).any():
        raise InputError(
            "the times of a trajectory must increase", where=where, got=times_s.tolist(),
            expected="each time once, in order",
        )  # fmt: skip
    for name in ("z_m", "yaw_deg"):
        given = [getattr(w, name) is not None for w in waypoints]
        if any(given) and not all(given):
            raise InputError(
                f"some waypoints have '{name}' and some do not", where=where,
                remedy="Give it for all, or for none.",
            )  # fmt: skip
    if waypoints[0].yaw_deg is None and len({(w.x_m, w.y_m) for w in waypoints}) == 1:
        raise InputError(
            "a path without motion has no direction", where=where, expected="'yaw_deg'"
        )
