"""From a twin and a target sky to relit frames and video: scenario -> buffers -> frames -> mp4.

One frame is in memory at a time; a finished frame is a finished file, so an interrupted run goes
on where it stopped.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.checks import MAX_EXPOSURE_EV, check_number, check_seed
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.dome import SkyDome
from lightsim.core.frames import points_rotated
from lightsim.core.log import DrivingLog
from lightsim.core.resample import resize_area
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.edit.timeline import replay
from lightsim.errors import InputError
from lightsim.ingest.selection import FrameSelection
from lightsim.progress import Progress
from lightsim.relighting.compose import camera_image
from lightsim.relighting.ratio import RatioConfig, RelightInputs, relight_physical
from lightsim.render.transport import TransportConfig
from lightsim.scene_setup import FrameRenderer
from lightsim.skies import SkyChoice, TargetSky, resolve_sky
from lightsim.store.artefact import (
    Recipe,
    json_ready,
    make_artefact,
    read_record,
    write_json,
)
from lightsim.store.images import read_srgb8, write_exr, write_png
from lightsim.store.lock import LOCK_NAME, locked
from lightsim.store.log import MIN_IMAGE_SCALE
from lightsim.store.mp4 import Mp4Writer
from lightsim.store.names import is_harmless
from lightsim.workspace import Workspace

_SCHEMA = 2
_STAGE = "relight"


@dataclass(frozen=True)
class RelightOptions:
    """What `lightsim relight` is asked for.

    Args:
        name: of the result folder: letters, digits, and . _ - after the first.
        sky: target sky.
        method: "physical".
        exposure_ev: exposure of the output, stops.
        cameras: empty for all.
        frames: START:STOP[:STEP] over the log's own frame numbers, empty for all.
        image_scale: factor on the log's image size; None for that of the build.
        is_linear_written: also write linear EXR frames.
        seed: of the sampling of rays.
        is_overwriting: replace a scenario of this name that was made with other settings.
        is_stale_allowed: go on where the recording has changed since the build.

    Raises:
        InputError: the name is not one for a folder, or a number is out of range.
    """

    name: str
    sky: SkyChoice
    method: str = "physical"
    exposure_ev: float = 0.0
    cameras: tuple[str, ...] = ()
    frames: str = ""
    image_scale: float | None = None
    is_linear_written: bool = False
    seed: int = 0
    is_overwriting: bool = False
    is_stale_allowed: bool = False

    def __post_init__(self) -> None:
        if not is_harmless(self.name):
            raise InputError(
                "the name is not fit for a folder",
                where="--name",
                got=repr(self.name[:40]),
                expected="letters, digits and . _ -, a letter or digit first",
            )
        check_number("--exposure-ev", self.exposure_ev, -MAX_EXPOSURE_EV, MAX_EXPOSURE_EV)
        if self.image_scale is not None:
            check_number("--image-scale", self.image_scale, MIN_IMAGE_SCALE, 1.0)
        check_seed(self.seed)

    def settings(self, image_scale: float) -> dict[str, Any]:
        """All that decides the frames besides twin and sky file."""
        return {
            "sky": self.sky.made_from,
            "method": self.method,
            "exposure_ev": self.exposure_ev,
            "cameras": list(self.cameras),
            "frames": self.frames,
            "image_scale": image_scale,
            "is_linear_written": self.is_linear_written,
        }


@dataclass(frozen=True, eq=False)
class RelitFrame:
    """One relit frame and what it was made of.

    Args:
        frame: of the log.
        image_srgb8: as the camera would have recorded it.
        radiance: linear, scene units, before gain and exposure.
        buffers: geometry.
        source: light of the source sky.
        target: light of the target sky.
        source_srgb8: the recorded image.
    """

    frame: CameraFrame
    image_srgb8: UInt8[np.ndarray, "h w 3"]
    radiance: Float32[np.ndarray, "h w 3"]
    buffers: GBuffers
    source: ShadowBuffers
    target: ShadowBuffers
    source_srgb8: UInt8[np.ndarray, "h w 3"]


def relight(work: Path, options: RelightOptions, progress: Progress) -> Path:
    """Relight the log of a work folder; returns WORK/scenarios/NAME.

    Raises:
        ArtefactError: the twin has not been built or is damaged, the recording has changed since,
            or another command is at work there.
        InputError: the sky, a camera or a frame range is wrong, or the name holds a scenario of
            other settings.
    """
    workspace = Workspace(work, is_stale_allowed=options.is_stale_allowed)
    workspace.need("twin")
    folder = work / "scenarios" / options.name
    with locked(work / LOCK_NAME, is_shared=True):
        folder.parent.mkdir(exist_ok=True)
        with locked(folder.parent / f".{folder.name}{LOCK_NAME}"):
            _relight(workspace, folder, options, progress)
    return folder


def _relight(
    workspace: Workspace, folder: Path, options: RelightOptions, progress: Progress
) -> None:
    scale = options.image_scale or workspace.reading.image_scale
    settings = options.settings(scale)
    inputs = {"twin": workspace.record("twin")["key"]}
    recipe = Recipe(_STAGE, _SCHEMA, settings, inputs, options.seed)
    if not options.is_overwriting:
        _refuse_other_settings(folder, recipe)
    log = workspace.log_at(scale)
    frames = select_frames(log, options.cameras, options.frames)
    target = resolve_sky(options.sky, workspace)

    def make(partial: Path) -> Iterable[str]:
        twin = replace(workspace.twin, log=log)
        scenario = replay(twin, options.name, frames)
        relighter = Relighter(workspace, log, target, options)
        _write_frames(partial, scenario, relighter, options, progress)
        _write_videos(partial, scenario, progress)
        write_json(partial / "scenario.json", scenario_summary(scenario, log, target, settings))
        from lightsim.reports import write_relight_report

        write_relight_report(partial / "report.html", partial, scenario, relighter, target)
        return ()

    make_artefact(folder, recipe, make)


def _refuse_other_settings(folder: Path, recipe: Recipe) -> None:
    """A finished scenario goes only when the user says so, or when its twin was built anew."""
    record = read_record(folder)
    if record is None or record["stage"] != recipe.stage:
        return
    was = {**record["config"], "seed": record.get("seed")}
    now = {**json_ready(recipe.config), "seed": recipe.seed}
    differing = [key for key in now if was.get(key) != now[key]]
    if differing:
        raise InputError(
            "a scenario of this name was made with other settings",
            where=folder,
            got=", ".join(f"{key} = {was.get(key)}" for key in differing),
            expected=", ".join(f"{key} = {now[key]}" for key in differing),
            remedy="Choose another --name, or give --overwrite.",
        )


def select_frames(
    log: DrivingLog, cameras: tuple[str, ...], frames: str
) -> tuple[CameraFrame, ...]:
    """The frames of the named cameras whose stem lies in START:STOP[:STEP]."""
    chosen = FrameSelection.parse(frames)
    names = cameras or tuple(log.cameras)
    found = tuple(f for name in names for f in log.frames_of(name) if chosen.holds(int(f.stem)))
    if not found:
        raise InputError(
            "no frame lies in the chosen range",
            where=f"--frames {frames}",
            expected=f"frames {log.stems[0]} to {log.stems[-1]}",
        )
    return found


class Relighter:
    """Renders and relights single frames of one workspace under one target sky."""

    def __init__(
        self, workspace: Workspace, log: DrivingLog, target: TargetSky, options: RelightOptions
    ) -> None:
        self.log = log
        self.target = target
        self._workspace = workspace
        self._options = options
        self._renderer = FrameRenderer(
            workspace.twin.assets.background,
            workspace.shadow_casters,
            TransportConfig(),
            options.seed,
        )
        level = [d.horizontal_irradiance() for d in (workspace.sky.dome, target.dome)]
        self._level_ratio = (level[1] / np.maximum(level[0], 1e-9)).astype(np.float32)
        self._skies = [self._renderer.prepare(dome) for dome in (workspace.sky.dome, target.dome)]

    def relit(self, frame: CameraFrame, scenario: Scenario) -> RelitFrame:
        """One frame under the target sky."""
        camera = self.log.cameras[frame.camera_name]
        gain = self._workspace.twin.assets.camera_gains[frame.camera_name]
        buffers, (source, target) = self._renderer.render(scenario, frame, camera, self._skies)
        source_srgb8 = frame.load_srgb8()
        matte = resize_area(
            self._workspace.sky_matte(frame)[..., None], camera.height_px, camera.width_px
        )[..., 0]
        inputs = RelightInputs(
            radiance=(linear_from_srgb8(source_srgb8) / gain).astype(np.float32),
            is_clipped=np.any(source_srgb8 >= 254, axis=-1),
            sky_matte=matte,
            buffers=buffers,
            source=source,
            target=target,
            target_sky=sky_image(self.target.dome, camera, frame),
            source_sun=self._skies[0].sun,
            target_sun=self._skies[1].sun,
        )
        radiance = relight_physical(inputs, RatioConfig())
        own_car = self.log.own_car_masks.get(frame.camera_name)
        if own_car is not None:
            # It moves with the camera and has no mesh: lit as a level surface in the open.
            radiance[own_car] = inputs.radiance[own_car] * self._level_ratio
        image = camera_image(radiance, gain, self._options.exposure_ev)
        return RelitFrame(frame, image, radiance, buffers, source, target, source_srgb8)


def sky_image(
    dome: SkyDome, camera: PinholeCamera, frame: CameraFrame
) -> Float32[np.ndarray, "h w 3"]:
    """The dome as a camera sees it, pixel by pixel."""
    directions = camera.directions(camera.pixel_centres())
    rotation = frame.world_from_camera.rotation
    return dome.look_up(points_rotated(directions, rotation)).astype(np.float32)


def _write_frames(
    folder: Path,
    scenario: Scenario,
    relighter: Relighter,
    options: RelightOptions,
    progress: Progress,
) -> None:
    for frame in progress.track(scenario.frames, "relight", len(scenario.frames)):
        path = folder / "frames" / frame.camera_name / f"{frame.stem}.png"
        linear = folder / "linear" / frame.camera_name / f"{frame.stem}.exr"
        if path.exists():
            continue
        result = relighter.relit(frame, scenario)
        if options.is_linear_written:
            linear.parent.mkdir(parents=True, exist_ok=True)
            write_exr(linear, result.radiance)
        path.parent.mkdir(parents=True, exist_ok=True)
        # The PNG comes last: it marks the frame as finished.
        write_png(path, result.image_srgb8)


def _write_videos(folder: Path, scenario: Scenario, progress: Progress) -> None:
    (folder / "video").mkdir(exist_ok=True)
    cameras = list(dict.fromkeys(f.camera_name for f in scenario.frames))
    for name in progress.track(cameras, "video", len(cameras)):
        frames = [f for f in scenario.frames if f.camera_name == name]
        images = (read_srgb8(folder / "frames" / name / f"{f.stem}.png") for f in frames)
        first = read_srgb8(folder / "frames" / name / f"{frames[0].stem}.png")
        height, width = first.shape[:2]
        with Mp4Writer(
            folder / "video" / f"{name}.mp4", width, height, frame_rate(frames)
        ) as video:
            for image in images:
                video.write(image)


def frame_rate(frames: list[CameraFrame]) -> float:
    """Frames per second of one camera by the median interval; 10 for a single frame."""
    if len(frames) < 2:
        return 10.0
    intervals_s = np.diff([f.time_ns for f in frames]) / 1e9
    return float(round(1.0 / float(np.median(intervals_s)), 3))


def scenario_summary(
    scenario: Scenario, log: DrivingLog, target: TargetSky, settings: Mapping[str, Any]
) -> dict[str, Any]:
    """scenario.json: the sky, the settings, and the actors' boxes of every frame."""
    frames = [
        {
            "camera": frame.camera_name,
            "frame": frame.stem,
            "time_ns": frame.time_ns,
            "world_from_camera": frame.world_from_camera.matrix.tolist(),
            "actors": [
                {
                    "actor_id": track.actor_id,
                    "kind": track.kind,
                    "size_lwh_m": track.size_lwh_m.tolist(),
                    "world_from_actor": track.world_from_actor(frame.time_ns).matrix.tolist(),
                }
                for track in log.actors_at(frame.time_ns)
            ],
        }
        for frame in scenario.frames
    ]
    return {
        "version": 1,
        "name": scenario.name,
        "options": dict(settings),
        "sky": target.facts,
        "edits": list(scenario.edits),
        "frames": frames,
    }
