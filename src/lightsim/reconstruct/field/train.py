"""The training loop of the neural field: resumable, deterministic, with metrics and progress."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from lightsim.progress import Progress
from lightsim.reconstruct.field.config import NeuralConfig
from lightsim.reconstruct.field.hash_grid.sparse_adam import SparseAdam
from lightsim.reconstruct.field.losses import scene_loss
from lightsim.reconstruct.field.ray_pool import RayPool
from lightsim.reconstruct.field.sampling import RayBatch
from lightsim.reconstruct.field.sdf_field import SceneField

_WARM_UP = 50
_LAST_RATE = 0.1
_RECORD_EVERY = 25
_SAVE_EVERY_S = 60.0
_STEP_SEED = 1_000_003


# Not measured alone; training as a whole is (docs/benchmarks/reconstruction.md).

# Learning rate of the grids.
_TABLE_RATE = 1e-2
# Learning rate of everything else.
_HEAD_RATE = 2e-3


@runtime_checkable
class Journal(Protocol):
    """Where training keeps what must survive an interruption; store/checkpoint.py writes files."""

    def load(self) -> dict[str, Any] | None: ...

    def save(self, state: dict[str, Any]) -> None: ...

    def record(self, metrics: dict[str, float]) -> None: ...


@dataclass(frozen=True, eq=False)
class TrainingRays:
    """The two kinds of rays a batch is drawn from."""

    camera: RayPool
    lidar: RayPool


def train_field(
    field: SceneField,
    rays: TrainingRays,
    journal: Journal,
    seed: int,
    *,
    progress: Progress,
) -> None:
    """Train `field` in place for its config's steps, going on from the journal's last state.

    Every step draws its batch from (seed, step) alone: an interrupted run that goes on gives the
    very same field on the CPU.
    """
    config = field.config
    device = next(field.parameters()).device
    optimisers = _Optimisers(field, config)
    first = 0
    state = journal.load()
    if state is not None:
        first = optimisers.restore(state)
    saved = started = time.monotonic()
    for step in progress.track(range(first, config.steps), "train the field", config.steps - first):
        generator = torch.Generator().manual_seed(seed * _STEP_SEED + step)
        batch = _draw(rays, config, generator, device)
        optimisers.clear()
        loss, terms = scene_loss(field, batch, generator)
        loss.backward()
        optimisers.step(_rate(step, config.steps))
        if step % _RECORD_EVERY == 0 or step == config.steps - 1:
            journal.record(_metrics(step, loss, terms, field, time.monotonic() - started))
        if time.monotonic() - saved > _SAVE_EVERY_S or step == config.steps - 1:
            journal.save(optimisers.state(step + 1))
            saved = time.monotonic()


class _Optimisers:
    """Sparse Adam for the tables, Adam for the rest, and their state in one dictionary."""

    def __init__(self, field: SceneField, config: NeuralConfig) -> None:
        self._field = field
        self._config = config
        self._sparse = [SparseAdam(t, learning_rate=_TABLE_RATE) for t in field.tables]
        self._dense = torch.optim.Adam(field.dense_parameters, lr=_HEAD_RATE, eps=1e-15)

    def clear(self) -> None:
        self._dense.zero_grad()
        for table in self._field.tables:
            table.grad = None

    def step(self, rate: float) -> None:
        for optimiser in self._sparse:
            optimiser.step(_TABLE_RATE * rate)
        for group in self._dense.param_groups:
            group["lr"] = _HEAD_RATE * rate
        self._dense.step()

    def state(self, step: int) -> dict[str, Any]:
        return {
            "step": step,
            "field": self._field.state_dict(),
            "sparse": [optimiser.state_dict() for optimiser in self._sparse],
            "dense": self._dense.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> int:
        self._field.load_state_dict(state["field"])
        for optimiser, saved in zip(self._sparse, state["sparse"], strict=True):
            optimiser.load_state_dict(saved)
        self._dense.load_state_dict(state["dense"])
        return int(state["step"])


def _rate(step: int, steps: int) -> float:
    """Warm-up, then a half cosine down to a tenth."""
    warm = min(1.0, (step + 1) / _WARM_UP)
    share = step / max(steps - 1, 1)
    return warm * (_LAST_RATE + (1 - _LAST_RATE) * 0.5 * (1 + math.cos(math.pi * share)))


def _draw(
    rays: TrainingRays, config: NeuralConfig, generator: torch.Generator, device: torch.device
) -> RayBatch:
    """Random camera and LiDAR rays of one step."""
    parts = []
    for pool, count in ((rays.camera, config.camera_batch), (rays.lidar, config.lidar_batch)):
        index = torch.randint(0, len(pool), (count,), generator=generator).numpy()
        parts.append(pool.rows(index))
    return batch_of(RayPool.joined(parts), device)


def batch_of(pool: RayPool, device: torch.device) -> RayBatch:
    """Rays as tensors."""

    def tensor(array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(device)

    return RayBatch(*[tensor(getattr(pool, name)) for name in RayBatch.__dataclass_fields__])


def _metrics(
    step: int,
    loss: Tensor,
    terms: dict[str, Tensor],
    field: SceneField,
    seconds: float,
) -> dict[str, float]:
    """One line of metrics.jsonl; `psnr_db` is that of the training batch."""
    values = {name: float(value.detach()) for name, value in terms.items()}
    if "mse_srgb" in values:
        values["psnr_db"] = -10 * math.log10(max(values["mse_srgb"], 1e-12))
    return {
        "step": float(step),
        "seconds": seconds,
        "loss": float(loss.detach()),
        "beta": float(field.beta.detach()),
        **values,
    }
