"""Measures of a built twin against its own recording: held-out images, LiDAR, sun and sky."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from lightsim.build.quality.frame_report import FrameRow, FramesReport
from lightsim.build.quality.frames import FramesConfig, FrameTask, score_frames
from lightsim.build.quality.geometry import (
    LidarScores,
    evaluate_lidar,
)
from lightsim.build.sample_guide import sample_guide
from lightsim.build.workspace import Workspace
from lightsim.core.colour import srgb8_from_linear
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.resample import resize_area
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import DigitalTwin, SkyEstimate
from lightsim.errors import ArtefactError, InputError
from lightsim.progress import Progress, SilentProgress
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.image import sky_image
from lightsim.render.transport.matrix import TransportConfig
from lightsim.scenario.replay import replay
from lightsim.store.artefact import read_json, write_json

LoadMask = Bool[np.ndarray, "h w"]
Show = Callable[[CameraFrame], UInt8[np.ndarray, "h w 3"]]
"""Returns the picture of a frame, 8-bit sRGB."""
MEASURES_NAME = "measures.json"
QUICK = FramesConfig(with_exposure=False)
"""Scores of a build: PSNR and SSIM of raw images. Fitted exposures, which load every image twice,
and LPIPS, which needs a network, are left out."""


@dataclass(frozen=True)
class Measures:
    """Results of the measures of a build.

    Args:
        lidar: LiDAR beams against the meshes.
        is_held_out: whether `lidar` is from held-out sweeps.
        frames: scores of held-out images; None if the build has no held-out frames.
    """

    lidar: LidarScores
    is_held_out: bool
    frames: FramesReport | None


def measure(work: Workspace, progress: Progress) -> Measures:
    """Compute all measures that need no ground truth."""
    # A fixed seed, so that builds with different seeds are compared on the same beams.
    lidar, is_held_out = lidar_error(work, progress, np.random.default_rng(0))
    frames = held_out_frames(work, progress, QUICK) if work.held_out else None
    return Measures(lidar, is_held_out, frames)


def write_measures(folder: Path, measures: Measures) -> None:
    """Write measures.json; scores without a value are null."""
    frames = None if measures.frames is None else measures.frames.json_rows()
    write_json(
        folder / MEASURES_NAME,
        {
            "lidar": measures.lidar,
            "is_held_out": measures.is_held_out,
            "held_out_frames": frames,
        },
    )


def read_measures(folder: Path) -> Measures:
    """Read measures.json.

    Raises:
        ArtefactError: the file is missing or broken.
    """
    path = folder / MEASURES_NAME
    value = read_json(path)
    try:
        rows = value["held_out_frames"]
        return Measures(
            LidarScores(**value["lidar"]),
            bool(value["is_held_out"]),
            None if rows is None else FramesReport(tuple(FrameRow.from_json(row) for row in rows)),
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise ArtefactError(
            "the file of measures is damaged", where=path, got=error, remedy="Build again."
        ) from error


def held_out_frames(
    workspace: Workspace,
    progress: Progress,
    config: FramesConfig | None = None,
    *,
    with_field: bool = False,
) -> FramesReport:
    """Score renderings of the twin at held-out frames; see `held_out_frame_tasks`."""
    tasks = held_out_frame_tasks(workspace, with_field=with_field)
    return score_frames(tasks, config or FramesConfig(), progress=progress)


def held_out_frame_tasks(workspace: Workspace, *, with_field: bool = False) -> list[FrameTask]:
    """Return the held-out frames with renderings of the twin.

    Methods are the twin's observed radiance, the nearest training image of the same camera as a
    trivial baseline, and, `with_field`, the neural field by volume rendering. The region `masked`
    excludes sky and ego vehicle.

    Raises:
        InputError: the build has no held-out frames.
        ArtefactError: `with_field`, and the build trained no field.
    """
    if not workspace.held_out:
        raise InputError(
            "the build has no held-out frames",
            where=workspace.root,
            remedy="Build with --hold-out 8 or another number.",
        )

    methods: dict[str, Show] = {
        "twin": observed_radiance(workspace),
        "nearest image": nearest_recorded(workspace),
    }
    if with_field:
        methods["field"] = _field_renderer(workspace)
    return held_out_tasks(workspace, methods)


def nearest_recorded(workspace: Workspace) -> Show:
    """Return the method that copies the camera's training picture nearest in time."""

    def nearest(frame: CameraFrame) -> UInt8[np.ndarray, "h w 3"]:
        frames = workspace.log.frames_of(frame.camera_name)
        others = [f for f in frames if f.stem not in workspace.held_out]
        return min(others, key=lambda f: abs(f.time_ns - frame.time_ns)).load_srgb8()

    return nearest


