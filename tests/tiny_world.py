"""A world whose every answer is known: level ground, a box that drives over it, one camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tests.render.rendering_scenes import box, look_at, plane

from lightsim.build.quality.metrics import psnr
from lightsim.build.workspace import Workspace
from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.buffers import GBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import SkyDome
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import ActorAsset, DigitalTwin, SceneAssets, SkyEstimate
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.scenario.replay import replay

STEMS = ("00", "01", "02")
STEP_NS = 500_000_000
BOX_LWH_M = np.array([4.0, 2.0, 1.5])
STEP_M = 5.0
"""The box drives so far along world y from frame to frame."""
GROUND = np.array([0.3, 0.4, 0.5], np.float32)
GAIN = np.array([1.1, 1.0, 0.9], np.float32)
LENS = PinholeCamera("above", 96, 96, 96.0, 96.0, 48.0, 48.0)
ABOVE = look_at([0.0, 0.0, 30.0], [0.0, 0.0, 0.0], up=(0.0, 1.0, 0.0))
"""A pixel of LENS covers 0.31 m of the ground."""
AHEAD = look_at([-20.0, 3.1, 2.03], [0.0, 3.1, 2.03])
"""Half sky, half ground."""
NOTHING = plane(cells=0)


class TinyWorkspace(Workspace):
    """A finished build that nobody built; `values` stand for what its artefacts hold."""

    def __init__(self, **values: Any) -> None:
        super().__init__(Path("tiny"))
        self.__dict__.update(held_out=frozenset(), inferred=NOTHING, rooflines=[], **values)
        self.__dict__.update(uncertain_roofs=None)
        self.mattes: Mapping[str, np.ndarray] = {}

    @property
    def unobserved_occluders(self) -> TriMesh:
        return NOTHING

    def log_at(self, image_scale: float) -> DrivingLog:
        assert image_scale == 1.0
        return self.log

    def sky_matte(self, frame: CameraFrame) -> np.ndarray:
        return self.mattes[frame.stem]

    def likeliest_sky(self, frame: CameraFrame) -> np.ndarray:
        return self.mattes[frame.stem]


def unseen() -> np.ndarray:
    raise AssertionError("nobody asked for this picture")


def driving_box() -> tuple[ActorAsset, ActorTrack]:
    times_ns = np.arange(len(STEMS), dtype=np.int64) * STEP_NS
    poses = np.tile(np.eye(4), (len(STEMS), 1, 1))
    poses[:, 1, 3] = STEP_M * (np.arange(len(STEMS)) - 1)
    poses[:, 2, 3] = BOX_LWH_M[2] / 2
    track = ActorTrack(
        "car", ActorKind.CAR, BOX_LWH_M, Trajectory("world", "actor", times_ns, poses), True
    )
    mesh = replace(box((0, 0, 0), BOX_LWH_M, 0.2), frame="actor")
    return ActorAsset("car", ActorKind.CAR, mesh), track


def tiny_world(
    sky: SkyDome,
    view: RigidTransform = ABOVE,
    background: TriMesh | None = None,
    **values: Any,
) -> TinyWorkspace:
    """The workspace of a log of three frames; its pictures are made by `take_pictures`."""
    asset, track = driving_box()
    frames = tuple(
        CameraFrame("above", stem, number * STEP_NS, view, unseen)
        for number, stem in enumerate(STEMS)
    )
    ego = Trajectory("world", "ego", track.trajectory.times_ns, np.tile(np.eye(4), (3, 1, 1)))
    log = DrivingLog("tiny", {"above": LENS}, frames, (), ego, (track,), None, {})
    background = plane(60.0, 1, GROUND) if background is None else background
    assets = SceneAssets(background, {"car": asset}, {"above": GAIN})
    estimate = SkyEstimate(sky, None, 0.0, "image", 0.0, 0.0, np.zeros(3, np.float32), 0.0)
    logs = dict.fromkeys(("log", "recorded_log", "training_log"), log)
    twin = DigitalTwin(log, assets, estimate)
    return TinyWorkspace(twin=twin, assets=assets, sky=estimate, **logs | values)


def with_pictures(work: TinyWorkspace, pictures: Mapping[str, np.ndarray]) -> TinyWorkspace:
    """The same with recorded pictures (8-bit sRGB, by stem) and their sky mattes."""
    frames = tuple(replace(f, load_srgb8=lambda p=pictures[f.stem]: p) for f in work.log.frames)
    log = replace(work.log, frames=frames)
    work.__dict__.update(
        log=log, recorded_log=log, training_log=log, twin=replace(work.twin, log=log)
    )
    work.mattes = {f.stem: (~sees_surface(f)).astype(np.float32) for f in frames}
    return work


def scenario_of(work: TinyWorkspace) -> Scenario:
    return replay(work.twin, "tiny", work.log.frames, "recorded")


def rendered(work: TinyWorkspace, frame: CameraFrame, sky: SkyDome) -> tuple[GBuffers, Any]:
    """Geometry and light of one frame."""
    from lightsim.render.transport.matrix import TransportConfig

    renderer = FrameRenderer(work.assets.background, NOTHING, TransportConfig(), 0)
    traced = renderer.trace(scenario_of(work), frame, LENS)
    buffers, light = traced.buffers, traced.light(sky)
    return buffers, light


def rays(frame: CameraFrame) -> tuple[np.ndarray, np.ndarray]:
    """Origin and unit directions through the pixels' centres, [h, w, 3]."""
    directions = LENS.directions(LENS.pixel_centres())
    return frame.world_from_camera.translation_m, frame.world_from_camera.rotate(directions)


