"""The log of a finished scenario, from which all formats are written."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.core.actors import ActorTrack
from lightsim.core.frame_labels import FrameLabels
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.core.scenario import FrameSource
from lightsim.core.sensors import CameraFrame, LazySweep, LidarSweep
from lightsim.errors import InputError


@dataclass(frozen=True, eq=False)
class ScenarioLog:
    """A relit or simulated log with its labels.

    Args:
        log: cameras and ego path of the scenario, its actors without removed ones, its pictures
            and sweeps.
        labels: returns the labels of a picture.
        picture_path: returns the lossless file of a picture.
        source: of each picture before relighting, by camera and stem.
        simulated_sweeps: stems of sweeps with simulated returns; the others are the recorded ones.
        sky: target sky and its facts, as in scenario.json.
        edits: differences from the recording, as in scenario.json.
        recording: name of the recording.
        key: artefact key of the frames.
        notes: unusual facts, such as sweeps that do not show the edits.
    """

    log: DrivingLog
    labels: Callable[[CameraFrame], FrameLabels]
    picture_path: Callable[[CameraFrame], Path]
    source: Mapping[tuple[str, str], FrameSource]
    simulated_sweeps: frozenset[str]
    sky: Mapping[str, Any]
    edits: tuple[Mapping[str, Any], ...]
    recording: str
    key: str
    notes: tuple[str, ...] = ()

    @cached_property
    def sweep_by_stem(self) -> dict[str, LazySweep]:
        """Sweeps by stem; the sweep of a frame has its stem."""
        return {sweep.stem: sweep for sweep in self.log.sweeps}

    @cached_property
    def ego_from_lidar(self) -> RigidTransform:
        """Pose of an upright LiDAR, with axes parallel to `ego` and its origin at the sensor's
        mean position."""
        if not self.log.sweeps:
            return RigidTransform.identity("ego", "lidar")
        lazy = self.log.sweeps[0]
        origins = lazy.load().origins_world.astype(np.float64)
        at_ego = self.log.ego.held(lazy.time_ns).inverse().apply(origins.mean(axis=0)[None])[0]
        return RigidTransform.from_rotation("ego", "lidar", np.eye(3), at_ego)

    def ego_from_camera(self, name: str) -> RigidTransform:
        """Return the mount of a camera, that of its first picture."""
        frame = self.log.frames_of(name)[0]
        return self.log.ego.held(frame.time_ns).inverse() @ frame.world_from_camera

    def camera(self, name: str) -> str:
        """Return a camera's name, by default that of the front camera.

        Raises:
            InputError: there is no such camera.
        """
        if name and name not in self.log.cameras:
            raise InputError(
                "there is no such camera",
                where="--camera",
                got=name,
                expected=f"one of {', '.join(self.log.cameras)}",
            )
        return name or next(iter(self.log.ahead_by_camera))


def count_returns(track: ActorTrack, sweep: LidarSweep | None) -> int:
    """Return the number of returns in an actor's box as labelled, without margin."""
    if sweep is None:
        return 0
    return len(track.returns_inside(sweep.points_world, sweep.times_ns, margin_m=0.0)[0])
