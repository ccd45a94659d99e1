"""Training of sky networks, ours and the comparators, on the same data by the same loop."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor, nn

from lightsim.lighting.sample import LightingBatch, LightingData
from lightsim.networks.panorama import filled
from lightsim.networks.sky_terms import Draw, SkyTensors
from lightsim.progress import Progress
from lightsim.training.loop import Journal, LoopConfig, choose_device, run_training

_STEP_SEED = 1_000_003

Completion = Callable[
    [Float32[np.ndarray, "n h w 3"], Bool[np.ndarray, "n h w"]], Float32[np.ndarray, "n h w 3"]
]
"""Panoramas and what was seen of them -> panoramas with the rest inpainted."""


LossFunction = Callable[[Any, Draw, torch.Generator], tuple[Tensor, dict[str, Tensor]]]
"""(network, batches, generator) -> loss and its terms."""


# Share of the panoramas that is shown whole, as pictures without a log are.
_COMPLETE_SHARE = 0.25


@dataclass(frozen=True)
class SkyTrainConfig:
    """How a sky network is trained."""

    loop: LoopConfig = field(default_factory=LoopConfig)
    """Steps and learning rate."""
    batch: int = 8
    """Panoramas a step (and as many under clear suns, for the direction encoder)."""
    seed: int = 0
    """Of batches and of random teacher forcing."""
    workers: int = 0
    """Threads that make batches ahead of their use; 0 makes them when they are needed."""


@dataclass(frozen=True, eq=False)
class SkyRecipe:
    """A network (`SkyNetwork` or one of baselines/), its loss and how it is trained."""

    network: nn.Module
    loss: LossFunction
    config: SkyTrainConfig


def train_sky(
    recipe: SkyRecipe,
    data: LightingData,
    journal: Journal,
    *,
    complete: Completion | None = None,
    device: str = "auto",
    minutes: float | None = None,
    progress: Progress,
) -> int:
    """Train the recipe's network in place, going on from the journal's last state; the steps done.

    Args:
        recipe: what to train.
        data: panoramas under known skies.
        journal: keeps checkpoints and metrics.
        complete: inpaints what the cameras did not see; without it, smooth fills stand there.
        device: "auto", "cpu" or "cuda".
        minutes: stop then, to go on later.

    Raises:
        InputError: the device is not there.
    """
    target = choose_device(device)
    network, config = recipe.network.to(target), recipe.config

    batches = _Batches(data, config)

    def loss_of_step(step: int) -> tuple[Tensor, dict[str, Tensor]]:
        generator = torch.Generator().manual_seed(config.seed * _STEP_SEED + step)

        def draw(only_sunny: bool) -> SkyTensors:
            batch = batches.get(step, only_sunny)
            whole = torch.rand(config.batch, generator=generator).numpy() < _COMPLETE_SHARE
            return sky_tensors(batch, whole, complete, target)

        return recipe.loss(network, draw, generator)

    with batches:
        return run_training(
            network, loss_of_step, journal, config.loop, minutes=minutes, progress=progress
        )


class _Batches:
    """Batches by step and kind, made ahead of their use by threads."""

    def __init__(self, data: LightingData, config: SkyTrainConfig) -> None:
        self._data = data
        self._config = config
        self._pool = ThreadPoolExecutor(config.workers) if config.workers else None
        self._coming: dict[int, Future[LightingBatch]] = {}

    def get(self, step: int, only_sunny: bool) -> LightingBatch:
        # Even numbers are all skies, odd ones clear suns: data may draw both from one stream.
        number = 2 * step + int(only_sunny)
        if self._pool is None:
            return self._make(number)
        for later in range(number, number + 2 * (self._config.workers + 1), 2):
            if later // 2 < self._config.loop.steps and later not in self._coming:
                self._coming[later] = self._pool.submit(self._make, later)
        return self._coming.pop(number).result()

    def _make(self, number: int) -> LightingBatch:
        config = self._config
        return self._data.batch(config.batch, config.seed, number, only_sunny=number % 2 == 1)

    def __enter__(self) -> _Batches:
        return self

    def __exit__(self, *error: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)


def sky_tensors(
    batch: LightingBatch,
    is_whole: Bool[np.ndarray, " n"],
    complete: Completion | None,
    device: torch.device,
) -> SkyTensors:
    """A batch on the device; panoramas that are not shown whole are completed."""
    seen = batch.visibility | is_whole[:, None, None]
    panorama = batch.panorama
    if complete is not None:
        inpainted = complete(panorama * seen[..., None].astype(np.float32), seen)
        panorama = np.where(seen[..., None], panorama, inpainted)

    def image(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(np.moveaxis(array, -1, 1))).to(device)

    def vector(array: np.ndarray) -> Tensor:
        return torch.from_numpy(array.astype(np.float32)).to(device)

    tensors = SkyTensors(
        image(panorama),
        vector(seen)[:, None],
        image(batch.front),
        image(batch.sky),
        vector(batch.sun_direction),
        vector(batch.log_peak),
        vector(batch.is_sunny),
    )
    # Where nothing inpaints, the truth behind the mask must not leak to any network.
    return (
        tensors if complete else tensors.shown(filled(tensors.panorama, tensors.seen), tensors.seen)
    )
