"""Training of the neural field by the common loop: its batches, losses and optimisers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lightsim.networks.devices import device_of
from lightsim.networks.loop import Learner, LoopConfig, Loss, Session, run_training
from lightsim.reconstruct.field.config import NeuralConfig
from lightsim.reconstruct.field.hash_grid.sparse_adam import SparseAdam
from lightsim.reconstruct.field.losses import scene_loss
from lightsim.reconstruct.field.ray_pool import RayPool
from lightsim.reconstruct.field.sampling import RayBatch
from lightsim.reconstruct.field.sdf_field import SceneField

# Seed of a step = seed * this prime + step: runs of different seeds have different batches.
_STEP_SEED = 1_000_003
# Learning rate of the hash tables. The rates were not measured alone; training as a whole is
# (docs/benchmarks/reconstruction.md).
_TABLE_RATE = 1e-2
# Learning rate of all other parameters.
_HEAD_RATE = 2e-3


@dataclass(frozen=True, eq=False)
class TrainingRays:
    """Camera rays and LiDAR rays from which batches are drawn."""

    camera: RayPool
    lidar: RayPool


def train_field(field: SceneField, rays: TrainingRays, seed: int, session: Session) -> None:
    """Train `field` in place, on its device, from the checkpointer's last state.

    The batch of a step depends on (seed, step) alone, so a resumed run yields the same field on the
    CPU.
    """
    config = field.config
    device = device_of(field)
    # Sparse Adam for the tables, because a batch reaches few entries; Adam for the rest.
    tables = [SparseAdam(table, learning_rate=_TABLE_RATE) for table in field.tables]
    dense = torch.optim.Adam(field.dense_parameters, lr=_HEAD_RATE, eps=1e-15)

    def losses(_: int, draw: int) -> Iterator[Loss]:
        generator = torch.Generator().manual_seed(seed * _STEP_SEED + draw)
        batch = _draw(rays, config, generator, device)
        loss, terms = scene_loss(field, batch, generator)
        terms["beta"] = field.beta
        if "mse_srgb" in terms:
            terms["psnr_db"] = -10 * torch.log10(terms["mse_srgb"].detach().clamp_min(1e-12))
        yield "field", loss, terms

    # The learning rates decrease to a tenth.
    loop = LoopConfig(config.steps, final_fraction=0.1, largest_gradient=None)
    learners = {"field": Learner(field, (*tables, dense))}
    run_training(learners, losses, loop, session, "train the field")


def _draw(
    rays: TrainingRays, config: NeuralConfig, generator: torch.Generator, device: torch.device
) -> RayBatch:
    """Draw the random camera and LiDAR rays of one step."""
    parts = []
    for pool, count in ((rays.camera, config.camera_batch), (rays.lidar, config.lidar_batch)):
        index = torch.randint(0, len(pool), (count,), generator=generator).numpy()
        parts.append(pool.rows(index))
    return batch_of(RayPool.joined(parts), device)


def batch_of(pool: RayPool, device: torch.device) -> RayBatch:
    """Convert rays to tensors on a device."""

    def tensor(array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(device)

    return RayBatch(*[tensor(getattr(pool, name)) for name in RayBatch.__dataclass_fields__])
