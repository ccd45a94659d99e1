"""Reader of PandaSet sequences (Xiao et al. 2021, doi:10.1109/ITSC48978.2021.9565009).

Layout: camera/<name>/{*.jpg, intrinsics.json, poses.json, timestamps.json}, lidar/{*.pkl.gz,
timestamps.json}, annotations/{cuboids,semseg}/*.pkl.gz, meta/gps.json; tables also as *.pkl,
pictures also as *.png (numbered.py). A file's number is its index into the lists of poses, times
and GPS fixes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from lightsim.core.actors import ActorTrack
from lightsim.core.frames import Trajectory
from lightsim.core.log import DrivingLog, FindEgoVehicle
from lightsim.core.reading import LogReading
from lightsim.core.sensors import CameraFrame, LazySweep
from lightsim.datasets.axes import check_ego_axes
from lightsim.datasets.files import read_json, read_times_ns, require_list, require_numbers
from lightsim.datasets.geo import GpsTrack, Located, gps_track, locate
from lightsim.datasets.layout import has_file, has_folder, subfolders
from lightsim.datasets.pandaset.cameras import CameraFolder, read_camera
from lightsim.datasets.pandaset.numbered import PICTURES, TABLES, NumberedFiles, numbered_files
from lightsim.datasets.pandaset.places import (
    BOXES,
    CLASSES,
    SWEEPS,
    check_not_elsewhere,
    is_sequence,
    other_place,
)
from lightsim.datasets.pandaset.rig import (
    READOUT_S,
    Rig,
    calibration_path,
    ego_trajectory,
    read_rig,
)
from lightsim.datasets.pandaset.sweeps import (
    ScanTiming,
    SweepSource,
    load_sweep,
    measure_timing,
    read_class_names,
    with_known_scale,
)
from lightsim.datasets.pandaset.tracks import CuboidFile, read_tracks
from lightsim.datasets.plausible import LIMITS, check_clocks, check_rigid
from lightsim.datasets.reader import LogReader
from lightsim.datasets.selection import FrameSelection
from lightsim.errors import InputError

SIMULATED_NAME = "simulated.json"
"""File that marks a log written by LightSim."""
_EGO_CAMERA = "front_camera"
# Time for which the ego path is extended, in seconds: sweeps end slightly after the last camera
# pose.
_EGO_HOLD_S = 0.2


# Number of gaps that a note on missing files lists.
_SPANS_SHOWN = 8


@dataclass(frozen=True)
class _Sweeps:
    lazy: tuple[LazySweep, ...]
    sources: Mapping[int, SweepSource]
    times_ns: Int64[np.ndarray, " n"]
    notes: tuple[str, ...] = ()


def read_pandaset(reading: LogReading, find_ego_vehicle: FindEgoVehicle) -> DrivingLog:
    """Read a PandaSet sequence; pictures and sweeps are loaded on demand.

    Args:
        reading: options; the source is the folder of the sequence, such as pandaset/002.
        find_ego_vehicle: finds the ego vehicle in the pictures of all cameras.

    Raises:
        InputError: something is missing or broken; the message names the file.
    """
    source, selection = Path(reading.source), FrameSelection.parse(reading.frames)
    # Everything but pixels and points is read and checked here, so that errors appear at once.
    rig = read_rig(source)
    names, helper_names = _camera_names(source, reading.cameras, rig)
    tables = {part: _tables(source, part) for part in (SWEEPS, BOXES, CLASSES)}
    digits = _stem_digits(source, (*names, *helper_names), tables[SWEEPS])

    def read(name: str) -> CameraFolder:
        readout_s = rig.readout_s_by_camera.get(name, READOUT_S)
        return read_camera(source / "camera" / name, readout_s, digits)

    folders, helpers = [read(name) for name in names], [read(name) for name in helper_names]
    clock_notes = _check_clocks(source, (*folders, *helpers))
    paths = {f.camera.name: f.world_from_camera for f in (*folders, *helpers)}
    ego = ego_trajectory(rig, paths, source)
    check_ego_axes(source / "camera", ego)
    rigid_notes = _check_rigid(source, (*folders, *helpers), ego)
    # Selected after the ego path is known: poses of all frames determine the path.
    selected = _select_frames(folders, selection, source)
    sweeps = _read_sweeps(source, tables, digits, ego, rig, selection)
    actors, actor_notes = _read_actors(source, tables[BOXES], ego, sweeps)
    track = _read_gps(source, selected[0].time_ns)
    geo, geo_notes = locate(Located(track), ego, selected[0].time_ns, reading)
    masks, mask_notes = find_ego_vehicle([(f.camera, f.frames) for f in folders], ego)
    class_names = read_class_names(source / CLASSES / "classes.json")
    notes = (
        *_origin_notes(source),
        *(note for folder in folders for note in folder.notes),
        *(note for files in tables.values() for note in files.notes),
        *rig.notes, *clock_notes, *rigid_notes, *sweeps.notes,
        *_missing_notes(folders, tables, selection, class_names),
        *actor_notes, *geo_notes, *mask_notes,
    )  # fmt: skip
    return DrivingLog(
        source.resolve().name,
        {folder.camera.name: folder.camera for folder in folders},
        selected,
        sweeps.lazy,
        ego,
        actors,
        geo,
        masks,
        notes,
        class_names,
    )


def _files(reading: LogReading) -> Iterator[Path]:
    """Yield the files of a sequence, and the calibration, which may lie beside the sequences."""
    source = Path(reading.source)
    yield from (path for path in source.rglob("*") if path.is_file())
    calibration = calibration_path(source)
    if calibration is not None and calibration.parent != source:
        yield calibration


READER = LogReader(is_sequence, read_pandaset, other_place, _files)


def _tables(source: Path, part: str) -> NumberedFiles:
    """Return the files of sweeps, boxes or classes; raise if they are in another folder."""
    files = numbered_files(source / part, TABLES)
    if not files.paths:
        check_not_elsewhere(source, part)
    return files


def _stem_digits(source: Path, cameras: tuple[str, ...], sweeps: NumberedFiles) -> int:
    """Return the number of digits of all stems.

    Files of one frame may be 000.jpg and 00.pkl, but later stages use one stem, which must sort as
    numbers do.
    """
    pictures = [numbered_files(source / "camera" / name, PICTURES) for name in cameras]
    return max(1, sweeps.digits, *(files.digits for files in pictures))


def _camera_names(
    source: Path, wanted: tuple[str, ...], rig: Rig
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the selected cameras, and others that are needed for the ego path only."""
    parent = source / "camera"
    available = [path.name for path in subfolders(parent)]
    if not available:
        raise InputError(
            "the log has no cameras", where=parent, remedy="SOURCE must be one PandaSet sequence."
        )
    for name in wanted:
        if name not in available:
            raise InputError(
                f"camera '{name}' is not in the log",
                where=source,
                expected=f"one of {', '.join(available)}",
            )
    names = tuple(dict.fromkeys(wanted)) or tuple(available)
    has_path = any(name in rig.camera_from_pandar64 for name in names)
    needs_helper = _EGO_CAMERA in available and (_EGO_CAMERA not in names or not has_path)
    return names, (_EGO_CAMERA,) if needs_helper else ()


