"""Assembly of a log from the contents of a recording: frames, poses, sweeps, place and north."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from lightsim.core.frames import (
    RigidTransform,
    Trajectory,
    rotation_from_vector,
    vector_from_rotation,
)
from lightsim.core.log import DrivingLog, FindEgoVehicle
from lightsim.core.reading import LogReading
from lightsim.core.sensors import CameraFrame, LazySweep, RollingShutter
from lightsim.datasets.axes import box_axis_notes, camera_axis_notes
from lightsim.datasets.ego_path import check_path, extended, gap_notes
from lightsim.datasets.first_sweeps import check_frame, with_known_scale
from lightsim.datasets.geo import locate
from lightsim.datasets.plausible import (
    check_mounting,
    check_readout,
    odd_track_notes,
)
from lightsim.datasets.recorded import (
    PointsProvenance,
    RecordedCamera,
    RecordedLog,
    RecordedPicture,
)
from lightsim.datasets.rectify import View, views_of
from lightsim.datasets.selection import FrameSelection
from lightsim.datasets.sweep_points import MergedSweep, load_sweep, merged_sweeps
from lightsim.datasets.ticks import assigned, period_ns, sweep_numbers, ticks_of
from lightsim.errors import InputError


@dataclass(frozen=True)
class _Clockwork:
    """Times of the frames and what maps times to poses, in the log's world frame."""

    ticks_ns: Int64[np.ndarray, " t"]
    digits: int
    ego: Trajectory
    origin_m: Float64[np.ndarray, "3"]

    def stem(self, number: int) -> str:
        return f"{number:0{self.digits}d}"


def assemble(
    recorded: RecordedLog, reading: LogReading, find_ego_vehicle: FindEgoVehicle
) -> DrivingLog:
    """Return the log of a recording; pictures and sweeps are loaded on demand.

    The world's origin is moved to the first ego position, because world coordinates are float32 in
    later stages: in UTM coordinates float32 has steps of 0.25 m.

    Raises:
        InputError: there is no picture, no such camera or frame, or a pose is implausible.
    """
    source = Path(reading.source)
    scaled, scale_notes = with_known_scale(recorded.sweeps)
    recorded = replace(recorded, sweeps=scaled, notes=(*recorded.notes, *scale_notes))
    for camera in recorded.cameras:
        check_mounting(f"{source}, {camera.name}", camera.ego_from_camera.translation_m)
        check_readout(f"{source}, {camera.name}", camera.readout.seconds)
    clockwork = _clockwork(recorded)
    pose_notes = (
        *check_path(source / "ego path", clockwork.ego),
        *gap_notes(recorded.ego, np.concatenate([_times_ns(c) for c in recorded.cameras])),
        *camera_axis_notes({c.name: c.ego_from_camera for c in recorded.cameras if c.pictures}),
    )
    by_view, frame_notes = _frames_by_view(recorded, reading, clockwork)
    frames = _selected(by_view, FrameSelection.parse(reading.frames), source)
    sweeps, sweep_notes = _sweeps(recorded, reading, clockwork, frames)
    actors = tuple(
        replace(actor, trajectory=_shifted(actor.trajectory, clockwork.origin_m))
        for actor in recorded.actors
    )
    geo, geo_notes = locate(recorded.located, clockwork.ego, frames[0].time_ns, reading)
    masks, mask_notes = find_ego_vehicle(
        [(view.camera, all_frames) for view, all_frames in by_view.items()], clockwork.ego
    )
    x, y, z = clockwork.origin_m.tolist()
    return DrivingLog(
        recorded.name,
        {view.camera.name: view.camera for view in by_view},
        frames,
        sweeps,
        clockwork.ego,
        actors,
        geo,
        _with_outside(masks, recorded, by_view),
        (*recorded.notes, *pose_notes, *frame_notes, *sweep_notes, *_absent(recorded),
         *odd_track_notes(actors), *box_axis_notes(actors), *geo_notes, *mask_notes),
        recorded.semantic_names,
        (x, y, z),
        recorded.licence,
        recorded.has_heights,
    )  # fmt: skip


def _clockwork(recorded: RecordedLog) -> _Clockwork:
    times = {camera.name: _times_ns(camera) for camera in recorded.cameras}
    if not any(len(t) for t in times.values()):
        raise InputError(
            "the log has no pictures",
            where=recorded.name,
            got="; ".join(recorded.notes[:3])[:300] or None,
            expected="pictures of one camera or more",
            remedy="Download the camera data of the data set, too, with its time stamps.",
        )
    ticks_ns = ticks_of(times)
    # Sweeps without a frame of their own have numbers after the last frame.
    most = len(ticks_ns) + max((len(s) for s in recorded.sweeps.values()), default=0)
    # Whole metres, so that positions stay exact.
    origin_m = np.round(recorded.ego.positions_m[0])
    ego = extended(_shifted(recorded.ego, origin_m))
    return _Clockwork(ticks_ns, len(str(most)), ego, origin_m)


_FramesByView = dict[View, tuple[CameraFrame, ...]]


