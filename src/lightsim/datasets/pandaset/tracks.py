"""PandaSet's cuboids as actor tracks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.datasets.axes import box_axis_notes
from lightsim.datasets.columns import number_column, truth_column, whole_column
from lightsim.datasets.files import MAX_NUMBER
from lightsim.datasets.pandaset.rig import EGO_BELOW_LIDAR_M
from lightsim.datasets.pandaset.sweeps import ScanTiming
from lightsim.datasets.plausible import LIMITS, odd_track_notes
from lightsim.datasets.safe_pickle import Table, read_table
from lightsim.datasets.track import unknown_label_notes
from lightsim.errors import InputError

_POSITION = ("position.x", "position.y", "position.z")
_DIMENSIONS = ("dimensions.x", "dimensions.y", "dimensions.z")
_COLUMNS = ("uuid", "label", "yaw", *_POSITION, *_DIMENSIONS)
# Ids of the sensor of a box.
_BOTH = -1  # One box for both LiDARs.
_ROOF = 0  # Pandar64
_FRONT = 1  # PandarGT
_SENSORS = "-1 (one box for both LiDARs), 0 (Pandar64) or 1 (PandarGT)"
KIND_BY_LABEL = {
    "Car": ActorKind.CAR,
    "Pickup Truck": ActorKind.PICKUP,
    "Medium-sized Truck": ActorKind.TRUCK,
    "Semi-truck": ActorKind.TRUCK,
    "Towed Object": ActorKind.TRAILER,
    "Motorcycle": ActorKind.MOTORCYCLE,
    "Other Vehicle - Construction Vehicle": ActorKind.CONSTRUCTION_VEHICLE,
    "Other Vehicle - Uncommon": ActorKind.OTHER_VEHICLE,
    "Other Vehicle - Pedicab": ActorKind.OTHER_VEHICLE,
    "Emergency Vehicle": ActorKind.OTHER_VEHICLE,
    "Bus": ActorKind.BUS,
    "Personal Mobility Device": ActorKind.PERSONAL_MOBILITY,
    "Motorized Scooter": ActorKind.SCOOTER,
    "Bicycle": ActorKind.BICYCLE,
    "Train": ActorKind.RAIL_VEHICLE,
    "Trolley": ActorKind.RAIL_VEHICLE,
    "Tram / Subway": ActorKind.RAIL_VEHICLE,
    "Pedestrian": ActorKind.PEDESTRIAN,
    "Pedestrian with Object": ActorKind.PEDESTRIAN,
    "Animals - Bird": ActorKind.ANIMAL,
    "Animals - Other": ActorKind.ANIMAL,
    "Pylons": ActorKind.CONE,
    "Road Barriers": ActorKind.BARRIER,
    "Signs": ActorKind.SIGN,
    "Cones": ActorKind.CONE,
    "Construction Signs": ActorKind.SIGN,
    "Temporary Construction Barriers": ActorKind.BARRIER,
    "Rolling Containers": ActorKind.ROLLING_CONTAINER,
}
"""All cuboid labels of PandaSet; the classes of its LiDAR returns have the same names."""
MAX_ID_CHARACTERS = 512
"""Longest accepted id. Ids are uuids of 36 characters; longer text belongs to another column."""
# Largest yaw: two turns. PandaSet's are within one half; degrees exceed it.
_MAX_YAW_RAD = 4 * np.pi
# Two labels of an actor closer in time than this are duplicates, in seconds.
_MIN_GAP_S = 0.02
# Displacement from which an actor counts as moving, whatever its label, in metres.
_MOVED_M = 0.5
# Displacement from which an actor labelled as moving counts as moving, in metres; smaller ones are
# jitter of the labels.
_LABELLED_MOVED_M = 0.2


@dataclass(frozen=True)
class CuboidFile:
    """Label file of one sweep, with the time of the sweep and the ego pose at that time."""

    path: Path
    time_ns: int
    world_from_ego: RigidTransform


@dataclass(frozen=True)
class _Box:
    time_ns: int
    uuid: str
    sibling: str
    sensor: int
    label: str
    centre_world: Float64[np.ndarray, "3"]
    yaw_rad: float
    size_wlh_m: Float64[np.ndarray, "3"]
    is_labelled_moving: bool


def read_tracks(
    files: Sequence[CuboidFile], timing: ScanTiming
) -> tuple[tuple[ActorTrack, ...], tuple[str, ...]]:
    """Return one track for each actor, longest first, and notes on unusual ones and on unknown
    labels, whose actors get the kind OTHER.

    PandaSet labels an actor in the overlap of its two LiDARs twice, as siblings. They are merged:
    in each sweep the box of the Pandar64 is used if there is one, else that of the PandarGT. The
    time of a box is that at which the Pandar64 scans the actor, up to 0.1 s before the time of the
    sweep. A box of the PandarGT alone is timed in the same way; sequence 002 has none.

    Raises:
        InputError: a file is damaged, lacks a column, or holds a box without an id, place or
            size, or with implausible values (plausible.py).
    """
    boxes: list[list[_Box]] = [_read_boxes(file, timing) for file in files]
    owner = _owners(boxes)
    n_repeated = sum(len(sweep) - len({(b.uuid, b.sensor) for b in sweep}) for sweep in boxes)
    by_actor: dict[str, list[list[_Box]]] = {}
    for sweep in boxes:
        found: dict[str, list[_Box]] = {}
        for box in sweep:
            found.setdefault(owner[box.uuid], []).append(box)
        for actor, candidates in found.items():
            by_actor.setdefault(actor, []).append(candidates)
    tracks = [_track(sweeps) for sweeps in by_actor.values()]
    tracks.sort(key=lambda t: (-len(t.trajectory), t.actor_id))
    repeated = f"{n_repeated} boxes repeat an actor of the same sweep: the first of each is used"
    notes = (repeated,) if n_repeated else ()
    subject = "actors with labels that are not PandaSet's"
    unknown = unknown_label_notes(tracks, KIND_BY_LABEL, subject)
    return tuple(tracks), (*notes, *unknown, *odd_track_notes(tracks), *box_axis_notes(tracks))


def label_of(track: ActorTrack) -> str:
    """Return the PandaSet label of an actor: its own if valid, else one of its kind, preferably
    with the name of the kind."""
    if track.label in KIND_BY_LABEL:
        return track.label
    words = [word for word, kind in KIND_BY_LABEL.items() if kind == track.kind]
    named = [word for word in words if track.kind in word.lower()]
    return next(iter((*named, *words)), track.label)


def _read_boxes(file: CuboidFile, timing: ScanTiming) -> list[_Box]:
    table = read_table(file.path, _COLUMNS)
    n = len(table["uuid"])
    if n == 0:
        return []
    ids = _ids(table, file.path)
    centres, yaw, sizes = _checked_numbers(table, file.path)
    sensors = _sensors(table, file.path)
    ego_from_world = file.world_from_ego.inverse()
    _check_places(file, ids, centres, yaw, sizes)
    offsets_s = timing.offsets_s(ego_from_world.apply(centres))
    is_moving = _labelled_moving(table, file.path)
    siblings = table.get("cuboids.sibling_id", np.array(ids, dtype=object))
    return [
        _Box(
            file.time_ns + int(offsets_s[i] * 1e9),
            ids[i],
            id_text(siblings[i]),
            int(sensors[i]),
            str(table["label"][i]),
            centres[i],
            float(yaw[i]),
            sizes[i],
            bool(is_moving[i]),
        )
        for i in range(n)
    ]


def id_text(value: object) -> str:
    """Return an id as text; integers that a merge turned into floats have no decimal point."""
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)


def _ids(table: Table, path: Path) -> list[str]:
    """Return the ids of actors: text, or integers as text."""
    ids: list[str] = []
    for i, value in enumerate(table["uuid"].tolist()):
        text = id_text(value)
        is_kind = isinstance(value, (str, int, float)) and not isinstance(value, bool)
        is_kind &= not isinstance(value, float) or value.is_integer()
        if not is_kind or not 0 < len(text) <= MAX_ID_CHARACTERS or not text.isprintable():
            raise InputError(
                "an actor's id is not text",
                where=f"{path}, row {i}",
                got=f"{type(value).__name__} {text!r:.60}",
                expected=f"1 to {MAX_ID_CHARACTERS} printable characters, or a whole number",
            )
        ids.append(text)
    return ids


def _check_places(
    file: CuboidFile,
    ids: Sequence[str],
    centres: Float64[np.ndarray, "n 3"],
    yaw: Float64[np.ndarray, " n"],
    sizes_wlh: Float64[np.ndarray, "n 3"],
) -> None:
    """Reject boxes of implausible size or distance; the ego vehicle's own box is checked, too."""
    lidar_world = file.world_from_ego.apply(np.array([[0.0, 0.0, EGO_BELOW_LIDAR_M]]))[0]
    away = lidar_world - centres
    c, s = np.cos(yaw), np.sin(yaw)
    # The LiDAR in the axes of each box: rotation by the negative yaw.
    x, y = c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]
    holds_lidar = (np.abs(np.stack([x, y, away[:, 2]], axis=1)) < sizes_wlh / 2).all(axis=1)
    distances_m = np.linalg.norm(away, axis=1)
    size, reach = LIMITS["box"], LIMITS["box distance"]
    for is_bad, what, expected in (
        ((sizes_wlh >= size.most).any(axis=1), size.what, f"below {size.most:g} m"),
        (distances_m > reach.most, reach.what, f"within {reach.most:g} m"),
        (holds_lidar, "a box contains the recording LiDAR", "boxes of other road users"),
    ):
        if is_bad.any():
            i = int(np.flatnonzero(is_bad)[0])
            raise InputError(
                what,
                where=f"{file.path}, row {i} (uuid {ids[i][:60]})",
                got=f"size {sizes_wlh[i].tolist()} m, {distances_m[i]:.4g} m from the LiDAR",
                expected=expected,
                remedy="Sizes and positions are in metres, positions in the log's world frame.",
            )


