"""Neural stage: the field, trained on images and LiDAR."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path

from lightsim.build.sample_guide import sample_guide
from lightsim.build.stages.context import Context
from lightsim.build.workspace import FIELD_CONFIG_NAME, FIELD_NAME, Workspace
from lightsim.core.log import DrivingLog
from lightsim.core.version import __version__
from lightsim.reconstruct.field.config import NeuralConfig
from lightsim.store.artefact import hash_names, write_json
from lightsim.store.checkpoint import FolderCheckpointer
from lightsim.store.fields import write_fields
from lightsim.store.weights import WeightsRecord, write_weights


def make_neural(
    work: Workspace, config: NeuralConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Train the neural field on images and LiDAR, starting from the fused LiDAR."""
    fused, checkpointer = work.fused, FolderCheckpointer(folder)
    if config.steps == 0:
        write_fields(folder, fused)
        return (*fused.notes, "no neural field was trained; geometry is fused LiDAR alone")
    # Imported late: torch loads slowly, and a stage without training needs none of it.
    from lightsim.reconstruct.field.neural import Training, refine_by_field

    log = _seen_by(work.training_log, config.cameras)
    config = config.with_steps_for(len(log.sweeps))
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
        description="neural field of a log (docs/concepts/fields.md)",
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
    # Last, after all results are written: an interruption before this line resumes the training.
    checkpointer.finish()
    return fields.notes


def _seen_by(log: DrivingLog, cameras: tuple[str, ...]) -> DrivingLog:
    """Return the log with the pictures of some cameras alone; of all without names."""
    # The cameras stay, so that the field has the gains of all of them in one order.
    frames = tuple(f for f in log.frames if not cameras or f.camera_name in cameras)
    return replace(log, frames=frames)