def _frames_by_view(
    recorded: RecordedLog, reading: LogReading, clockwork: _Clockwork
) -> tuple[_FramesByView, list[str]]:
    """Return the frames of every selected pinhole view, and notes."""
    found: _FramesByView = {}
    notes: list[str] = []
    names: list[str] = []
    for camera in recorded.cameras:
        views = views_of(camera.name, camera.lens)
        names += [view.camera.name for view in views]
        # --cameras accepts the recorded camera's name for all of its views.
        wanted = [
            view for view in views
            if not reading.cameras or {camera.name, view.camera.name} & set(reading.cameras)
        ]  # fmt: skip
        if not wanted or not camera.pictures:
            continue
        if not camera.lens.is_pinhole:
            shown = ", ".join(view.camera.name for view in wanted)
            notes.append(f"{camera.name}: {camera.lens.model} lens, resampled to pinhole ({shown})")
        chosen, camera_notes = _pictures_by_tick(camera, clockwork)
        notes += camera_notes
        for view in wanted:
            found[view] = tuple(
                _frame(camera, view, picture, clockwork.stem(tick), clockwork)
                for tick, picture in sorted(chosen.items())
            )
    known = {*names, *(camera.name for camera in recorded.cameras)}
    unknown = [name for name in reading.cameras if name not in known]
    if unknown or not found:
        raise InputError(
            "no such camera" if unknown else "the log has no pictures",
            where=reading.source,
            got=", ".join(unknown) or None,
            expected=f"--cameras of {', '.join(names)}",
        )
    return found, notes


def _pictures_by_tick(
    camera: RecordedCamera, clockwork: _Clockwork
) -> tuple[dict[int, RecordedPicture], list[str]]:
    """Return the pictures by the index of their frame, and notes on those without one or a pose."""
    item_by_tick = assigned(clockwork.ticks_ns, _times_ns(camera))
    chosen = {tick: camera.pictures[item] for tick, item in item_by_tick.items()}
    notes: list[str] = []
    extra = len(camera.pictures) - len(chosen)
    if extra:
        notes.append(f"{camera.name}: {extra} pictures beside another one of the same frame are"
                     " not used")  # fmt: skip
    posed = {
        tick: picture
        for tick, picture in chosen.items()
        if picture.world_from_camera is not None or clockwork.ego.covers(picture.time_ns)
    }
    if len(posed) < len(chosen):
        notes.append(f"{camera.name}: {len(chosen) - len(posed)} pictures lie beyond the ego path"
                     " and are not used")  # fmt: skip
    missing = len(clockwork.ticks_ns) - len(posed)
    if missing:
        notes.append(f"{camera.name}: no picture for {missing} of {len(clockwork.ticks_ns)} frames")
    return posed, notes


def _frame(
    camera: RecordedCamera,
    view: View,
    picture: RecordedPicture,
    stem: str,
    clockwork: _Clockwork,
) -> CameraFrame:
    """Return a frame with the time and pose of its centre."""
    down_s, across_s, centre_s = view.readout(camera.readout.down_s, camera.readout.across_s)
    after_s = camera.readout.middle_s + centre_s
    time_ns = picture.time_ns + round(after_s * 1e9)
    velocity, turn_rate = picture.motion_world or _motion(
        clockwork.ego, time_ns, camera.ego_from_camera
    )
    pose = _pose(camera, picture, time_ns, velocity * after_s, turn_rate * after_s, clockwork)
    view_axes = RigidTransform.from_rotation("camera", "view", view.camera_from_view, np.zeros(3))
    turned = RigidTransform("world", "camera", (pose @ view_axes).matrix)
    shutter = RollingShutter(down_s, velocity, turn_rate, across_s)
    is_global = down_s == 0.0 and across_s == 0.0
    load = view.loader(picture.load)
    return CameraFrame(
        view.camera.name, stem, time_ns, turned, load, None if is_global else shutter
    )


def _pose(
    camera: RecordedCamera,
    picture: RecordedPicture,
    time_ns: int,
    step_m: Float64[np.ndarray, "3"],
    turn_rad: Float64[np.ndarray, "3"],
    clockwork: _Clockwork,
) -> RigidTransform:
    """Return `world_from_camera` at a time: of the ego path, or the picture's own pose, moved from
    the picture's time stamp by the ego's motion."""
    if picture.world_from_camera is None:
        return clockwork.ego.held(time_ns) @ camera.ego_from_camera
    matrix = picture.world_from_camera.matrix.copy()
    matrix[:3, :3] = rotation_from_vector(turn_rad) @ matrix[:3, :3]
    matrix[:3, 3] += step_m - clockwork.origin_m
    return RigidTransform("world", "camera", matrix)