def _select_frames(
    folders: list[CameraFolder], selection: FrameSelection, source: Path
) -> tuple[CameraFrame, ...]:
    frames = [f for folder in folders for f in folder.frames]
    selected = [frame for frame in frames if selection.holds(int(frame.stem))]
    if not selected:
        numbers = [int(frame.stem) for frame in frames]
        raise InputError(
            "the range of frames contains no picture",
            where=source,
            expected=f"frames within {min(numbers)}:{max(numbers) + 1}",
        )
    return tuple(sorted(selected, key=lambda frame: (frame.time_ns, frame.camera_name)))


def _check_clocks(source: Path, folders: tuple[CameraFolder, ...]) -> tuple[str, ...]:
    times = {
        source / "camera" / f.camera.name / "timestamps.json": f.world_from_camera.times_ns
        for f in folders
    }
    lidar = source / "lidar" / "timestamps.json"
    return check_clocks(times | ({lidar: read_times_ns(lidar)} if has_file(lidar) else {}))


def _check_rigid(
    source: Path, folders: tuple[CameraFolder, ...], ego: Trajectory
) -> tuple[str, ...]:
    notes: list[str] = []
    for f in folders:
        path = source / "camera" / f.camera.name / "poses.json"
        notes += check_rigid(path, ego, f.world_from_camera)
    return tuple(notes)


def _read_sweeps(
    source: Path,
    tables: Mapping[str, NumberedFiles],
    digits: int,
    ego: Trajectory,
    rig: Rig,
    selection: FrameSelection,
) -> _Sweeps:
    files = tables[SWEEPS].paths
    clock = source / SWEEPS / "timestamps.json"
    if not files and not (has_folder(clock.parent) and has_file(clock)):
        return _Sweeps((), {}, np.empty(0, dtype=np.int64))
    times_ns = read_times_ns(clock)
    sources: dict[int, SweepSource] = {}
    for number, path in files.items():
        if number >= len(times_ns):
            raise InputError(
                "the sweep's number exceeds the list of times",
                where=path,
                got=number,
                expected=f"0 to {len(times_ns) - 1}",
            )
        time_ns = int(times_ns[number])
        _require_covered(ego, time_ns, path)
        class_path = tables[CLASSES].paths.get(number)
        sources[number] = SweepSource(path, class_path, f"{number:0{digits}d}", time_ns, ego, rig)
    sources, notes = with_known_scale(sources)
    lazy = tuple(
        LazySweep(s.stem, s.time_ns, partial(load_sweep, s))
        for number, s in sources.items()
        if selection.holds(number)
    )
    return _Sweeps(lazy, sources, times_ns, notes)


def _require_covered(ego: Trajectory, time_ns: int, path: Path) -> None:
    if not ego.covers(time_ns, _EGO_HOLD_S):
        raise InputError(
            "the camera poses do not reach the file's time in lidar/timestamps.json",
            where=path,
            got=f"{time_ns} ns",
            expected=f"{ego.start_ns} to {ego.end_ns} ns",
            remedy="Cameras and LiDAR must be of one sequence.",
        )


