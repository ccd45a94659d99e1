"""The recording and its fields: load, call one function, save. Order: pipeline.py."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from lightsim.align.build import align_log
from lightsim.align.config import AlignConfig
from lightsim.core.fields import SceneFields
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.core.sensors import CameraFrame
from lightsim.geometry.surface import background_levels, extract_surface
from lightsim.masks.sky import sky_mattes
from lightsim.pipeline.stages.context import Context
from lightsim.pipeline.suitability import check_sweeps, light_notes
from lightsim.pipeline.workspace import FIELD_CONFIG_NAME, FIELD_NAME, Workspace
from lightsim.progress import Progress
from lightsim.reconstruct.field.config import NeuralConfig
from lightsim.reconstruct.field.occupancy import Occupancy
from lightsim.reconstruct.field.ray_pool import Guide, PriorSurfaces
from lightsim.reconstruct.fusion.config import FuseConfig
from lightsim.reconstruct.fusion.tsdf import fuse_log
from lightsim.render.casters.embree import make_embree_caster
from lightsim.store.alignment import write_alignment
from lightsim.store.artefact import hash_names, write_json
from lightsim.store.checkpoint import FolderCheckpointer
from lightsim.store.fields import write_fields
from lightsim.store.images import write_png
from lightsim.store.log import write_log
from lightsim.store.weights import WeightsRecord, write_weights
from lightsim.version import __version__


def make_log(work: Workspace, config: LogReading, folder: Path, context: Context) -> Iterable[str]:
    """The reading, a summary and the hashes of the recording's files; no pixel is copied."""
    log = work.recorded_log
    check_sweeps(log, context.progress)
    write_log(folder, log, config, work.source_hashes)
    return (*log.notes, *light_notes(log))


def make_alignment(
    work: Workspace, config: AlignConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Corrections of path, boxes and cameras, found without held-out frames and sweeps."""
    alignment = align_log(
        work.recorded_training_log,
        config,
        rng=np.random.default_rng(context.seed),
        progress=context.progress,
    )
    write_alignment(folder, alignment)
    return alignment.notes


def make_masks(work: Workspace, _: None, folder: Path, context: Context) -> Iterable[str]:
    """One matte for every frame that building may look at."""
    log = work.recorded_training_log
    _write_mattes(log, log.frames, folder, context)
    return ()


def make_held_out_masks(work: Workspace, _: None, folder: Path, context: Context) -> Iterable[str]:
    """The mattes of held-out frames: measuring and relighting need them, building must not.

    What they know of surfaces, colours and sky is what building looks at.
    """
    frames = tuple(f for f in work.recorded_log.frames if f.stem in work.held_out)
    _write_mattes(work.recorded_training_log, frames, folder, context)
    return ()


def _write_mattes(
    log: DrivingLog, frames: Sequence[CameraFrame], folder: Path, context: Context
) -> None:
    """Mattes of frames by what the log shows; those that an interrupted run left are kept."""

    def path_of(frame: CameraFrame) -> Path:
        return folder / frame.camera_name / f"{frame.stem}.png"

    for camera in log.cameras:
        (folder / camera).mkdir(exist_ok=True)
    wanted = [frame for frame in frames if not path_of(frame).exists()]
    for frame, matte in sky_mattes(log, wanted, context.progress):
        planes = np.stack([matte.expected, matte.likeliest], axis=-1)
        write_png(path_of(frame), np.round(planes * 255).astype(np.uint8))


def make_fields(
    work: Workspace, config: FuseConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Signed-distance grids of background and actors, fused from the aligned sweeps."""
    fields = fuse_log(work.training_log, config, progress=context.progress)
    write_fields(folder, fields)
    return fields.notes


def make_neural(
    work: Workspace, config: NeuralConfig, folder: Path, context: Context
) -> Iterable[str]:
    """The neural field, trained on images and LiDAR from where the fused LiDAR stands."""
    fused, checkpointer = work.fused, FolderCheckpointer(folder)
    if config.steps == 0:
        write_fields(folder, fused)
        return (*fused.notes, "no neural field was trained; geometry is fused LiDAR alone")
    from lightsim.reconstruct.field.neural import Training, refine_by_field

    log = work.training_log
    training = Training(
        sample_guide(log, fused, config, context.progress),
        work.sky_matte,
        checkpointer,
        context.seed,
        context.device,
    )
    fields, field = refine_by_field(log, fused, config, training, progress=context.progress)
    write_fields(folder, fields)
    record = WeightsRecord(
        description="neural field of a log (docs/reconstruction.md)",
        command="lightsim build",
        training_data="images and LiDAR of the log of this folder",
        split_hash=hash_names({"frames": [f"{f.camera_name}/{f.stem}" for f in log.frames]}),
        seed=context.seed,
        steps=config.steps,
        scores="in the report of the build",
        licence="as the log allows",
        version=__version__,
    )
    write_weights(folder / FIELD_NAME, field.state_dict(), record)
    write_json(folder / FIELD_CONFIG_NAME, asdict(config))
    checkpointer.finish()
    return fields.notes


def sample_guide(
    log: DrivingLog, fields: SceneFields, config: NeuralConfig, progress: Progress
) -> Guide:
    """What tells a neural field where its rays are sampled: the meshes of the fused LiDAR where it
    learns a residual on it; else the space that has returns in it, by the log's rays alone."""
    if not config.has_prior:
        return Occupancy.of_returns(log, fields.path_m, fields.background_radius_m[-1], progress)
    at_origin = RigidTransform.identity("world", "actor")
    return PriorSurfaces(
        make_embree_caster(background_levels(fields, 0.03)),
        {
            actor_id: make_embree_caster([extract_surface(grid, 0.03).transformed(at_origin)])
            for actor_id, grid in fields.actors.items()
        },
    )
