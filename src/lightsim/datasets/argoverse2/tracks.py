"""Cuboids of Argoverse 2 as actor tracks."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import Trajectory
from lightsim.datasets.argoverse2.poses import (
    MAX_TIME_NS,
    QUATERNION,
    TRANSLATION,
    finite_columns,
    matrices_of,
)
from lightsim.datasets.argoverse2.sweeps import EGO_FROM_AXLE, ScanTiming
from lightsim.datasets.columns import whole_column
from lightsim.datasets.feather import read_feather
from lightsim.datasets.plausible import LIMITS
from lightsim.datasets.track import unknown_label_notes
from lightsim.errors import InputError

BOXES = "annotations.feather"
"""File with all cuboids of a log."""
KIND_BY_LABEL = {
    "ANIMAL": ActorKind.ANIMAL,
    "ARTICULATED_BUS": ActorKind.BUS,
    "BICYCLE": ActorKind.BICYCLE,
    # Boxes of riders enclose the person; the vehicle has a box of its own.
    "BICYCLIST": ActorKind.PERSONAL_MOBILITY,
    "BOLLARD": ActorKind.BARRIER,
    "BOX_TRUCK": ActorKind.TRUCK,
    "BUS": ActorKind.BUS,
    "CONSTRUCTION_BARREL": ActorKind.CONE,
    "CONSTRUCTION_CONE": ActorKind.CONE,
    "DOG": ActorKind.ANIMAL,
    # Large vans, fire engines, motor homes.
    "LARGE_VEHICLE": ActorKind.OTHER_VEHICLE,
    "MESSAGE_BOARD_TRAILER": ActorKind.TRAILER,
    "MOBILE_PEDESTRIAN_CROSSING_SIGN": ActorKind.SIGN,
    "MOBILE_PEDESTRIAN_SIGN": ActorKind.SIGN,
    "MOTORCYCLE": ActorKind.MOTORCYCLE,
    "MOTORCYCLIST": ActorKind.PERSONAL_MOBILITY,
    "OFFICIAL_SIGNALER": ActorKind.PEDESTRIAN,
    "PEDESTRIAN": ActorKind.PEDESTRIAN,
    "RAILED_VEHICLE": ActorKind.RAIL_VEHICLE,
    "REGULAR_VEHICLE": ActorKind.CAR,
    "SCHOOL_BUS": ActorKind.BUS,
    "SIGN": ActorKind.SIGN,
    "STOP_SIGN": ActorKind.SIGN,
    "STROLLER": ActorKind.PERSONAL_MOBILITY,
    "TRAFFIC_LIGHT_TRAILER": ActorKind.TRAILER,
    "TRUCK": ActorKind.TRUCK,
    "TRUCK_CAB": ActorKind.TRUCK,
    "VEHICULAR_TRAILER": ActorKind.TRAILER,
    "WHEELCHAIR": ActorKind.PERSONAL_MOBILITY,
    "WHEELED_DEVICE": ActorKind.SCOOTER,
    "WHEELED_RIDER": ActorKind.PERSONAL_MOBILITY,
}
"""Categories of the Sensor data set (av2-api, src/av2/datasets/sensor/constants.py, and the user
guide, which names one of them differently)."""
_SIZE = ("length_m", "width_m", "height_m")
# Largest number of boxes: a log of 16 s has up to some 20,000.
_MAX_BOXES = 200_000
# Longest accepted id and label, in characters; ids are uuids of 36 characters.
_MAX_TEXT = 512
# Displacement below which an actor counts as standing, in metres.
_STANDING_M = 0.5
# Displacement above which an actor counts as moving, in metres. Labels of parked cars drift by up
# to 1.6 m (log 7fab2350), and the data set has no attribute of motion.
_MOVED_M = 2.0
# Median speed over a second from which an actor between these displacements counts as moving, in
# metres a second. Parked cars of that log have up to .26, creeping ones .49 and more.
_CREEPING_M_S = 0.4


@dataclass(frozen=True, eq=False)
class Boxes:
    """All boxes of a log, one row each.

    Args:
        stamps_ns: of the sweeps for which the boxes were labelled.
        ego_from_box: pose in the ego frame of that time.
    """

    stamps_ns: Int64[np.ndarray, " n"]
    ids: list[str]
    labels: list[str]
    ego_from_box: Float64[np.ndarray, "n 4 4"]
    sizes_lwh_m: Float64[np.ndarray, "n 3"]


def read_boxes(path: Path) -> Boxes:
    """Read the boxes of a log.

    Raises:
        InputError: the file is damaged, or a box is implausible (plausible.py).
    """
    numbers = ("timestamp_ns", *_SIZE, *QUATERNION, *TRANSLATION)
    table = read_feather(path, numbers, max_rows=_MAX_BOXES, texts=("track_uuid", "category"))
    stamps_ns = whole_column(table, "timestamp_ns", path, 0, MAX_TIME_NS)
    poses = EGO_FROM_AXLE.matrix @ matrices_of(table, path)
    boxes = Boxes(
        stamps_ns,
        _texts(table["track_uuid"], "track_uuid", path),
        _texts(table["category"], "category", path),
        poses,
        finite_columns(table, _SIZE, path),
    )
    size, reach = LIMITS["box"], LIMITS["box distance"]
    distances_m = np.linalg.norm(poses[:, :3, 3], axis=1)
    for is_bad, what, expected in (
        ((boxes.sizes_lwh_m <= 0).any(axis=1), "a box has no size", "lengths above 0 m"),
        ((boxes.sizes_lwh_m >= size.most).any(axis=1), size.what, f"below {size.most:g} m"),
        (distances_m > reach.most, reach.what, f"within {reach.most:g} m"),
    ):
        if is_bad.any():
            row = int(np.flatnonzero(is_bad)[0])
            raise InputError(
                what,
                where=f"{path}, row {row} (track {boxes.ids[row][:60]})",
                got=f"size {boxes.sizes_lwh_m[row].tolist()} m, {distances_m[row]:.4g} m away",
                expected=expected,
                remedy="Remove the row, or download the file again from the original data set.",
            )
    return boxes


def tracks_of(
    boxes: Boxes, ego: Trajectory, timing: ScanTiming | None
) -> tuple[tuple[ActorTrack, ...], tuple[str, ...]]:
    """Return one track for each actor, longest first, and notes on boxes that are not used and on
    unknown labels.

    The pose of a box in the world is that at its time stamp, to which the returns are compensated;
    its time is that at which the LiDARs scan it (`ScanTiming`), or the stamp if that is unknown.

    Args:
        ego: `world_from_ego`.
    """
    is_posed = (boxes.stamps_ns >= ego.start_ns) & (boxes.stamps_ns <= ego.end_ns)
    poses = ego.held_at(boxes.stamps_ns) @ boxes.ego_from_box
    times_ns = boxes.stamps_ns.copy()
    if timing is not None:
        times_ns += np.round(timing.offsets_s(boxes.ego_from_box[:, :3, 3]) * 1e9).astype(np.int64)
    rows_by_id: dict[str, dict[int, int]] = {}
    for row in np.flatnonzero(is_posed).tolist():
        # The first box of an actor at a time stamp.
        rows_by_id.setdefault(boxes.ids[row], {}).setdefault(int(boxes.stamps_ns[row]), row)
    tracks = [
        _track(boxes, poses, times_ns, np.array(list(rows.values())))
        for rows in rows_by_id.values()
    ]
    tracks.sort(key=lambda track: (-len(track.trajectory), track.actor_id))
    used = sum(len(rows) for rows in rows_by_id.values())
    subject = "actors with labels that are not Argoverse 2's"
    unknown = unknown_label_notes(tracks, KIND_BY_LABEL, subject)
    return tuple(tracks), (*_unused(is_posed, used), *unknown)


def _track(
    boxes: Boxes,
    poses: Float64[np.ndarray, "n 4 4"],
    times_ns: Int64[np.ndarray, " n"],
    rows: Int64[np.ndarray, " k"],
) -> ActorTrack:
    rows = rows[np.argsort(times_ns[rows], kind="stable")]
    # Two sweeps whose stamps are closer than their scan times differ.
    rows = rows[np.concatenate([[True], np.diff(times_ns[rows]) > 0])]
    trajectory = Trajectory("world", "actor", times_ns[rows], poses[rows])
    label = Counter(boxes.labels[row] for row in rows).most_common(1)[0][0]
    return ActorTrack(
        boxes.ids[rows[0]],
        KIND_BY_LABEL.get(label, ActorKind.OTHER),
        np.median(boxes.sizes_lwh_m[rows], axis=0),
        trajectory,
        _is_moving(trajectory),
        label,
    )


def _is_moving(trajectory: Trajectory) -> bool:
    positions, times_ns = trajectory.positions_m, trajectory.times_ns
    moved_m = float(np.linalg.norm(positions - positions[0], axis=1).max())
    if not _STANDING_M < moved_m <= _MOVED_M:
        return moved_m > _MOVED_M
    # One second, or the whole of a shorter track.
    step_ns = min(10**9, trajectory.end_ns - trajectory.start_ns)
    starts_ns = times_ns[times_ns <= trajectory.end_ns - step_ns]
    steps_m = trajectory.held_positions_m(starts_ns + step_ns) - positions[: len(starts_ns)]
    speeds = np.linalg.norm(steps_m, axis=1) / (step_ns * 1e-9)
    return float(np.median(speeds)) > _CREEPING_M_S


def _unused(is_posed: Bool[np.ndarray, " n"], used: int) -> list[str]:
    outside, repeated = int((~is_posed).sum()), int(is_posed.sum()) - used
    notes: list[str] = []
    if outside:
        notes.append(f"{outside} boxes lie beyond the ego path in time and are not used")
    if repeated:
        notes.append(f"{repeated} boxes repeat an actor of the same sweep: the first of each is"
                     " used")  # fmt: skip
    return notes


def _texts(cells: np.ndarray, name: str, path: Path) -> list[str]:
    texts: list[str] = cells.tolist()
    for row, text in enumerate(texts):
        if not 0 < len(text) <= _MAX_TEXT or not text.isprintable():
            raise InputError(
                f"the column '{name}' has a cell that is not a name",
                where=f"{path}, row {row}",
                got=f"{text!r:.60}",
                expected=f"1 to {_MAX_TEXT} printable characters",
            )
    return texts
