"""Intrinsics, times, poses, GPS and calibration of a written log."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from lightsim.build.workspace import Workspace
from lightsim.core.frames import RigidTransform
from lightsim.core.scenario import Scenario
from lightsim.datasets.files import read_json, require_list
from lightsim.datasets.geo import east_north_m
from lightsim.datasets.pandaset.cameras import read_poses
from lightsim.datasets.pandaset.rig import calibration_path, ego_from_pandar64
from lightsim.errors import InputError
from lightsim.export.pandaset.sweeps import motion_of
from lightsim.store.artefact import write_text
from lightsim.store.pandaset_tables import pose_entry

T = TypeVar("T")
# Step in degrees over which metres per degree count as constant, about 100 m.
_DEGREE = 1e-3


@dataclass(frozen=True)
class WrittenFrames:
    """Frames of a recording that are written, and their file names.

    Args:
        recorded_stems: by the recorded number, which is the index in the recording's lists.
    """

    recorded_stems: dict[int, str]

    @classmethod
    def of(cls, scenario: Scenario, sweep_stems: Sequence[str]) -> WrittenFrames:
        """Return the frames that all cameras of a scenario have, and the LiDAR if there are sweeps.

        Raises:
            InputError: no frame has a picture of every camera and a sweep.
        """
        of_camera = [
            {int(f.stem) for f in scenario.frames if f.camera_name == name}
            for name in scenario.cameras
        ]
        sweeps = [{int(stem) for stem in sweep_stems}] if sweep_stems else []
        # Readers of PandaSet expect the same number of files from every sensor.
        numbers = set.intersection(*of_camera, *sweeps)
        if not numbers:
            raise InputError(
                "no frame has a picture of every camera and a sweep",
                where="--write-log",
                expected="one frame or more",
                remedy="Choose other --frames or --cameras.",
            )
        stems = {int(frame.stem): frame.stem for frame in scenario.frames}
        return cls({number: stems[number] for number in sorted(numbers)})

    @property
    def numbers(self) -> tuple[int, ...]:
        """Recorded numbers, ascending."""
        return tuple(self.recorded_stems)

    @property
    def stems(self) -> dict[int, str]:
        """New stems by the recorded number; they sort like numbers."""
        # At least two digits, as in PandaSet.
        width = max(2, len(str(len(self.recorded_stems) - 1)))
        return {number: f"{place:0{width}d}" for place, number in enumerate(self.recorded_stems)}

    def entries(self, path: Path) -> list[Any]:
        """Return the entries of a recorded list for the written frames, as far as it has them."""
        return self.of_list(require_list(read_json(path), path))

    def of_list(self, values: Sequence[T]) -> list[T]:
        """Return the values for the written frames, given by recorded number, as far as there are
        any."""
        return [values[number] for number in self.numbers if number < len(values)]


class ListWriter:
    """Writer of all lists of a simulated log.

    Entries are the recorded ones, transformed if the ego vehicle drives another path.
    """

    def __init__(
        self, workspace: Workspace, recorded: Scenario, scenario: Scenario, frames: WrittenFrames
    ) -> None:
        self._workspace = workspace
        self._recorded, self._scenario = recorded, scenario
        self._frames = frames
        self._source = Path(workspace.reading.source)
        self._is_ego_moved = scenario.ego is not recorded.ego

    def write(self, folder: Path) -> None:
        """Write intrinsics.json, poses.json, timestamps.json, gps.json and the calibration."""
        self._write_cameras(folder / "camera")
        for here in ("lidar", "meta"):
            path = self._source / here / "timestamps.json"
            if path.is_file():
                (folder / here).mkdir(parents=True, exist_ok=True)
                _write(folder / here / path.name, self._frames.entries(path))
        if (self._source / "lidar" / "timestamps.json").is_file():
            _write(folder / "lidar" / "poses.json", self._lidar_poses())
        if (self._source / "meta" / "gps.json").is_file():
            _write(folder / "meta" / "gps.json", self._fixes())
        calibration = calibration_path(self._source)
        if calibration is not None:
            text = calibration.read_text(encoding="utf-8")
            # Edited as text, so that comments and order of the calibration are preserved.
            text = _without_readout(text, self._driven_cameras)
            write_text(folder / calibration.name, text)

    @property
    def _driven_cameras(self) -> set[str]:
        """Cameras of a changed ego path, whose images have a global shutter even if recorded ones
        roll."""
        if not self._is_ego_moved:
            return set()
        return {f.camera_name for f in self._scenario.frames if f.shutter is None}

    def _write_cameras(self, folder: Path) -> None:
        for name, camera in self._scenario.cameras.items():
            own = self._source / "camera" / name
            (folder / name).mkdir(parents=True, exist_ok=True)
            lens = read_json(own / "intrinsics.json")
            if (camera.fx, camera.fy) != (lens["fx"], lens["fy"]):
                # The images are scaled. PandaSet's origin is the first pixel's centre.
                lens |= {"fx": camera.fx, "fy": camera.fy}
                lens |= {"cx": camera.cx - 0.5, "cy": camera.cy - 0.5}
            _write(folder / name / "intrinsics.json", lens)
            times = self._frames.entries(own / "timestamps.json")
            poses = self._frames.entries(own / "poses.json")
            if name in self._driven_cameras:
                # Images with a global shutter have the time and pose of the recorded middle row.
                log = self._workspace.recorded_log
                rows = {int(f.stem): f for f in log.frames_of(name)}
                chosen = [rows[number] for number in self._frames.numbers]
                times = [round(f.time_ns * 1e-9, 6) for f in chosen]
                poses = [pose_entry(self._motion(f.time_ns) @ f.world_from_camera) for f in chosen]
            elif self._is_ego_moved:
                stored = self._frames.of_list(list(read_poses(own / "poses.json")))
                poses = [
                    pose_entry(self._motion(_ns(t)) @ RigidTransform("world", name, pose))
                    for t, pose in zip(times, stored, strict=True)
                ]
            _write(folder / name / "timestamps.json", times)
            _write(folder / name / "poses.json", poses)

    def _motion(self, time_ns: int) -> RigidTransform:
        """Return the rigid motion from the recorded ego path to the scenario's, in the recorded
        world."""
        assert self._recorded.ego is not None
        assert self._scenario.ego is not None
        times = np.array([time_ns], dtype=np.int64)
        matrix = motion_of(self._recorded.ego, self._scenario.ego, times)[0]
        # The correction of the ego path is undone: files are in the recorded world.
        motion, path = RigidTransform("world", "world", matrix), self._workspace.alignment.path
        return motion if path is None else path.at(time_ns).inverse() @ motion @ path.at(time_ns)

    def _lidar_poses(self) -> list[Any]:
        """Return the recorded poses, or the LiDAR's poses on the ego path if there are none."""
        path = self._source / "lidar" / "poses.json"
        # Without a change the recorded text is copied, free of rounding.
        if path.is_file() and not self._is_ego_moved:
            return self._frames.entries(path)
        times_ns = [_ns(t) for t in self._frames.entries(path.with_name("timestamps.json"))]
        if path.is_file():
            stored = self._frames.of_list(list(read_poses(path)))
            poses = [RigidTransform("world", "pandar64", pose) for pose in stored]
        else:
            ego = self._workspace.recorded_log.ego
            poses = [ego.held(time_ns) @ ego_from_pandar64() for time_ns in times_ns]
        if self._is_ego_moved:
            poses = [self._motion(t) @ pose for t, pose in zip(times_ns, poses, strict=False)]
        return [pose_entry(pose) for pose in poses]

    def _fixes(self) -> list[Any]:
        """Return the GPS fixes of the scenario's path; velocities remain the recorded ones."""
        fixes = self._frames.entries(self._source / "meta" / "gps.json")
        log = self._workspace.recorded_log
        if not self._is_ego_moved or log.geo is None or log.geo.enu_from_world is None:
            return fixes
        times_s = self._frames.entries(self._source / "meta" / "timestamps.json")
        for fix, time_s in zip(fixes, times_s, strict=True):
            was = log.ego.held(_ns(time_s))
            step = (self._motion(_ns(time_s)) @ was).translation_m - was.translation_m
            east, north, up = log.geo.enu_from_world.rotate(step[None])[0].tolist()
            lat, long = fix["lat"], fix["long"]
            # Degrees per metre at the fix, by differences of the reader's own projection.
            beside = np.array([lat, lat + _DEGREE]), np.array([long, long + _DEGREE])
            east_m, north_m = east_north_m(*beside)[1].tolist()
            fix["lat"] = lat + _DEGREE * north / north_m
            fix["long"] = long + _DEGREE * east / east_m
            if isinstance(fix.get("height"), int | float):
                fix["height"] += up
        return fixes


def _write(path: Path, value: Any) -> None:
    """Write recorded entries unchanged, with NaN, which JSON lacks and Python's readers accept."""
    write_text(path, json.dumps(value, indent=1) + "\n")


def _ns(time_s: float) -> int:
    """Return nanoseconds, rounded to the microsecond like in the reader."""
    return int(np.rint(time_s * 1e6)) * 1000


def _without_readout(calibration: str, cameras: set[str]) -> str:
    """Return a calibration in which some cameras have no rolling shutter."""
    lines: list[str] = []
    name = ""
    for line in calibration.splitlines(keepends=True):
        if line[:1].strip():
            name = line.partition("#")[0].rstrip().removesuffix(":")
            lines.append(line)
            if name in cameras:
                lines.append("  readout_s: 0.0\n")
        elif name not in cameras or not line.strip().startswith("readout_s:"):
            lines.append(line)
    return "".join(lines)
