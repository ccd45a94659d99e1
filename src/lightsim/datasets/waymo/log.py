"""Reader of the Waymo Open Dataset, perception (Sun et al. 2020, arXiv:1912.04838).

SOURCE is a TFRecord file of version 1 (frames.py), or a folder with camera_image/SEGMENT.parquet
and the other components of version 2 (parquet.py). A frame is stamped with the start of a sweep,
but its pose, in which the boxes are labelled, is of the middle (waymo-open-dataset#464).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import Clock, DrivingLog, FindEgoVehicle, Place
from lightsim.core.reading import LogReading
from lightsim.datasets.assemble import assemble
from lightsim.datasets.geo import Located
from lightsim.datasets.layout import visible_entries
from lightsim.datasets.reader import LogReader
from lightsim.datasets.recorded import (
    RawSweep,
    Readout,
    RecordedCamera,
    RecordedLog,
    RecordedPicture,
    RecordedSweep,
)
from lightsim.datasets.scenes import chosen_scene
from lightsim.datasets.track import TimedBox, tracks_of
from lightsim.datasets.waymo.frames import read_records
from lightsim.datasets.waymo.parquet import PICTURES, read_parquet, scene_files
from lightsim.datasets.waymo.range_image import make_sweep
from lightsim.datasets.waymo.segment import Box, Frame, Laser, Segment
from lightsim.datasets.waymo.wire import is_tfrecord
from lightsim.store.reading import is_file, is_folder

_LICENCE = "Waymo Dataset License Agreement for Non-Commercial Use (waymo.com/open/terms)"
# CameraName and LaserName of dataset.proto.
_CAMERAS = {
    1: "front", 2: "front_left", 3: "front_right", 4: "side_left", 5: "side_right",
    6: "rear_left", 7: "rear", 8: "rear_right",
}  # fmt: skip
# LaserName.Name of dataset.proto: the LiDAR on the roof.
_TOP = 1
# LaserName.Name of dataset.proto.
_LASERS = {_TOP: "top", 2: "front", 3: "side_left", 4: "side_right", 5: "rear"}
# Label.Type of label.proto. Vehicles are cars, trucks, buses and motorcycles alike.
_LABELS = {1: "vehicle", 2: "pedestrian", 3: "sign", 4: "cyclist"}
_KINDS = {
    "vehicle": ActorKind.OTHER_VEHICLE,
    "pedestrian": ActorKind.PEDESTRIAN,
    "sign": ActorKind.SIGN,
    "cyclist": ActorKind.BICYCLE,
}
# Largest length of a car, in metres: that of large sport utility vehicles.
_CAR_LENGTH_M = 5.8
# Largest height of a car, in metres.
_CAR_HEIGHT_M = 2.1
# Centre of each city, and the extent of its part of the data set as an angle on Earth; the data
# set has no position, and none is to come (waymo-open-dataset#218, #849).
_PLACES = {
    "location_sf": Place(37.77, -122.43, "centre of San Francisco", 0.1),
    "location_phx": Place(33.42, -111.93, "centre of the Phoenix area", 0.2),
}
# Standard deviation of the azimuth of world x, in degrees; an assumption. The frame is
# east-north-up at a remote origin (#119).
_NORTH_STD_DEG = 0.5
# From the start of a sweep to its middle, where no picture has the frame's pose, in nanoseconds.
_HALF_TURN_NS = 50_000_000
# Speed from which an actor counts as labelled moving, in m/s; jitter of labels stays below.
_MOVING_M_S = 0.5


def _detect(source: Path) -> bool:
    # Of a partial download, one of the three may be missing.
    folders = (source / PICTURES, source / "vehicle_pose", source / "camera_calibration")
    return is_tfrecord(source) or sum(is_folder(folder) for folder in folders) > 1


def _read(reading: LogReading, find_ego_vehicle: FindEgoVehicle) -> DrivingLog:
    source = Path(reading.source)
    if is_file(source):
        segment = read_records(source)
        chosen_scene([segment.name], reading)
    else:
        segment = read_parquet(source, _scene(reading))
    return assemble(_recorded(segment, source), reading, find_ego_vehicle)


def _files(reading: LogReading) -> Iterable[Path]:
    source = Path(reading.source)
    return [source] if is_file(source) else scene_files(source, _scene(reading))


def _other_place(folder: Path) -> tuple[str, Path] | None:
    files = [path for path in visible_entries(folder) if path.suffix == ".tfrecord"]
    return (f"a folder of {len(files)} TFRecord files", files[0]) if files else None


READER = LogReader(_detect, _read, _other_place, _files)


def _scene(reading: LogReading) -> str:
    """Return the name of the chosen segment of a folder."""
    entries = visible_entries(Path(reading.source) / PICTURES)
    return chosen_scene([path.stem for path in entries if path.suffix == ".parquet"], reading)


def _recorded(segment: Segment, source: Path) -> RecordedLog:
    frames, notes = _in_order(segment.frames)
    ego, ego_notes = _ego_path(frames)
    cameras, camera_notes = _cameras(segment, frames, source)
    sweeps, sweep_notes = _sweeps(segment, frames, source)
    actors, label_notes = _actors(frames, source)
    place = _PLACES.get(segment.location)
    return RecordedLog(
        segment.name,
        cameras,
        ego,
        sweeps,
        actors,
        Located(
            place=place,
            clock=Clock(origin="log"),
            world_x_azimuth_deg=90.0,
            azimuth_std_deg=_NORTH_STD_DEG,
        ),
        notes=(
            *notes,
            *ego_notes,
            *camera_notes,
            *sweep_notes,
            *label_notes,
            *_place_notes(segment),
        ),
        licence=_LICENCE,
    )


def _in_order(frames: Sequence[Frame]) -> tuple[list[Frame], tuple[str, ...]]:
    """Return the frames in time order, each time once, and notes."""
    by_start = {frame.start_ns: frame for frame in reversed(frames)}
    lost = len(frames) - len(by_start)
    notes = (f"{lost} frames repeat the time of another one and are not used",) if lost else ()
    return [by_start[start] for start in sorted(by_start)], notes


def _pose_ns(frame: Frame) -> int:
    """Return the time of a frame's pose: that of the picture with the same pose, the front one in
    the data set, or the middle of the sweep."""
    matrix = frame.world_from_ego.matrix
    same = [p.pose_ns for p in frame.pictures if np.array_equal(p.world_from_ego.matrix, matrix)]
    middle_ns = frame.start_ns + _HALF_TURN_NS
    # A vehicle that stands still may have one pose in several pictures.
    return min(same, key=lambda time_ns: abs(time_ns - middle_ns), default=middle_ns)


def _ego_path(frames: Sequence[Frame]) -> tuple[Trajectory, tuple[str, ...]]:
    """Return the poses of all frames and pictures, five or six in 0.1 s."""
    found: dict[int, RigidTransform] = {}
    differing = 0
    for frame in frames:
        own = [(p.pose_ns, p.world_from_ego) for p in frame.pictures]
        for time_ns, pose in [(_pose_ns(frame), frame.world_from_ego), *own]:
            other = found.setdefault(time_ns, pose)
            differing += not np.allclose(other.matrix, pose.matrix, rtol=0, atol=1e-3)
    times_ns = np.array(sorted(found), dtype=np.int64)
    matrices = np.stack([found[time_ns].matrix for time_ns in times_ns.tolist()])
    notes = (f"{differing} poses differ from another one of the same time and are not used",)
    return Trajectory("world", "ego", times_ns, matrices), notes if differing else ()


def _cameras(
    segment: Segment, frames: Sequence[Frame], source: Path
) -> tuple[tuple[RecordedCamera, ...], tuple[str, ...]]:
    cameras: list[RecordedCamera] = []
    notes: list[str] = []
    for number, camera in sorted(segment.cameras.items()):
        name = _CAMERAS.get(number, f"camera_{number}")
        taken = [p for frame in frames for p in frame.pictures if p.camera == number]
        by_time = {picture.middle_ns: picture for picture in reversed(taken)}
        if len(by_time) < len(taken):
            notes.append(f"{name}: {len(taken) - len(by_time)} pictures repeat the time of another"
                         " one and are not used")  # fmt: skip
        pictures = tuple(
            # Poses are of the ego path, which holds the poses of all pictures: the picture's own
            # one is up to 3 ms away from its middle.
            RecordedPicture(time_ns, source, picture.load)
            for time_ns, picture in sorted(by_time.items())
        )
        readout = Readout()
        if camera.direction is not None and taken:
            readout = Readout(float(np.median([p.readout_s for p in taken])), camera.direction)
        elif taken:
            notes.append(f"{name}: global shutter, or no direction of the readout is given")
        cameras.append(RecordedCamera(name, camera.lens, camera.ego_from_camera, pictures, readout))
    return tuple(cameras), tuple(notes)


def _sweeps(
    segment: Segment, frames: Sequence[Frame], source: Path
) -> tuple[dict[str, tuple[RecordedSweep, ...]], tuple[str, ...]]:
    """Return the sweeps of each LiDAR, at the times of the frames' poses, and notes."""
    sweeps: dict[str, tuple[RecordedSweep, ...]] = {}
    notes: list[str] = []
    # The top LiDAR, which is the first one, is the reference of the others.
    for number in sorted({number for frame in frames for number in frame.sweeps}):
        name = _LASERS.get(number, f"laser_{number}")
        if number not in segment.lasers:
            notes.append(f"{name}: no calibration, so that its sweeps are not used")
            continue
        sweeps[name] = tuple(
            _sweep(frame, number, segment.lasers[number], source)
            for frame in frames
            if number in frame.sweeps
        )
        first = next(frame.sweeps[number] for frame in frames if number in frame.sweeps)
        if number != _TOP or first().poses is None:
            notes.append(f"{name}: returns have no times; they are moved to the middle of the sweep"
                         " and beams start there")  # fmt: skip
    return sweeps, tuple(notes)


