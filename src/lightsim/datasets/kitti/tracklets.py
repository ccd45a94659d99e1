"""Labelled boxes of KITTI: tracklet_labels.xml, in the frame of the scanner."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.datasets.kitti.velodyne import Revolution
from lightsim.datasets.kitti.xml import number_of, read_records, text_of
from lightsim.datasets.plausible import LIMITS
from lightsim.datasets.track import TimedBox, tracks_of
from lightsim.errors import InputError

KIND_BY_LABEL = {
    "Car": ActorKind.CAR,
    "Van": ActorKind.CAR,
    "Truck": ActorKind.TRUCK,
    "Pedestrian": ActorKind.PEDESTRIAN,
    "Person (sitting)": ActorKind.PEDESTRIAN,
    "Cyclist": ActorKind.BICYCLE,
    "Tram": ActorKind.RAIL_VEHICLE,
    "Misc": ActorKind.OTHER,
}
"""All labels of KITTI's tracklets."""
# boost_serialization / tracklets / item
_DEPTH = 2
# Time by which boxes may exceed the ego path, in seconds: half a revolution.
_HOLD_S = 0.1


def read_tracklets(
    path: Path,
    times_ns: Mapping[int, int],
    revolutions: Mapping[int, Revolution],
    ego: Trajectory,
    ego_from_velo: RigidTransform,
) -> tuple[tuple[ActorTrack, ...], list[str]]:
    """Return the tracks, and notes.

    Boxes were drawn around points that are not motion compensated: the time of a box is that at
    which the scanner faced its centre, and its pose is relative to the scanner at that time.

    Raises:
        InputError: the file is damaged, or a box is implausible.
    """
    boxes: list[TimedBox] = []
    n_left = 0
    items: list[Element] = []
    read_records(path, _DEPTH, lambda item: items.append(item) if item.tag == "item" else None)
    for number, item in enumerate(items):
        where = f"{path}, tracklet {number}"
        label = text_of(item, "objectType", where)[:60]
        size = np.array([number_of(item, side, where) for side in "lwh"])
        first = int(number_of(item, "first_frame", where))
        for k, pose in enumerate(item.findall("poses/item")):
            velo_from_actor = _velo_from_actor(pose, float(size[2]), f"{where}, pose {k}")
            time_ns = times_ns.get(first + k)
            if time_ns is not None:
                # Yaw about the scanner's z axis only: the two other angles are 0 in all files.
                centre = velo_from_actor.translation_m[None]
                time_ns += round(float(revolutions[first + k].offsets_s(centre)[0]) * 1e9)
            if time_ns is None or not ego.covers(time_ns, _HOLD_S):
                n_left += 1
                continue
            world_from_actor = ego.at(time_ns, _HOLD_S) @ ego_from_velo @ velo_from_actor
            boxes.append(TimedBox(time_ns, f"{number:04d}", label, size, world_from_actor))
    tracks, notes = tracks_of(boxes, KIND_BY_LABEL, path)
    left = [f"{n_left} boxes of frames without a time or a pose are not used"] if n_left else []
    return tracks, [*notes, *left]


def _velo_from_actor(pose: Element, height_m: float, where: str) -> RigidTransform:
    x, y, z, yaw = (number_of(pose, name, where) for name in ("tx", "ty", "tz", "rz"))
    centre = np.array([x, y, z + height_m / 2])  # Stored is the centre of the bottom.
    reach = LIMITS["box distance"]
    distance_m = float(np.linalg.norm(centre))
    reach.check(where, distance_m, f"{distance_m:.4g} m from the scanner")
    if abs(yaw) > 100.0:
        raise InputError(
            "the yaw of a box is out of range",
            where=where,
            got=f"{yaw:g} rad",
            expected="radians",
        )
    return RigidTransform.from_yaw("velo", "actor", yaw, centre)
