"""Changes of the edits of SCENARIO.json: pure functions from edits to new edits.

An actor has at most one entry: a later change of the actor replaces its entry in place. Inserted
actors have their `id` in the entry, as `session.state_of` ensures.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.app.paths import moved_rigidly, place_of, sampled_path, with_heights
from lightsim.core.actors import ActorTrack
from lightsim.scenario.edits import VERSION, Insert, Move, Path3, Waypoint, parse_scenario

Edits = tuple[Mapping[str, Any], ...]
"""Entries of `edits` in SCENARIO.json, in the order of application."""
# Digits after the decimal point in written numbers: 0.1 mm, 0.1 ms, 0.0001 degrees.
_DIGITS = 4


def entry_of(edits: Edits, actor_id: str) -> Mapping[str, Any] | None:
    """Return the entry that determines an actor; None if it is as recorded."""
    return next((edit for edit in reversed(edits) if _is_of(edit, actor_id)), None)


def remove_actor(edits: Edits, actor_id: str) -> Edits:
    """Remove an actor: an actor of the log by an edit, an inserted one by deleting its entry."""
    if _insertion_of(edits, actor_id) is not None:
        return restore_actor(edits, actor_id)
    return _with_entry(edits, actor_id, {"do": "remove", "actor": actor_id})


def restore_actor(edits: Edits, actor_id: str) -> Edits:
    """Delete the entry of an actor: a recorded actor is as in the log, an inserted one absent."""
    return tuple(edit for edit in edits if not _is_of(edit, actor_id))


def insert_asset(
    edits: Edits, asset: str, place: Waypoint, taken: Collection[str]
) -> tuple[Edits, str]:
    """Insert a standing asset as a new actor.

    Args:
        asset: name of the asset, as SCENARIO.json spells it.
        place: its pose; the time has no meaning, the heading is 0 if it is None.
        taken: ids of all actors of the log, removed ones included.

    Returns:
        The new edits, and the id of the new actor: the name of the asset with a number.
    """
    used = {*taken, *(str(edit["id"]) for edit in edits if edit["do"] == "insert")}
    stem = re.sub(r"[^A-Za-z0-9_-]+", "-", Path(asset.rsplit("#", 1)[-1]).stem).strip("-")
    number = 1
    while (actor_id := f"{stem or 'actor'}-{number}") in used:
        number += 1
    entry = {"do": "insert", "asset": asset, "id": actor_id, **_path_entry((place,))}
    return (*edits, entry), actor_id


def set_path(edits: Edits, actor_id: str, path: Path3) -> Edits:
    """Give an actor a path: one waypoint is its pose for the whole log, several are followed.

    Args:
        path: waypoints in the order of their times, with headings for all or for none; for a
            single one, None is the heading 0.
    """
    inserted = _insertion_of(edits, actor_id)
    if inserted is None:
        start: dict[str, Any] = {"do": "move", "actor": actor_id}
    else:
        start = {"do": "insert", "asset": inserted["asset"], "id": actor_id}
    return _with_entry(edits, actor_id, start | _path_entry(path))


def path_of(edits: Edits, track: ActorTrack, span_ns: tuple[int, int]) -> Path3:
    """Return the waypoints of an actor from its entry in the edits. Without an entry, return its
    track sampled every 0.5 s, or one waypoint if it does not move.

    Args:
        track: the actor's track with these edits.
        span_ns: times of the first and the last picture of the log.
    """
    entry = entry_of(edits, track.actor_id)
    has_height = False
    if entry is not None:
        (edit,) = parse_scenario({"version": VERSION, "edits": [entry]}, Path("edits")).edits
        if isinstance(edit, Move | Insert) and edit.waypoints:
            return edit.waypoints
        # With a height in the offset the actor has that height, otherwise it stands on the ground.
        has_height = isinstance(edit, Move) and edit.offset_m is not None and edit.offset_m[2] != 0
    path = sampled_path(track, span_ns)
    return path if has_height else tuple(replace(waypoint, z_m=None) for waypoint in path)


def move_actor(
    edits: Edits, track: ActorTrack, span_ns: tuple[int, int], time_ns: int, place: Waypoint
) -> Edits:
    """Move and turn an actor so that it has a given pose at a time.

    A standing actor has that pose for the whole log. The path of a moving actor is transformed
    rigidly, by the same motion at all times.

    Args:
        track: the actor's track with these edits. During a drag, edits and track are those at its
            start.
        time_ns: the time.
        place: new pose with its heading. `z_m` is the height of the underside; None: the actor
            stands on the ground.
    """
    path = path_of(edits, track, span_ns)
    if len(path) == 1:
        return set_path(edits, track.actor_id, (place,))
    if place.z_m is not None and path[0].z_m is None:
        path = with_heights(path, track, span_ns[0])
    moved = moved_rigidly(path, place_of(track, time_ns), place)
    return set_path(edits, track.actor_id, moved)


def ego_offset(edits: Edits) -> tuple[float, float, float]:
    """Return the offset (ahead, left, up) of the ego vehicle from its path, in metres."""
    total = np.zeros(3)
    for edit in edits:
        if edit["do"] == "ego":
            # A path replaces the offsets before it.
            total = total + edit["offset_m"] if "offset_m" in edit else np.zeros(3)
    ahead, left, up = (float(metres) for metres in total)
    return ahead, left, up


def set_ego_offset(edits: Edits, offset_m: tuple[float, float, float]) -> Edits:
    """Set the offset (ahead, left, up) of the ego vehicle, in metres; zero drops the entry.

    A path of the ego vehicle in the edits is unchanged; the offset applies after it.
    """
    kept = tuple(edit for edit in edits if edit["do"] != "ego" or "offset_m" not in edit)
    rounded = [_rounded(metres) for metres in offset_m]
    return (*kept, {"do": "ego", "offset_m": rounded}) if any(rounded) else kept


def _is_of(edit: Mapping[str, Any], actor_id: str) -> bool:
    """Return whether an entry is one of an actor."""
    if edit["do"] == "ego":
        return False
    return edit["id" if edit["do"] == "insert" else "actor"] == actor_id


def _insertion_of(edits: Edits, actor_id: str) -> Mapping[str, Any] | None:
    found = (edit for edit in edits if edit["do"] == "insert" and edit["id"] == actor_id)
    return next(found, None)


def _with_entry(edits: Edits, actor_id: str, entry: Mapping[str, Any]) -> Edits:
    """Replace the entries of an actor by one, at the place of the first; else append it."""
    places = [number for number, edit in enumerate(edits) if _is_of(edit, actor_id)]
    if not places:
        return (*edits, entry)
    first = places[0]
    return (*edits[:first], entry, *restore_actor(edits[first:], actor_id))


def _path_entry(path: Path3) -> dict[str, Any]:
    """Return the entry `at` of one waypoint, `trajectory` of several."""
    if len(path) == 1:
        return {"at": {**_pose_entry(path[0]), "yaw_deg": _rounded(path[0].yaw_deg or 0.0)}}
    waypoints = ({"time_s": _rounded(w.time_s), **_pose_entry(w)} for w in path)
    return {"trajectory": list(waypoints)}


def _pose_entry(waypoint: Waypoint) -> dict[str, float]:
    names = ("x_m", "y_m", "z_m", "yaw_deg")
    values = {name: getattr(waypoint, name) for name in names}
    return {name: _rounded(value) for name, value in values.items() if value is not None}


def _rounded(value: float) -> float:
    # Adding zero turns -0.0 into 0.0.
    return round(float(value), _DIGITS) + 0.0
