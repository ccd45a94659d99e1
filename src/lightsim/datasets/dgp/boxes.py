"""Labelled boxes of DGP scenes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.datasets.dgp.scene import Datum, Scene, file_inside, read_pose
from lightsim.datasets.files import read_json, require_list, require_numbers, require_object
from lightsim.datasets.layout import has_file
from lightsim.datasets.plausible import LIMITS
from lightsim.datasets.track import TimedBox, tracks_of
from lightsim.errors import InputError

# Type of annotation (dgp/proto/annotations.proto: BOUNDING_BOX_3D).
_BOXES = "1"
KIND_BY_LABEL = {
    # DDAD and TRI's own scenes.
    "Car": ActorKind.CAR,
    "Truck": ActorKind.TRUCK,
    "Bus/RV/Caravan": ActorKind.BUS,
    "Train": ActorKind.RAIL_VEHICLE,
    "Trailer": ActorKind.TRAILER,
    "Towed Object": ActorKind.TRAILER,
    "Motorcycle": ActorKind.MOTORCYCLE,
    "Bicycle": ActorKind.BICYCLE,
    "Wheeled Slow": ActorKind.PERSONAL_MOBILITY,
    "Person": ActorKind.PEDESTRIAN,
    # Synthetic scenes of Parallel Domain in the same format.
    "Pedestrian": ActorKind.PEDESTRIAN,
    "Bus": ActorKind.BUS,
    "SchoolBus": ActorKind.BUS,
    "Caravan/RV": ActorKind.OTHER_VEHICLE,
    "ConstructionVehicle": ActorKind.CONSTRUCTION_VEHICLE,
    "TowedObject": ActorKind.TRAILER,
    "Animal": ActorKind.ANIMAL,
}
"""Kind of each class name of the ontologies."""


def box_path(scene: Scene, datum: Datum) -> Path | None:
    """Return the file with the boxes of a cloud; None if the cloud has no labels."""
    annotations = require_object(datum.body.get("annotations", {}), f"{datum.where}, annotations")
    if _BOXES not in annotations:
        return None
    return file_inside(scene.folder, annotations[_BOXES], f"{datum.where}, annotations")


def ontology_path(scene: Scene) -> Path | None:
    """Return the file of the boxes' class names; None if the scene names none."""
    if _BOXES not in scene.ontologies:
        return None
    name = f"ontology/{scene.ontologies[_BOXES]}.json"
    return file_inside(scene.folder, name, f"{scene.path}, ontologies")


def read_actors(
    scene: Scene, clouds: tuple[Datum, ...]
) -> tuple[tuple[ActorTrack, ...], tuple[str, ...]]:
    """Return the tracks of all labelled actors, labelled at the times of the clouds, and notes.

    Raises:
        InputError: a file is broken, or a box is implausible.
    """
    notes: list[str] = []
    paths = {datum: path for datum in clouds if (path := box_path(scene, datum)) is not None}
    there = {datum: path for datum, path in paths.items() if has_file(path)}
    if len(there) < len(clouds) and paths:
        notes.append(f"no labelled boxes for {len(clouds) - len(there)} of {len(clouds)} clouds")
    if not there:
        return (), tuple(notes)
    path = ontology_path(scene)
    names = {} if path is None else _class_names(path)
    boxes = (box for datum, file in there.items() for box in _boxes(datum, file, names))
    tracks, track_notes = tracks_of(boxes, KIND_BY_LABEL, scene.path)
    return tracks, (*notes, *track_notes)


def _class_names(path: Path) -> dict[int, str]:
    items = require_list(require_object(read_json(path), path).get("items"), f"{path}, items")
    names: dict[int, str] = {}
    for i, item in enumerate(items):
        where = f"{path}, items[{i}]"
        number = int(require_numbers(item, ("id",), where)[0])
        name = item.get("name")
        if not isinstance(name, str) or not name.isprintable():
            raise InputError(
                "the class has no name", where=where, got=repr(name)[:60], expected="text"
            )
        names[number] = name[:80]
    return names


def _boxes(datum: Datum, path: Path, names: Mapping[int, str]) -> Iterator[TimedBox]:
    # A cloud without boxes has an empty list.
    entries = require_object(read_json(path), path).get("annotations")
    if entries == []:
        return
    for i, entry in enumerate(require_list(entries, f"{path}, annotations")):
        where = f"{path}, annotations[{i}]"
        number = int(require_numbers(entry, ("class_id",), where)[0])
        box = require_object(entry.get("box"), f"{where}, box")
        size = require_numbers(box, ("length", "width", "height"), where)
        # Boxes are in the frame of the cloud at its own time.
        sensor_from_actor = read_pose(box.get("pose"), "sensor", "actor", where)
        away_m = float(np.linalg.norm(sensor_from_actor.translation_m))
        LIMITS["box distance"].check(where, away_m, f"{away_m:.4g} m from the LiDAR")
        pose = datum.world_from_sensor @ sensor_from_actor
        label = names.get(number, f"class {number}")
        yield TimedBox(datum.time_ns, _actor_id(entry, where), label, size, pose)


def _actor_id(entry: Mapping[str, Any], where: str) -> str:
    """Return the id of a box's actor: a whole number, which JSON has as text above 32 bits."""
    value = entry.get("instance_id")
    is_number = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**64
    is_text = isinstance(value, str) and 0 < len(value) <= 80 and value.isprintable()
    if not is_number and not is_text:
        raise InputError(
            "the box has no instance_id",
            where=where,
            got=repr(value)[:60],
            expected="a whole number or text",
        )
    return str(value)
