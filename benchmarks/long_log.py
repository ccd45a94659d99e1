"""A long log made of a short one, and what its build takes; a Markdown table of stages.

    python benchmarks/long_log.py SOURCE OUT [--frames 80] [--image-scale 1] [--cameras a,b]
        [--neural-steps 200] [--until report]

SOURCE: a log in PandaSet's layout. OUT/log drives it there, back, and there again until it has
enough frames: on the way back time runs on while the car drives in reverse and everything else
moves backwards, so path and tracks stay continuous. Pictures, labels and points are the recorded
ones; poses and times are made for the moments at which a mirrored sensor saw them. Two things
cannot be: the rows of mirrored pictures are read upwards, and moving boxes of mirrored sweeps are
up to a sweep off. For time and memory that does not matter.

OUT/work is built a stage at a time, each in a process of its own, and OUT/stages.json keeps what
each took: an interrupted run goes on. "base" is the process before the stage begins.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.build import pipeline as pipeline
from lightsim.build.options import BuildOptions
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.reading import LogReading
from lightsim.datasets.files import read_json, read_times_ns
from lightsim.datasets.pandaset.cameras import read_poses
from lightsim.datasets.pandaset.numbered import PICTURES, numbered_files
from lightsim.datasets.pandaset.rig import READOUT_S, calibration_path, read_rig
from lightsim.datasets.safe_pickle import read_table
from lightsim.progress import LineProgress
from lightsim.store.artefact import peak_memory_mb, write_json
from lightsim.store.pandaset_tables import pose_entry, write_table

_SUFFIX = ".pkl.gz"
_SWEEP_NS = 100_000_000
"""PandaSet's LiDAR turns ten times a second; a sweep's time is its end."""


@dataclass(frozen=True)
class Drive:
    """There, back and there again.

    Args:
        numbers: recorded numbers of one way, ascending.
        start_ns: when the car turns back into the recording's direction.
        end_ns: when it begins to reverse.
        count: frames of the long log.
    """

    numbers: Sequence[int]
    start_ns: int
    end_ns: int
    count: int

    @property
    def visits(self) -> list[tuple[int, int]]:
        """Of each frame: recorded number, and on which way; no frame is seen twice in a row."""
        last = len(self.numbers) - 1
        places = [i % (2 * last) for i in range(self.count)]
        return [
            (self.numbers[min(place, 2 * last - place)], max(i - 1, 0) // last)
            for i, place in enumerate(places)
        ]

    def time_ns(self, recorded_ns: int, way: int, late_ns: int = 0) -> int:
        """When a recorded moment comes by.

        Args:
            late_ns: by how much a mirrored sensor gives the time later: it ends where the
                recorded one began.
        """
        trip_ns = self.end_ns - self.start_ns
        if way % 2 == 0:
            return recorded_ns + way * trip_ns
        return 2 * self.end_ns - recorded_ns + (way - 1) * trip_ns + late_ns


def make_log(source: Path, folder: Path, count: int) -> None:
    """Write the long log; a finished one is kept."""
    if folder.exists():
        return
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    cameras = sorted(path for path in (source / "camera").iterdir() if path.is_dir())
    seen = set.intersection(*(set(numbered_files(path, PICTURES).paths) for path in cameras))
    numbers = sorted(seen)
    clock = read_times_ns(source / "lidar" / "timestamps.json")
    # Half a sweep apart from the frames there, so that clocks of all sensors go on growing.
    start_ns = int(clock[numbers[0]]) - _SWEEP_NS
    drive = Drive(numbers, start_ns, int(clock[numbers[-1]]), count)
    rig = read_rig(source)
    for path in cameras:
        readout_s = rig.readout_s_by_camera.get(path.name, READOUT_S)
        _make_camera(path, partial / "camera" / path.name, drive, round(readout_s * 1e9))
    _make_sweeps(source, partial, drive)
    _make_fixes(source / "meta", partial / "meta", drive)
    calibration = calibration_path(source)
    if calibration is not None:
        shutil.copyfile(calibration, partial / calibration.name)
    partial.rename(folder)


def _make_camera(source: Path, folder: Path, drive: Drive, readout_ns: int) -> None:
    """Times mark the end of the readout: that of a mirrored picture is its first row's, and the
    pose is the one that the camera then has."""
    folder.mkdir(parents=True)
    own_ns = read_times_ns(source / "timestamps.json")
    path = Trajectory("world", "camera", own_ns, read_poses(source / "poses.json"))
    times_s, poses = [], []
    for place, (number, way) in enumerate(drive.visits):
        shutil.copyfile(source / f"{number:02d}.jpg", folder / f"{place:02d}.jpg")
        late_ns = 0 if way % 2 == 0 else readout_ns
        times_s.append(_s(drive.time_ns(int(own_ns[number]), way, late_ns)))
        matrix = path.held_at(np.array([own_ns[number] - late_ns]))[0]
        poses.append(pose_entry(RigidTransform("world", "camera", matrix)))
    _write(folder / "timestamps.json", times_s)
    _write(folder / "poses.json", poses)
    shutil.copyfile(source / "intrinsics.json", folder / "intrinsics.json")


def _make_sweeps(source: Path, folder: Path, drive: Drive) -> None:
    """Points with mirrored times, labels as they are; sweeps that are missing stay so."""
    clock = read_times_ns(source / "lidar" / "timestamps.json")
    times_s = []
    for place, (number, way) in enumerate(drive.visits):
        own, name = f"{number:02d}{_SUFFIX}", f"{place:02d}{_SUFFIX}"
        times_s.append(_s(drive.time_ns(int(clock[number]), way, _SWEEP_NS)))
        for labels in ("cuboids", "semseg"):
            _copy(source / "annotations" / labels / own, folder / "annotations" / labels / name)
        if way == 0 or not (source / "lidar" / own).is_file():
            _copy(source / "lidar" / own, folder / "lidar" / name)
            continue
        rows = dict(read_table(source / "lidar" / own, tuple("xyzitd")))
        rows["t"] = np.array([_s(drive.time_ns(round(t * 1e9), way)) for t in rows["t"]])
        write_table(folder / "lidar" / name, rows, "index")
    _write(folder / "lidar" / "timestamps.json", times_s)
    poses = read_json(source / "lidar" / "poses.json")
    _write(folder / "lidar" / "poses.json", [poses[number] for number, _ in drive.visits])
    classes = Path("annotations") / "semseg" / "classes.json"
    _copy(source / classes, folder / classes)


def _make_fixes(source: Path, folder: Path, drive: Drive) -> None:
    """GPS at the sweeps' moments."""
    if not (source / "gps.json").is_file():
        return
    clock, fixes = read_times_ns(source / "timestamps.json"), read_json(source / "gps.json")
    folder.mkdir(parents=True)
    made = [dict(fixes[number]) for number, _ in drive.visits]
    for fix, (_, way) in zip(made, drive.visits, strict=True):
        for key in ("xvel", "yvel"):
            fix[key] *= (-1) ** way
    times_s = [_s(drive.time_ns(int(clock[n]), way, _SWEEP_NS)) for n, way in drive.visits]
    _write(folder / "gps.json", made)
    _write(folder / "timestamps.json", times_s)


