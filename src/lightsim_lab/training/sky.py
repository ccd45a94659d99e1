"""Training of the sky networks: the estimator, the paper's form, and baselines."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor, nn

from lightsim.errors import InputError
from lightsim.lighting.sample import LightingBatch, LightingData
from lightsim.lighting.sky.panorama_layers import filled
from lightsim.lighting.sky.sky_terms import Draw, SkyTensors
from lightsim.networks.devices import choose_device
from lightsim.networks.loop import Learner, LoopConfig, Loss, Session, run_training
from lightsim_lab.training.prefetch import Prefetcher

# Prime that separates the random streams of different seeds; larger than any number of steps.
_STEP_SEED = 1_000_003

# Function from panoramas and visibility masks to inpainted panoramas.
Completion = Callable[
    [Float32[np.ndarray, "n h w 3"], Bool[np.ndarray, "n h w"]], Float32[np.ndarray, "n h w 3"]
]


# Function from network, batches and random generator to the loss and its terms.
LossFunction = Callable[[Any, Draw, torch.Generator], tuple[Tensor, dict[str, Tensor]]]


# Fraction of the panoramas without a mask: the networks are also applied to complete panoramas.
# Sensitivity not measured.
_COMPLETE_FRACTION = 0.25


@dataclass(frozen=True)
class SkyTrainConfig:
    """Settings of the training of a sky network."""

    loop: LoopConfig = field(default_factory=LoopConfig)
    """Number of steps, and averaging of the weights."""
    rate: float = 1e-3
    """Highest learning rate of AdamW."""
    weight_decay: float = 1e-3
    """Weight decay of AdamW."""
    batch: int = 8
    """Panoramas per step (and as many under clear suns, for the direction encoder)."""
    seed: int = 0
    """Seed of the batches and of teacher forcing."""
    workers: int = 0
    """Threads that prepare batches in advance; 0: each batch is made when it is needed."""


@dataclass(frozen=True, eq=False)
class SkyRecipe:
    """Network (`SkyNetwork` or one of baselines/), its loss and its training settings."""

    network: nn.Module
    loss: LossFunction
    config: SkyTrainConfig
    height_px: int
    """Rows of the network's panoramas."""


def train_sky(
    recipe: SkyRecipe,
    data: LightingData,
    session: Session,
    complete: Completion | None = None,
) -> int:
    """Train a network in place, from the last checkpoint if there is one; return the steps done.

    Args:
        data: panoramas under known skies.
        session: device and duration; each of its processes takes `batch` panoramas per step.
        complete: inpainting of the unobserved pixels; None: smooth continuation.

    Raises:
        InputError: the device is not available, or the data have another size.
    """
    if data.height_px != recipe.height_px:
        raise InputError(
            "the network requires panoramas of another size",
            where="--data, --preset",
            got=f"{2 * data.height_px}x{data.height_px} px",
            expected=f"{2 * recipe.height_px}x{recipe.height_px} px",
            remedy="Make the data with lightsim train prepare lighting --height"
            f" {recipe.height_px}, or choose the preset of their size.",
        )
    target = choose_device(session.device)
    network, config = recipe.network.to(target), recipe.config

    def make(number: int) -> LightingBatch:
        return data.batch(config.batch, config.seed, number, only_sunny=number % 2 == 1)

    def losses(_: int, draw: int) -> Iterator[Loss]:
        generator = torch.Generator().manual_seed(config.seed * _STEP_SEED + draw)

        def drawn(only_sunny: bool) -> SkyTensors:
            # Even numbers are batches of all skies, odd ones of clear suns: one sequence for both.
            batch = batches.get(2 * draw + int(only_sunny))
            whole = torch.rand(config.batch, generator=generator).numpy() < _COMPLETE_FRACTION
            return sky_tensors(batch, whole, complete, target)

        yield "sky", *recipe.loss(network, drawn, generator)

    adam = torch.optim.AdamW(network.parameters(), lr=config.rate, weight_decay=config.weight_decay)
    stride = 2 * session.processes.count
    learners = {"sky": Learner(network, (adam,), is_averaged=True)}
    with Prefetcher(make, config.workers, stride, stride * config.loop.steps) as batches:
        return run_training(learners, losses, config.loop, session)


def sky_tensors(
    batch: LightingBatch,
    is_whole: Bool[np.ndarray, " n"],
    complete: Completion | None,
    device: torch.device,
) -> SkyTensors:
    """Convert a batch to tensors on a device, with masked panoramas completed.

    Args:
        is_whole: panoramas without a mask.
    """
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
    # Without inpainting, smooth fills replace masked pixels, so that the truth does not leak.
    return (
        tensors if complete else tensors.shown(filled(tensors.panorama, tensors.seen), tensors.seen)
    )
