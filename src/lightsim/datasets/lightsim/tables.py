"""Tables of a lightsim-log/1 folder: ego path, poses of pictures, boxes and GPS fixes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.datasets.csv_table import POSE_COLUMNS, CsvTable, read_csv
from lightsim.datasets.geo import GpsTrack, gps_track
from lightsim.datasets.layout import has_file
from lightsim.datasets.lightsim.labels import kind_of
from lightsim.datasets.plausible import LIMITS
from lightsim.datasets.track import TimedBox, tracks_of
from lightsim.errors import InputError

EGO_NAME, BOXES_NAME, GPS_NAME = "ego.csv", "boxes.csv", "gps.csv"
PICTURES_NAME = "camera_poses.csv"
POSES = ("time_ns", *POSE_COLUMNS)
SIZES = ("length", "width", "height")
BOXES = ("time_ns", "track", "label", *POSE_COLUMNS, *SIZES)
VELOCITIES = ("vx", "vy", "vz", "wx", "wy", "wz")
_GPS = ("time_ns", "latitude", "longitude")
# Longest id of a track, in characters; longer text belongs to another column.
_MAX_ID = 512
_TRUTHS = {"0": False, "1": True, "false": False, "true": True}


@dataclass(frozen=True, eq=False)
class PicturePose:
    """Pose of one picture, and its motion if the table has it."""

    world_from_camera: RigidTransform
    motion_world: tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]] | None


def read_ego(path: Path) -> tuple[Trajectory, tuple[str, ...]]:
    """Read `world_from_ego`: poses at any rate, in any order; doubled times are noted and dropped.

    Raises:
        InputError: the file is missing or broken, or has no pose.
    """
    table = read_csv(path, POSES)
    if not table.n_rows:
        raise InputError("the ego path has no pose", where=path, expected="one row or more")
    times, rows = np.unique(table.times_ns(), return_index=True)
    doubled = table.n_rows - len(times)
    notes: tuple[str, ...] = ()
    if doubled:
        notes = (f"{path.name}: {doubled} of {table.n_rows} poses repeat a time: the first of each"
                 " is used",)  # fmt: skip
    return Trajectory("world", "ego", times, table.matrices()[rows]), notes


def read_picture_poses(path: Path) -> dict[tuple[str, int], PicturePose]:
    """Read the poses of pictures by camera and time; empty without the file.

    Raises:
        InputError: the file is broken.
    """
    if not has_file(path):
        return {}
    table = read_csv(path, ("camera", *POSES))
    names, times, matrices = table.texts("camera"), table.times_ns(), table.matrices()
    has_motion = all(name in table for name in VELOCITIES)
    motion = np.stack([table.numbers(n) for n in VELOCITIES], axis=1) if has_motion else None
    found: dict[tuple[str, int], PicturePose] = {}
    for i, name in enumerate(names):
        pose = RigidTransform("world", "camera", matrices[i])
        velocities = None if motion is None else (motion[i, :3].copy(), motion[i, 3:].copy())
        found.setdefault((name, int(times[i])), PicturePose(pose, velocities))
    return found


def read_boxes(path: Path, ego: Trajectory) -> tuple[tuple[ActorTrack, ...], tuple[str, ...]]:
    """Read one track for each actor, longest first, and notes; none without the file.

    Raises:
        InputError: the file is broken, or a box is implausible.
    """
    if not has_file(path):
        return (), ()
    table = read_csv(path, BOXES)
    if not table.n_rows:
        return (), ()
    ids = np.array([_checked_id(table, i) for i in range(table.n_rows)], dtype=object)
    labels = [label.strip() for label in table.texts("label")]
    times, matrices = table.times_ns(), table.matrices()
    sizes = np.stack([table.numbers(name) for name in SIZES], axis=1)
    _check_boxes(table, ids, matrices, sizes, ego.held_positions_m(times))
    moving = _cells(table, "is_moving", _truth) if "is_moving" in table else None
    kinds = _cells(table, "kind", _kind) if "kind" in table else None
    shown = [label if label.isprintable() else "other" for label in labels]
    by_label = {label: kind_of(label) for label in shown} if kinds is None else dict(
        zip(shown, kinds, strict=True)
    )  # fmt: skip
    boxes = [
        TimedBox(int(times[i]), name, shown[i], sizes[i], RigidTransform("world", "actor", m))
        for i, (name, m) in enumerate(zip(ids, matrices, strict=True))
    ]
    known = {label: kind for label, kind in by_label.items() if kind is not None}
    tracks, notes = tracks_of(boxes, known, path)
    if moving is not None:
        # An actor moves if one of its boxes does; without the column, if its place changes.
        movers = {name for name, is_moving in zip(ids, moving, strict=True) if is_moving}
        tracks = tuple(replace(track, is_moving=track.actor_id in movers) for track in tracks)
    return tracks, notes


def read_gps(path: Path, start_ns: int) -> GpsTrack | None:
    """Read the GPS fixes of a log that starts at a time; None without the file.

    Raises:
        InputError: the file is broken, a fix is not on Earth, or all are of another time.
    """
    if not has_file(path):
        return None
    table = read_csv(path, _GPS)
    if not table.n_rows:
        return None
    times, rows = np.unique(table.times_ns(), return_index=True)
    latitude, longitude = table.numbers("latitude")[rows], table.numbers("longitude")[rows]
    track = gps_track(times, latitude, longitude, lambda i: f"{path}, row {rows[i] + 1}")
    gap_s = float(np.abs(times - start_ns).min()) * 1e-9
    LIMITS["gps gap"].check(path, gap_s, f"the nearest {gap_s:.4g} s away")
    return track


def _checked_id(table: CsvTable, row: int) -> str:
    text = table.texts("track")[row]
    if not text or not text.isprintable() or len(text) > _MAX_ID:
        expected = f"printable text of up to {_MAX_ID} characters"
        raise table.wrong_cell("track", row, expected)
    return text


def _check_boxes(
    table: CsvTable,
    ids: np.ndarray,
    matrices: Float64[np.ndarray, "n 4 4"],
    sizes: Float64[np.ndarray, "n 3"],
    ego_m: Float64[np.ndarray, "n 3"],
) -> None:
    distances_m = np.linalg.norm(matrices[:, :3, 3] - ego_m, axis=1)
    box, reach = LIMITS["box"], LIMITS["box distance"]
    for is_bad, what, expected in (
        ((sizes <= 0).any(axis=1), "a box has a size that is not positive", "metres above 0"),
        ((sizes >= box.most).any(axis=1), box.what, f"below {box.most:g} m"),
        (distances_m > reach.most, reach.what, f"within {reach.most:g} m"),
    ):
        if is_bad.any():
            i = int(np.argmax(is_bad))
            raise InputError(
                what,
                where=f"{table.path}, row {i + 1} (track {ids[i][:60]})",
                got=f"size {sizes[i].tolist()} m, {distances_m[i]:.4g} m from the ego vehicle",
                expected=expected,
                remedy="Sizes and positions are in metres, positions in the world frame of"
                f" {EGO_NAME}.",
            )


def _cells(table: CsvTable, name: str, parse: Callable[[str], object]) -> list:
    values = []
    for i, cell in enumerate(table.texts(name)):
        value = parse(cell.strip().lower())
        if value is None:
            expected = "0 or 1" if name == "is_moving" else f"one of {', '.join(ActorKind)}"
            raise table.wrong_cell(name, i, expected)
        values.append(value)
    return values


def _truth(cell: str) -> bool | None:
    return _TRUTHS.get(cell)


def _kind(cell: str) -> ActorKind | None:
    return ActorKind(cell) if cell in set(ActorKind) else None