def _read_actors(
    source: Path, files: NumberedFiles, ego: Trajectory, sweeps: _Sweeps
) -> tuple[tuple[ActorTrack, ...], tuple[str, ...]]:
    if not files.paths:
        return (), ()
    if len(sweeps.times_ns) == 0:
        raise InputError(
            "boxes need the sweeps' times",
            where=source / "lidar" / "timestamps.json",
            got="no such file",
            remedy="Copy it again from the original data set, or remove annotations/cuboids.",
        )
    notes: tuple[str, ...] = ()
    # The scan pattern is equal in all sweeps: one sweep is read for it.
    timing = ScanTiming.instantaneous()
    if sweeps.sources:
        timing = measure_timing(next(iter(sweeps.sources.values())))
    else:
        notes = ("without sweeps, boxes are timed at the end of the LiDAR's revolution",)
    cuboids: list[CuboidFile] = []
    for number, path in files.paths.items():
        if number >= len(sweeps.times_ns):
            raise InputError(
                "the label file's number exceeds the list of times",
                where=path,
                got=number,
                expected=f"0 to {len(sweeps.times_ns) - 1}",
            )
        time_ns = int(sweeps.times_ns[number])
        _require_covered(ego, time_ns, path)
        cuboids.append(CuboidFile(path, time_ns, ego.at(time_ns, _EGO_HOLD_S)))
    tracks, track_notes = read_tracks(cuboids, timing)
    return tracks, (*notes, *track_notes)


def _read_gps(source: Path, start_ns: int) -> GpsTrack | None:
    """Read the GPS fixes of a log that starts at a time; None if it has none.

    Raises:
        InputError: latitude or longitude is out of range, or all fixes are of another time.
    """
    path = source / "meta" / "gps.json"
    if not has_folder(path.parent) or not has_file(path):
        return None
    entries = require_list(read_json(path), path)
    times_ns = read_times_ns(source / "meta" / "timestamps.json")
    if len(entries) != len(times_ns):
        raise InputError(
            "GPS fixes and times differ in number",
            where=path,
            got=f"{len(entries)} fixes, {len(times_ns)} times",
            expected="one fix a time of meta/timestamps.json",
        )
    fixes = np.stack(
        [require_numbers(e, ("lat", "long"), f"{path}[{i}]") for i, e in enumerate(entries)]
    )
    track = gps_track(times_ns, fixes[:, 0], fixes[:, 1], lambda i: f"{path}[{i}]")
    gap_s = float(np.abs(times_ns - start_ns).min()) * 1e-9
    where = source / "meta" / "timestamps.json"
    LIMITS["gps gap"].check(where, gap_s, f"the nearest {gap_s:.4g} s away")
    return track


def _origin_notes(source: Path) -> tuple[str, ...]:
    if not has_file(source / SIMULATED_NAME):
        return ()
    return (f"the log was simulated, not recorded: {SIMULATED_NAME} names the source",)


def _missing_notes(
    folders: list[CameraFolder],
    tables: Mapping[str, NumberedFiles],
    selection: FrameSelection,
    class_names: Mapping[int, str],
) -> tuple[str, ...]:
    """Return notes on missing files of the selected frames."""
    by_camera = {
        f.camera.name: [n for n in map(int, (x.stem for x in f.frames)) if selection.holds(n)]
        for f in folders
    }
    frames = sorted({number for numbers in by_camera.values() for number in numbers})
    notes = [
        _lack_note(f"{name}: no picture", frames, numbers) for name, numbers in by_camera.items()
    ]
    sweeps, boxes, classes = (tables[part].paths for part in (SWEEPS, BOXES, CLASSES))
    nothing = (
        (sweeps, "no LiDAR sweeps, which geometry requires"),
        (boxes, "no labelled boxes: moving actors remain in the background"),
        (classes, "no point classes: materials are inferred without them"),
    )
    notes += [f"the log has {words}" for files, words in nothing if not files]
    if sweeps:
        notes.append(_lack_note("no LiDAR sweep", frames, sweeps))
    scanned = [number for number in frames if number in sweeps]
    if boxes:
        notes.append(_lack_note("no labelled boxes", scanned, boxes))
    if classes:
        notes.append(_lack_note("no point classes", scanned, classes))
        if not class_names:
            notes.append(f"no {CLASSES}/classes.json: the point classes have no names")
    return tuple(note for note in notes if note)


def _lack_note(what: str, wanted: list[int], there: Collection[int]) -> str:
    """Return a note on the missing numbers; empty if there are none."""
    missing = [number for number in wanted if number not in there]
    if not missing:
        return ""
    spans: list[list[int]] = []
    for number in missing:
        if spans and number == spans[-1][1] + 1:
            spans[-1][1] = number
        else:
            spans.append([number, number])
    words = [str(first) if first == last else f"{first} to {last}" for first, last in spans]
    more = len(words) - _SPANS_SHOWN
    shown = ", ".join(words[:_SPANS_SHOWN]) + (f" and {more} more gaps" if more > 0 else "")
    return f"{what} for {len(missing)} of {len(wanted)} frames: {shown}"