def _motion(
    ego: Trajectory, time_ns: int, ego_from_camera: RigidTransform
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """Return linear and angular velocity of a camera, frame `world`, between the ego poses around
    a time."""
    if len(ego) == 1:
        return np.zeros(3), np.zeros(3)
    # 50 ms on both sides: poses of single sensors are few milliseconds apart, whose rounding
    # would dominate their difference.
    half_ns = 50_000_000
    begin = min(max(time_ns - half_ns, ego.start_ns), ego.end_ns - 1)
    end = max(min(time_ns + half_ns, ego.end_ns), begin + 1)
    first, last = (ego.held(t) @ ego_from_camera for t in (begin, end))
    seconds = (end - begin) * 1e-9
    turn = vector_from_rotation(last.rotation @ first.rotation.T)
    return (last.translation_m - first.translation_m) / seconds, turn / seconds


def _selected(
    by_view: _FramesByView, selection: FrameSelection, source: Path
) -> tuple[CameraFrame, ...]:
    every = [frame for frames in by_view.values() for frame in frames]
    chosen = [frame for frame in every if selection.holds(int(frame.stem))]
    if not chosen:
        numbers = sorted({int(frame.stem) for frame in every})
        raise InputError(
            "no frame is selected",
            where=f"{source}, --frames",
            got=f"frames {numbers[0]} to {numbers[-1]} in the log" if numbers else "no frame",
            expected="a range that contains a frame of the selected cameras",
        )
    return tuple(sorted(chosen, key=lambda frame: (frame.time_ns, frame.camera_name)))


def _sweeps(
    recorded: RecordedLog,
    reading: LogReading,
    clockwork: _Clockwork,
    frames: tuple[CameraFrame, ...],
) -> tuple[tuple[LazySweep, ...], tuple[str, ...]]:
    """Return the sweeps of the selected frames, and those between them, with notes."""
    given = [
        LazySweep(
            frames[0].stem,
            frames[0].time_ns,
            partial(load_sweep, MergedSweep(frames[0].time_ns, (sweep,)), frames[0].stem,
                    clockwork.ego, clockwork.origin_m),
        )
        for sweeps in recorded.sweeps.values()
        for sweep in sweeps
        if sweep.provenance is PointsProvenance.GIVEN
    ]  # fmt: skip
    if given:
        return tuple(given[:1]), ()
    merged, notes = merged_sweeps(recorded.sweeps)
    covered = [sweep for sweep in merged if clockwork.ego.covers(sweep.time_ns)]
    if len(covered) < len(merged):
        left = len(merged) - len(covered)
        notes += (f"{left} of {len(merged)} sweeps lie beyond the ego path and are not used",)
    if covered:
        ends = (covered[0], covered[-1])
        first_sweep, last_sweep = (
            load_sweep(sweep, "", clockwork.ego, clockwork.origin_m) for sweep in ends
        )
        check_frame(first_sweep, last_sweep, covered[-1].parts[0].path)
    selection = FrameSelection.parse(reading.frames)
    half_ns = period_ns(clockwork.ticks_ns) / 2
    first, last = frames[0].time_ns - half_ns, frames[-1].time_ns + half_ns
    lazy: list[LazySweep] = []
    numbers = sweep_numbers(clockwork.ticks_ns, [sweep.time_ns for sweep in covered])
    for number, sweep in zip(numbers, covered, strict=True):
        is_between = number >= len(clockwork.ticks_ns) and first <= sweep.time_ns <= last
        if is_between or (number < len(clockwork.ticks_ns) and selection.holds(number)):
            stem = clockwork.stem(number)
            load = partial(load_sweep, sweep, stem, clockwork.ego, clockwork.origin_m)
            lazy.append(LazySweep(stem, sweep.time_ns, load))
    return tuple(lazy), notes


def _with_outside(
    masks: Mapping[str, np.ndarray], recorded: RecordedLog, by_view: _FramesByView
) -> dict[str, np.ndarray]:
    """Return the masks of the ego vehicle, joined with given ones and with what lies outside the
    lens."""
    joined = dict(masks)
    camera_by_lens = {id(camera.lens): camera for camera in recorded.cameras}
    for view in by_view:
        outside = view.outside(camera_by_lens[id(view.lens)].mask)
        if outside is not None:
            name = view.camera.name
            joined[name] = joined[name] | outside if name in joined else outside
    return joined


def _absent(recorded: RecordedLog) -> tuple[str, ...]:
    """Return notes on kinds of data that the recording does not have."""
    kinds = (
        (any(recorded.sweeps.values()), "no LiDAR sweeps, which geometry requires"),
        (bool(recorded.actors), "no labelled boxes: moving actors remain in the background"),
        (bool(recorded.semantic_names), "no point classes: materials are inferred without them"),
    )
    return tuple(f"the log has {words}" for is_there, words in kinds if not is_there)


def _shifted(trajectory: Trajectory, origin_m: Float64[np.ndarray, "3"]) -> Trajectory:
    matrices = trajectory.matrices.copy()
    matrices[:, :3, 3] -= origin_m
    return replace(trajectory, matrices=matrices)


def _times_ns(camera: RecordedCamera) -> Int64[np.ndarray, " n"]:
    return np.array([picture.time_ns for picture in camera.pictures], dtype=np.int64)