def observed_radiance(workspace: Workspace, sky: SkyEstimate | None = None) -> Show:
    """Return the method that renders observed radiance in front of the estimated sky.

    Args:
        sky: sky to use instead of the estimated one: for builds that end before the sky stage, or
            to compare the surfaces of builds alone.
    """
    log, assets, sky = workspace.log, workspace.assets, sky or workspace.sky
    renderer = FrameRenderer(assets.background, workspace.inferred, TransportConfig(), 0)
    scenario = replay(DigitalTwin(log, assets, sky), "held-out", log.frames)

    def render(frame: CameraFrame) -> UInt8[np.ndarray, "h w 3"]:
        camera = log.cameras[frame.camera_name]
        # Base colours of these meshes are observed radiance: no light is computed, so that errors
        # of the estimated light do not enter the score.
        buffers = renderer.geometry(scenario, frame, camera)
        behind = sky_image(sky.dome, camera, frame)
        radiance = np.where(buffers.has_surface[..., None], buffers.base_colour, behind)
        return srgb8_from_linear(radiance * assets.camera_gains[frame.camera_name])

    return render


def held_out_tasks(
    workspace: Workspace, methods: Mapping[str, Show], log: DrivingLog | None = None
) -> list[FrameTask]:
    """Return the held-out frames with the pictures of methods; pixels of sky and ego vehicle are
    not valid.

    Args:
        log: the log at the scale of the pictures; None: the log of the work folder.
    """
    # Masks of the recorded log: the aligned one has none if the build left them out (--no-refine),
    # but the pixels to score must not depend on the options of a build.
    ego_vehicle_masks = (log or workspace.recorded_log).ego_vehicle_masks
    log = log or workspace.log

    def is_valid(frame: CameraFrame) -> LoadMask:
        camera = log.cameras[frame.camera_name]
        matte = workspace.sky_matte(frame)[..., None]
        valid = resize_area(matte, camera.height_px, camera.width_px)[..., 0] < 0.5
        ego_vehicle = ego_vehicle_masks.get(frame.camera_name)
        return valid if ego_vehicle is None else valid & ~ego_vehicle

    return [
        FrameTask(
            frame.camera_name,
            frame.camera_name,
            frame.stem,
            frame.load_srgb8,
            {name: partial(show, frame) for name, show in methods.items()},
            partial(is_valid, frame),
        )
        for frame in log.frames
        if frame.stem in workspace.held_out
    ]


def _field_renderer(
    workspace: Workspace,
) -> Callable[[CameraFrame], UInt8[np.ndarray, "h w 3"]]:
    from lightsim.reconstruct.field.render_field import render_frame

    field, log = workspace.scene_field, workspace.training_log
    guide = sample_guide(log, workspace.fused, field.config, SilentProgress())
    return lambda frame: render_frame(field, workspace.log, frame, guide)


def lidar_error(
    workspace: Workspace, progress: Progress, rng: np.random.Generator
) -> tuple[LidarScores, bool]:
    """Return the error of LiDAR beams cast again on the meshes.

    Held-out sweeps are used if there are any; the second value is true in this case.
    """
    log, assets = workspace.log, workspace.assets
    log = log.without_ego_returns()
    held = tuple(s for s in log.sweeps if s.stem in workspace.held_out)

    def actors_at(time_ns: int) -> list[TriMesh]:
        return [
            assets.actors[track.actor_id].mesh.transformed(track.world_from_actor(time_ns))
            for track in log.actors_at(time_ns)
            if track.actor_id in assets.actors
        ]

    scores = evaluate_lidar(
        held or log.sweeps,
        [assets.background],
        actors_at,
        make_caster=make_embree_caster,
        rng=rng,
        progress=progress,
    )
    return scores, bool(held)