def ground_points(frame: CameraFrame) -> np.ndarray:
    """Where the pixels' rays meet the plane z = 0; NaN above the horizon, [h, w, 3]."""
    origin, directions = rays(frame)
    with np.errstate(divide="ignore"):
        distance = -origin[2] / directions[..., 2:]
    return np.where(distance > 0, origin + distance * directions, np.nan)


def sees_surface(frame: CameraFrame) -> np.ndarray:
    """Pixels that see ground (60 m to every side) or the box, [h, w]."""
    origin, directions = rays(frame)
    is_ground = (np.abs(ground_points(frame)[..., :2]) <= 60.0).all(axis=-1)
    return is_ground | meets_box(np.broadcast_to(origin, directions.shape), directions, frame)


def meets_box(origins: np.ndarray, directions: np.ndarray, frame: CameraFrame) -> np.ndarray:
    """Whether rays meet the box where it stands at the frame's time, by slabs."""
    centre = driving_box()[1].world_from_actor(frame.time_ns).translation_m
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = [(centre + side * BOX_LWH_M / 2 - origins) / directions for side in (-1.0, 1.0)]
        enter = np.minimum(*ends).max(axis=-1)
        leave = np.maximum(*ends).min(axis=-1)
    return (leave > np.maximum(enter, 0.0)) & np.isfinite(origins).all(axis=-1)


def in_shadow(frame: CameraFrame, sun_direction: np.ndarray) -> np.ndarray:
    """Pixels whose point of the ground the box shades at the frame's time, [h, w]."""
    points = ground_points(frame)
    return meets_box(points, np.broadcast_to(sun_direction, points.shape), frame)


def on_ground(frame: CameraFrame) -> np.ndarray:
    """Pixels that see the ground and not the box, [h, w]."""
    origin, directions = rays(frame)
    is_box = meets_box(np.broadcast_to(origin, directions.shape), directions, frame)
    return sees_surface(frame) & ~is_box


def overlap(found: np.ndarray, wanted: np.ndarray) -> float:
    """Intersection over union of two masks."""
    return float((found & wanted).sum() / (found | wanted).sum())


def psnr_db(predicted: np.ndarray, truth: np.ndarray) -> float:
    """Of two 8-bit pictures."""
    return psnr(*(x.astype(np.float32) / 255 for x in (predicted, truth)))