def _sweep(frame: Frame, number: int, laser: Laser, source: Path) -> RecordedSweep:
    time_ns = _pose_ns(frame)
    start_s = (frame.start_ns - time_ns) * 1e-9
    load = partial(_load_sweep, frame, number, laser, start_s, source)
    return RecordedSweep(time_ns, source, load)


def _load_sweep(frame: Frame, number: int, laser: Laser, start_s: float, source: Path) -> RawSweep:
    return make_sweep(frame.sweeps[number](), laser, start_s, f"{source}, laser {number}")


def _actors(
    frames: Sequence[Frame], source: Path
) -> tuple[tuple[ActorTrack, ...], tuple[str, ...]]:
    boxes = [_timed_box(frame, box) for frame in frames for box in frame.boxes]
    tracks, notes = tracks_of(boxes, _KINDS, source)
    return tuple(replace(t, kind=ActorKind.CAR) if _is_car(t) else t for t in tracks), notes


def _timed_box(frame: Frame, box: Box) -> TimedBox:
    pose = RigidTransform.from_yaw("ego", "actor", box.heading_rad, box.centre)
    return TimedBox(
        _scanned_ns(frame, box),
        box.actor_id,
        _LABELS.get(box.type, f"type {box.type}"),
        box.size_lwh_m,
        frame.world_from_ego @ pose,
        box.speed_m_s > _MOVING_M_S,
    )


def _scanned_ns(frame: Frame, box: Box) -> int:
    """Return the time at which the top LiDAR points at a box.

    Boxes enclose the returns, which only the ego's motion moved to the frame's pose. The comment
    in label.proto takes boxes as of the frame's start instead, up to 0.1 s earlier; the one real
    frame at hand does not decide.
    """
    azimuth = np.arctan2(box.centre[1], box.centre[0])
    # A turn starts backwards, clockwise from above.
    return frame.start_ns + round((np.pi - azimuth) / (2 * np.pi) * 2 * _HALF_TURN_NS)


def _is_car(track: ActorTrack) -> bool:
    """Return whether a vehicle has the size of a car; larger ones stay OTHER_VEHICLE."""
    length_m, _, height_m = track.size_lwh_m
    is_small = length_m <= _CAR_LENGTH_M and height_m <= _CAR_HEIGHT_M
    return track.kind is ActorKind.OTHER_VEHICLE and bool(is_small)


def _place_notes(segment: Segment) -> tuple[str, ...]:
    place = _PLACES.get(segment.location)
    if place is None:
        return (f"the place '{segment.location}' has no known position",)
    return (f"the place is the {place.origin}: the data set has no position",)