def _checked_numbers(
    table: Table, path: Path
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    table = {k: number_column(table, k, path) for k in ("yaw", *_POSITION, *_DIMENSIONS)} | {
        "uuid": table["uuid"]
    }
    centres = np.stack([table[name] for name in _POSITION], axis=1).astype(np.float64)
    sizes = np.stack([table[name] for name in _DIMENSIONS], axis=1).astype(np.float64)
    yaw = table["yaw"].astype(np.float64)
    numbers = np.column_stack([centres, yaw, sizes])
    # NaN fails the comparisons and is bad.
    is_bad = ~(np.abs(numbers) <= MAX_NUMBER).all(axis=1) | ~(sizes > 0).all(axis=1)
    if is_bad.any():
        i = int(np.flatnonzero(is_bad)[0])
        raise InputError(
            "a box has a position that is not finite, or a size that is not positive",
            where=f"{path}, row {i} (uuid {table['uuid'][i]})",
            got=f"centre {centres[i].tolist()}, yaw {yaw[i]}, size {sizes[i].tolist()}",
            remedy="Remove the row, or copy the file again from the original data set.",
        )
    if n_turned := int((np.abs(yaw) > _MAX_YAW_RAD).sum()):
        raise InputError(
            "the yaw of a box is out of range",
            where=path,
            got=f"{np.abs(yaw).max():g}, and {n_turned} of {len(yaw)} above {_MAX_YAW_RAD:.1f}",
            expected="radians",
        )
    return centres, yaw, sizes


def _sensors(table: Table, path: Path) -> np.ndarray:
    if "cuboids.sensor_id" not in table:
        return np.full(len(table["uuid"]), _BOTH)
    return whole_column(table, "cuboids.sensor_id", path, _BOTH, _FRONT, _SENSORS)


def _labelled_moving(table: Table, path: Path) -> np.ndarray:
    is_moving = np.zeros(len(table["uuid"]), dtype=bool)
    if "attributes.object_motion" in table:
        is_moving |= table["attributes.object_motion"] == "Moving"
    if "stationary" in table:
        is_moving |= ~truth_column(table, "stationary", path, missing=True)
    return is_moving


def _owners(sweeps: Sequence[Sequence[_Box]]) -> Mapping[str, str]:
    return owner_by_uuid(
        dict.fromkeys((box.uuid, box.sibling) for boxes in sweeps for box in boxes)
    )


def owner_by_uuid(pairs: Iterable[tuple[str, str]]) -> Mapping[str, str]:
    """Return the representative uuid of each uuid: the alphabetically first one of all siblings.

    Args:
        pairs: uuid and sibling of every box; siblings without a box of their own are ignored.
    """
    pairs = list(pairs)
    parent = {uuid: uuid for uuid, _ in pairs}

    def root(uuid: str) -> str:
        while parent[uuid] != uuid:
            # Path halving: a long chain of siblings is not walked again for each of them.
            parent[uuid] = parent[parent[uuid]]
            uuid = parent[uuid]
        return uuid

    # Siblings of siblings are one actor, too: union-find.
    for uuid, sibling in pairs:
        if sibling in parent:
            first, second = sorted((root(uuid), root(sibling)))
            parent[second] = first
    return {uuid: root(uuid) for uuid in parent}


def _track(sweeps: Sequence[Sequence[_Box]]) -> ActorTrack:
    """Return the track of an actor from its candidate boxes of every sweep."""
    # The Pandar64 first, because the scan pattern that times the boxes is its own.
    order = {_ROOF: 0, _BOTH: 1, _FRONT: 2}
    chosen = [min(boxes, key=lambda box: (order[box.sensor], box.uuid)) for boxes in sweeps]
    chosen.sort(key=lambda box: box.time_ns)
    kept = chosen[:1]
    for box in chosen[1:]:
        if box.time_ns - kept[-1].time_ns >= _MIN_GAP_S * 1e9:
            kept.append(box)
    speaker = min(chosen, key=lambda box: (order[box.sensor], box.uuid))
    # The median of one labelled id: siblings may have other sizes, and sizes of one id may vary.
    sizes = np.stack([box.size_wlh_m for box in chosen if box.uuid == speaker.uuid])
    width, length, height = np.median(sizes, axis=0)
    trajectory = Trajectory(
        "world",
        "actor",
        np.array([box.time_ns for box in kept], dtype=np.int64),
        np.stack([_world_from_actor(box).matrix for box in kept]),
    )
    moved_m = _extent_m(trajectory.positions_m)
    is_labelled_moving = any(box.is_labelled_moving for box in chosen)
    return ActorTrack(
        speaker.uuid,
        KIND_BY_LABEL.get(speaker.label, ActorKind.OTHER),
        np.array([length, width, height]),
        trajectory,
        moved_m > _MOVED_M or (is_labelled_moving and moved_m > _LABELLED_MOVED_M),
        speaker.label,
    )


def _world_from_actor(box: _Box) -> RigidTransform:
    """Return the pose of a box; PandaSet's yaw is that of its width (x), an actor's that of its
    length."""
    return RigidTransform.from_yaw("world", "actor", box.yaw_rad + np.pi / 2, box.centre_world)


def _extent_m(positions: Float64[np.ndarray, "n 3"]) -> float:
    return float(np.linalg.norm(positions - positions[0], axis=1).max())
