"""Measures against the ground truth of a synthetic log: relit frames, base colour, normals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from lightsim.appearance.intrinsic.decompose import decompose
from lightsim.build.assemble import roofs_over
from lightsim.build.quality.frame_report import FramesReport
from lightsim.build.quality.frames import FramesConfig, FrameTask, score_frames
from lightsim.build.source_light import SourceLight
from lightsim.build.stages.twin import TwinConfig
from lightsim.build.workspace import Workspace
from lightsim.core.buffers import BACKGROUND
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.scene import make_static_scene, without_actors
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import relight
from lightsim.store.exr import read_exr
from lightsim_lab.baselines.colour_transfer_tables import BASELINES
from lightsim_lab.metrics.base_colour import (
    BaseColourReport,
    BaseColourTask,
    score_base_colour,
)
from lightsim_lab.metrics.folders import folder_tasks
from lightsim_lab.metrics.lpips import ALL_MEASURES
from lightsim_lab.studies.true_surfaces import TrueSurfaces

_TRUTH_REMEDY = "Give the folder truth that lightsim synthesize wrote beside the log."


def relit_frames(
    work: Path, truth: Path, progress: Progress, config: FramesConfig | None = None
) -> FramesReport:
    """Score relit frames against the ground truth of a synthetic log, with copy, oracle affine copy
    and colour transfer as baselines; one condition for each target sky in TRUTH/relit.

    Skies are used in scene units, without scaling. The region `masked` excludes the (true) sky.

    Raises:
        InputError: `truth` is not a folder that `lightsim synthesize` wrote.
    """
    workspace = Workspace(work)
    folders = relit_folders(workspace, truth, RelightOptions(name="truth"), progress)
    return score_relit_folders(workspace, truth, folders, progress, config or ALL_MEASURES)


def score_relit_folders(
    workspace: Workspace,
    truth: Path,
    folders: Mapping[str, Mapping[str, Path]],
    progress: Progress,
    config: FramesConfig,
) -> FramesReport:
    """Score the frames that `relit_folders` returned, and the baselines, on surfaces."""
    surfaces = TrueSurfaces(truth / "scene.npz", workspace)
    tasks: list[FrameTask] = []
    for name, frames in folders.items():
        named = {"LightSim": frames["predicted"], **frames}
        tasks += folder_tasks(name, ["LightSim"], named, surfaces.is_surface, BASELINES)
    return score_frames(tasks, config, progress=progress)


def relit_folders(
    workspace: Workspace,
    truth: Path,
    options: RelightOptions,
    progress: Progress,
    *,
    with_all_frames: bool = False,
) -> dict[str, dict[str, Path]]:
    """Relight a log under the skies of its truth; return the folders of predicted, true and source
    frames, by sky.

    Args:
        options: skies, scale and frames are replaced by those of the truth.
        with_all_frames: also relight the frames without a truth in between.

    Raises:
        InputError: `truth` is not a folder that `lightsim synthesize` wrote.
    """
    conditions = sorted(p.name for p in (truth / "relit").glob("*") if p.is_dir())
    if not conditions:
        raise InputError("no relit ground truth", where=truth / "relit", expected="NAME/<camera>/")
    asked = options_of_truth(truth, conditions, options)
    if with_all_frames:
        asked = replace(asked, frames=options.frames)
    relit = relight(workspace.root, asked, progress)
    source = Path(workspace.reading.source) / "camera"
    return {
        name: {"predicted": made / "frames", "truth": truth / "relit" / name, "source": source}
        for name, made in zip(conditions, relit, strict=True)
    }


def options_of_truth(
    truth: Path, conditions: Sequence[str], options: RelightOptions
) -> RelightOptions:
    """Return the options of a relight under the skies and at the frames of the truth."""
    stems = sorted({int(p.stem) for p in (truth / "relit").glob("*/*/*") if p.stem.isdigit()})
    step = int(np.gcd.reduce(np.diff(stems))) if len(stems) > 1 else 1
    return replace(
        options,
        sky=tuple(str(truth / "skies" / f"{name}.exr") for name in conditions),
        sky_scale="none",
        frames=f"{stems[0]}:{stems[-1] + 1}:{step}",
        image_scale=1.0,
        overwrite=True,
    )


def base_colour(work: Path, truth: Path, progress: Progress) -> BaseColourReport:
    """Score the base colour of the twin's background against a synthetic log's truth. Baselines are
    division by the rendered light, and the radiance itself.

    Pixels are compared if the twin's depth differs from the true depth by at most 5 cm + 2 %.

    Raises:
        InputError: `truth` is not a folder that `lightsim synthesize` wrote, or holds no frame of
            the build.
    """
    workspace = Workspace(work)
    radiance, twin = workspace.assets.background, workspace.twin
    config = TwinConfig()
    source = SourceLight(
        workspace.training_log,
        workspace.assets,
        roofs_over(workspace.assets.background, workspace.rooflines),
        workspace.sky.dome,
        config.irradiance,
        0,
    )
    identity = RigidTransform.identity("world", "world")
    baseline = replace(config.intrinsic, method="divide")
    divided = decompose(radiance, source.on(identity), baseline, np.random.default_rng(0)).mesh
    meshes = {"labels": twin.assets.background, "divide": divided, "radiance": radiance}
    return base_colours_of(meshes, workspace, truth, progress)


def base_colours_of(
    meshes: Mapping[str, TriMesh], workspace: Workspace, truth: Path, progress: Progress
) -> BaseColourReport:
    """Score the base colours of several meshes of the background, by method; see `base_colour`."""
    log = workspace.log_at(1.0)
    paths = sorted((truth / "base_colour").glob("*/*.exr"))
    frames = {(f.camera_name, f.stem): f for f in log.frames}
    known = [p for p in paths if (p.parent.name, p.stem) in frames]
    if not known:
        raise InputError(
            "no true base colour of a frame of the build",
            where=truth / "base_colour",
            remedy=_TRUTH_REMEDY,
        )
    tasks = (_base_colour_task(truth, frames[p.parent.name, p.stem], log, meshes) for p in known)
    return score_base_colour(tasks, progress=progress)


def _base_colour_task(
    truth: Path, frame: CameraFrame, log: DrivingLog, meshes: Mapping[str, TriMesh]
) -> BaseColourTask:
    """Return the true and the rendered base colours of one frame, by mesh."""
    camera = log.cameras[frame.camera_name]

    def read(what: str) -> Float32[np.ndarray, "h w *c"]:
        return read_exr(truth / what / frame.camera_name / f"{frame.stem}.exr")

    def colour(mesh: TriMesh) -> Float32[np.ndarray, "h w 3"]:
        scene = without_actors(make_static_scene([mesh]))
        return render_gbuffers(scene, camera, frame).base_colour

    scene = without_actors(make_static_scene([next(iter(meshes.values()))]))
    depth = render_gbuffers(scene, camera, frame).depth_z_m
    true_depth = read("depth_z_m").reshape(depth.shape)
    is_static = np.rint(read("actor_index").reshape(depth.shape)) == BACKGROUND
    is_valid = is_static & np.isfinite(depth) & np.isfinite(true_depth)
    gap = np.abs(np.where(is_valid, depth, 0.0) - np.where(is_valid, true_depth, 0.0))
    is_valid &= gap < 0.05 + 0.02 * np.where(is_valid, true_depth, 0.0)
    return BaseColourTask(
        read("base_colour"),
        read("sun_visibility").reshape(depth.shape),
        read("normal_world"),
        is_valid,
        {name: partial(colour, mesh) for name, mesh in meshes.items()},
    )
