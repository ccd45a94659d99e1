"""Labelled boxes of KITTI-360: data_3d_bboxes, in the world frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import RigidTransform
from lightsim.datasets.kitti.text import nearest_rotations
from lightsim.datasets.kitti.xml import number_of, numbers_of, read_records, text_of
from lightsim.datasets.plausible import LIMITS
from lightsim.datasets.track import TimedBox, tracks_of
from lightsim.errors import InputError

KIND_BY_LABEL = {
    "car": ActorKind.CAR,
    "truck": ActorKind.TRUCK,
    "bus": ActorKind.BUS,
    "caravan": ActorKind.TRAILER,
    "trailer": ActorKind.TRAILER,
    "train": ActorKind.RAIL_VEHICLE,
    "motorcycle": ActorKind.MOTORCYCLE,
    "bicycle": ActorKind.BICYCLE,
    "rider": ActorKind.BICYCLE,
    "person": ActorKind.PEDESTRIAN,
    "pedestrian": ActorKind.PEDESTRIAN,
    "unknownVehicle": ActorKind.OTHER_VEHICLE,
}
"""Labels of traffic participants; other boxes are buildings, plants, poles and the like."""
# Number of labels that a message lists.
_SHOWN = 8


def read_boxes(path: Path, times_ns: Mapping[int, int]) -> tuple[tuple[ActorTrack, ...], list[str]]:
    """Return the tracks of traffic participants, and notes.

    A static actor has one box, for the frames start_frame to end_frame; a moving one has a box for
    each frame, which <timestamp> numbers.

    Args:
        times_ns: times of the frames with a pose.

    Raises:
        InputError: the file is damaged, or a box is implausible.
    """
    boxes: list[TimedBox] = []
    others: Counter[str] = Counter()
    left: Counter[str] = Counter()

    def use(record: Element) -> None:
        if record.find("transform") is None:
            return
        where = f"{path}, <{record.tag[:40]}>"
        label = text_of(record, "label", where)[:60]
        if label not in KIND_BY_LABEL:
            others[label] += 1
            return
        found = _boxes(record, label, times_ns, where)
        boxes.extend(found)
        if not found:
            left[label] += 1

    read_records(path, 1, use)
    tracks, notes = tracks_of(boxes, KIND_BY_LABEL, path)
    return tracks, [
        *notes,
        *([f"boxes that are no traffic participants: {_counted(others)}"] if others else []),
        *([f"boxes of frames without a pose are not used: {_counted(left)}"] if left else []),
    ]


def _counted(labels: Counter[str]) -> str:
    shown = ", ".join(f"{n} x '{label}'" for label, n in labels.most_common(_SHOWN))
    return shown + (", ..." if len(labels) > _SHOWN else "")


def _boxes(record: Element, label: str, times_ns: Mapping[int, int], where: str) -> list[TimedBox]:
    """Return the labels of a record: one for a moving actor, two for a static one, at the first
    and the last frame that has a pose."""
    first, last, frame = (
        int(number_of(record, name, where)) for name in ("start_frame", "end_frame", "timestamp")
    )
    is_static = frame < 0
    known = sorted(n for n in times_ns if first <= n <= last) if is_static else []
    numbers = dict.fromkeys((known[0], known[-1])) if known else dict.fromkeys((frame,))
    times = [times_ns[number] for number in numbers if number in times_ns]
    if not times:
        return []
    world_from_actor, size = _box(record, where)
    identity = "-".join(
        str(int(number_of(record, name, where))) for name in ("semanticId", "instanceId")
    )
    return [TimedBox(time, identity, label, size, world_from_actor) for time in times]


def _box(record: Element, where: str) -> tuple[RigidTransform, np.ndarray]:
    """Return `world_from_actor` and the size of a box, whose transform includes the scale."""
    transform = numbers_of(record.find("transform") or record, "data", where)
    vertices = numbers_of(record.find("vertices") or record, "data", where)
    if len(transform) != 16 or len(vertices) % 3:
        raise InputError(
            "a box has no transform or no vertices",
            where=where,
            got=f"{len(transform)} and {len(vertices)} numbers",
            expected="16 numbers, and 3 for each vertex",
        )
    matrix, corners = transform.reshape(4, 4), vertices.reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    size = (high - low) * scale
    centre = matrix[:3, :3] @ ((low + high) / 2) + matrix[:3, 3]
    most = LIMITS["coordinate"].most
    if not (size > 0).all() or not (np.abs(centre) < most).all():
        raise InputError(
            "a box has no volume, or is too far from the origin",
            where=where,
            got=f"size {size.tolist()} m, centre {centre.tolist()} m",
            expected=f"sides above 0, and a centre within {most:g} m",
        )
    rotation = nearest_rotations((matrix[:3, :3] / scale)[None], where)[0]
    return RigidTransform.from_rotation("world", "actor", rotation, centre), size
