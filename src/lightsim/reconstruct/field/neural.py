"""Neural reconstruction: from fused LiDAR and images to refined fields (paper Sec. 3.1, 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from lightsim.core.fields import SceneFields
from lightsim.core.log import DrivingLog
from lightsim.networks.devices import choose_device
from lightsim.networks.loop import Checkpointer, Session
from lightsim.progress import Progress
from lightsim.reconstruct.field.config import NeuralConfig
from lightsim.reconstruct.field.ray_pool import Guide, SkyMatte, camera_rays, lidar_rays
from lightsim.reconstruct.field.refine import refined_fields
from lightsim.reconstruct.field.sdf_field import SceneField
from lightsim.reconstruct.field.train import TrainingRays, train_field
from lightsim.reconstruct.field.tsdf_prior import TsdfPrior

# Number of camera rays, and number of LiDAR rays, that are drawn once; batches are drawn from them.
# Sensitivity not measured.
_POOL = 1_500_000


@dataclass(frozen=True, eq=False)
class Training:
    """Inputs of training besides the log and its fused LiDAR.

    Args:
        guide: geometry that guides samples: meshes of the fused LiDAR, or occupied space.
        sky_matte: sky alpha of a frame.
        checkpointer: stores checkpoints and metrics.
        seed: of rays, initial values and batches.
        device: "auto", "cpu" or "cuda".
    """

    guide: Guide
    sky_matte: SkyMatte
    checkpointer: Checkpointer
    seed: int = 0
    device: str = "auto"


def refine_by_field(
    log: DrivingLog,
    fields: SceneFields,
    config: NeuralConfig,
    training: Training,
    *,
    progress: Progress,
) -> tuple[SceneFields, SceneField]:
    """Train the neural field on a log; return the fields with its distances, and the field.

    Raises:
        InputError: the log has no image or no sweep, or the device is not available.
    """
    rng = np.random.default_rng(training.seed)
    rays = TrainingRays(
        camera_rays(log, _POOL, training.guide, training.sky_matte, rng, progress),
        lidar_rays(log, _POOL, training.guide, rng, progress),
    )
    field = make_field(log, fields, config, training.seed).to(choose_device(training.device))
    train_field(field, rays, training.seed, Session(training.checkpointer, progress))
    return refined_fields(fields, field, progress=progress), field


def make_field(log: DrivingLog, fields: SceneFields, config: NeuralConfig, seed: int) -> SceneField:
    """Make an untrained field of a log."""
    return SceneField(
        config,
        tuple(actor.actor_id for actor in log.actors),
        tuple(log.cameras),
        TsdfPrior.of(fields) if config.has_prior else None,
        torch.Generator().manual_seed(seed),
    )
