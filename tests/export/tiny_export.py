"""The log of a scenario whose every answer is known: a box that drives past a moving camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from tests.render.rendering_scenes import look_at
from tests.tiny_world import BOX_LWH_M, STEP_NS

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.frame_labels import ActorLabel, Box, FrameLabels
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.scenario import FrameSource
from lightsim.core.sensors import CameraFrame, LazySweep, LidarSweep
from lightsim.export.scenario_log import ScenarioLog
from lightsim.store.images import read_srgb8, write_png

STEMS = ("04", "05", "06")
LENS = PinholeCamera("front", 96, 64, 96.0, 90.0, 47.0, 33.0)
SIDE = replace(LENS, name="side")
FIRST_NS = 1_557_539_956_000_000_000
LICENCE = "CC BY-NC-SA 4.0"
LIDAR_M = np.array([0.5, 0.1, 1.9])
"""Position of the LiDAR, frame `ego`."""
_DELAY_NS = {"front": 0, "side": 20_000_000}


def ego_path() -> Trajectory:
    """It drives along x at 2 m/s and turns to the left."""
    times_ns = FIRST_NS + np.arange(-1, 5, dtype=np.int64) * STEP_NS
    poses = [
        RigidTransform.from_yaw("world", "ego", 0.02 * n, np.array([-20.0 + n, 1.0, 0.2])).matrix
        for n in range(-1, 5)
    ]
    return Trajectory("world", "ego", times_ns, np.stack(poses))


def mount(name: str) -> RigidTransform:
    """The front camera looks ahead, the other one to the left."""
    at = np.array([1.0, 0.3, 1.6])
    target = at + ([10.0, 0.0, 0.0] if name == "front" else [0.0, 10.0, 0.0])
    return RigidTransform("ego", "camera", look_at(at.tolist(), target.tolist()).matrix)


def box_track(kind: ActorKind = ActorKind.CAR, actor_id: str = "car") -> ActorTrack:
    times_ns = FIRST_NS + np.arange(3, dtype=np.int64) * STEP_NS
    poses = [
        RigidTransform.from_yaw("world", "actor", 0.3 + 0.1 * n, np.array([0, 5.0 * (n - 1), 0.75]))
        for n in range(3)
    ]
    matrices = np.stack([pose.matrix for pose in poses])
    return ActorTrack(
        actor_id, kind, BOX_LWH_M, Trajectory("world", "actor", times_ns, matrices), True
    )


def camera_of(name: str) -> PinholeCamera:
    return LENS if name == "front" else SIDE


def box_mask(frame: CameraFrame, track: ActorTrack) -> np.ndarray:
    """Pixels whose ray meets the box, by slabs."""
    camera = camera_of(frame.camera_name)
    origins, directions = frame.pixel_rays(camera, camera.pixel_centres().reshape(-1, 2))
    actor_from_world = track.world_from_actor(frame.time_ns).inverse()
    start = actor_from_world.apply(origins)
    along = actor_from_world.rotate(directions)
    with np.errstate(divide="ignore"):
        ends = [(side * BOX_LWH_M / 2 - start) / along for side in (-1.0, 1.0)]
    enter, leave = np.minimum(*ends).max(axis=1), np.maximum(*ends).min(axis=1)
    return ((leave > enter) & (leave > 0)).reshape(camera.height_px, camera.width_px)


def edges(mask: np.ndarray) -> Box:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def label_of(mask: np.ndarray, visible: np.ndarray) -> ActorLabel:
    visible_px, amodal_px = int(visible.sum()), int(mask.sum())
    box = edges(visible) if visible_px else None
    return ActorLabel("car", 0, visible_px, amodal_px, visible_px / amodal_px, box, edges(mask))


@dataclass(frozen=True)
class Labels:
    """Labels of the box; a fraction of its columns, from the left, is hidden."""

    track: ActorTrack
    hidden: float = 0.0

    def __call__(self, frame: CameraFrame) -> FrameLabels:
        mask = box_mask(frame, self.track)
        nothing = np.full(mask.shape, -1, dtype=np.int32)
        if not mask.any():
            return FrameLabels((), nothing)
        left, _, right, _ = edges(mask)
        visible = mask.copy()
        visible[:, : round(left + self.hidden * (right - left))] = False
        return FrameLabels((label_of(mask, visible),), np.where(visible, 0, nothing))


def sweep_of(stem: str, time_ns: int, track: ActorTrack) -> LidarSweep:
    """Three points in the box, and one far from it."""
    pose = track.world_from_actor(time_ns)
    inside = pose.apply(np.array([[1.9, 0.9, 0.5], [-1.9, 0.0, 0.0], [0.0, -0.9, -0.7]]))
    points = np.concatenate([inside, [[30.0, 30.0, 1.0]]]).astype(np.float32)
    origin = ego_path().at(time_ns).apply(LIDAR_M[None]).astype(np.float32)
    return LidarSweep(
        stem, time_ns, points, np.repeat(origin, 4, axis=0),
        np.array([0.0, 0.2, 0.5, 1.0], np.float32), np.zeros(4, np.float32),
        np.arange(4, dtype=np.int16), np.full(4, -1, np.int16),
    )  # fmt: skip


def tiny_log(
    folder: Path,
    track: ActorTrack | None = None,
    labels: Callable[[CameraFrame], FrameLabels] | None = None,
) -> ScenarioLog:
    """The log of three frames of two cameras; pictures show the box in white."""
    track = track or box_track()
    frames: list[CameraFrame] = []
    for number, stem in enumerate(STEMS):
        for name in ("front", "side"):
            time_ns = FIRST_NS + number * STEP_NS + _DELAY_NS[name]
            pose = ego_path().at(time_ns) @ mount(name)
            path = folder / name / f"{stem}.png"
            frame = CameraFrame(name, stem, time_ns, pose, partial(read_srgb8, path))
            path.parent.mkdir(parents=True, exist_ok=True)
            grey = np.uint8(255) * box_mask(frame, track)
            write_png(path, np.repeat(grey[..., None], 3, axis=2))
            frames.append(frame)
    times = [FIRST_NS + number * STEP_NS for number in range(len(STEMS))]
    sweeps = tuple(
        LazySweep(stem, time_ns, partial(sweep_of, stem, time_ns, track))
        for stem, time_ns in zip(STEMS, times, strict=True)
    )
    cameras = {"front": LENS, "side": SIDE}
    log = DrivingLog(
        "tiny", cameras, tuple(frames), sweeps, ego_path(), (track,), None, {}, licence=LICENCE
    )
    source: dict[tuple[str, str], FrameSource] = {
        (f.camera_name, f.stem): "composite" for f in frames
    }
    return ScenarioLog(
        log,
        labels or Labels(track),
        lambda frame: folder / frame.camera_name / f"{frame.stem}.png",
        source,
        frozenset(STEMS[:1]),
        {"sky": "sun:120,30"},
        ({"do": "remove", "actor": "all"},),
        "street",
        "0123456789abcdef" * 2,
    )