def _copy(own: Path, target: Path) -> None:
    if own.is_file():
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(own, target)


def _write(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def _s(time_ns: int) -> float:
    """To the microsecond, as recorded ones."""
    return round(time_ns * 1e-9, 6)


def main() -> None:
    options = _arguments()
    if options.stage:
        sys.stdout.write("\n" + json.dumps(_measure(options)) + "\n")
        return
    options.out.mkdir(parents=True, exist_ok=True)
    make_log(options.source, options.out / "log", options.frames)
    path = options.out / "stages.json"
    rows: dict[str, dict[str, float]] = read_json(path) if path.is_file() else {}
    names = [stage.name for stage in pipeline.STAGES]
    for name in names[: names.index(options.until) + 1]:
        if name not in rows:
            command = [sys.executable, *sys.argv, "--stage", name]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            rows[name] = json.loads(done.stdout.strip().splitlines()[-1])
            write_json(path, rows)
    _print_table(rows)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=80)
    parser.add_argument("--image-scale", type=float, default=1.0)
    parser.add_argument("--cameras", default="")
    parser.add_argument("--neural-steps", type=int, default=200)
    parser.add_argument("--until", default="report")
    parser.add_argument("--stage", help=argparse.SUPPRESS)
    return parser.parse_args()


def _measure(options: argparse.Namespace) -> dict[str, float]:
    """Build one more stage in this process."""
    reading = LogReading(
        source=str(options.out / "log"),
        image_scale=options.image_scale,
        cameras=tuple(filter(None, options.cameras.split(","))),
        hold_out=8,
    )
    build = BuildOptions(reading=reading, neural_steps=options.neural_steps)
    base, wall, processor = peak_memory_mb(), time.monotonic(), time.process_time()
    pipeline.build(options.out / "work", build, LineProgress(), until=options.stage)
    return {
        "base": base,
        "peak": peak_memory_mb(),
        "wall": time.monotonic() - wall,
        "processor": time.process_time() - processor,
    }


def _print_table(rows: dict[str, dict[str, float]]) -> None:
    lines = ["| stage | base MB | peak MB | wall s | processor s |", "|---|---:|---:|---:|---:|"]
    keys = ("base", "peak", "wall", "processor")
    for name, row in rows.items():
        lines.append(f"| {name} | {' | '.join(f'{row[key]:.0f}' for key in keys)} |")
    sums = [sum(row[key] for row in rows.values()) for key in ("wall", "processor")]
    peak = max(row["peak"] for row in rows.values())
    lines.append(f"| all | | {peak:.0f} | {sums[0]:.0f} | {sums[1]:.0f} |")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
