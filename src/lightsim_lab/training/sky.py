"""Training of sky networks, ours and the comparators, on the same data by the same loop."""

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
from lightsim_lab.training.ahead import Ahead

_STEP_SEED = 1_000_003

Completion = Callable[
    [Float32[np.ndarray, "n h w 3"], Bool[np.ndarray, "n h w"]], Float32[np.ndarray, "n h w 3"]
]
"""Panoramas and what was seen of them -> panoramas with the rest inpainted."""


LossFunction = Callable[[Any, Draw, torch.Generator], tuple[Tensor, dict[str, Tensor]]]
"""(network, batches, generator) -> loss and its terms."""


# Fraction of the panoramas that is shown whole, as pictures without a log are.
_COMPLETE_FRACTION = 0.25


@dataclass(frozen=True)
class SkyTrainConfig:
    """How a sky network is trained."""

    loop: LoopConfig = field(default_factory=LoopConfig)
    """Steps and averages."""
    rate: float = 1e-3
    """Highest learning rate (AdamW)."""
    weight_decay: float = 1e-3
    """Of AdamW."""
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
    height_px: int
    """Rows of the panoramas that the network is for."""


def train_sky(
    recipe: SkyRecipe,
    data: LightingData,
    session: Session,
    complete: Completion | None = None,
) -> int:
    """Train the recipe's network in place from the last checkpoint on; the steps done.

    Args:
        recipe: what to train.
        data: panoramas under known skies.
        session: where and how long; each of its processes takes `batch` panoramas a step.
        complete: inpaints what the cameras did not see; without it, smooth fills stand there.

    Raises:
        InputError: the device is not there, or the data are of another size.
    """
    if data.height_px != recipe.height_px:
        raise InputError(
            "the network is for panoramas of another size",
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
            # Even numbers are all skies, odd ones clear suns: data may draw both from one stream.
            batch = batches.get(2 * draw + int(only_sunny))
            whole = torch.rand(config.batch, generator=generator).numpy() < _COMPLETE_FRACTION
            return sky_tensors(batch, whole, complete, target)

        yield "sky", *recipe.loss(network, drawn, generator)

    adam = torch.optim.AdamW(network.parameters(), lr=config.rate, weight_decay=config.weight_decay)
    stride = 2 * session.processes.count
    learners = {"sky": Learner(network, (adam,), is_averaged=True)}
    with Ahead(make, config.workers, stride, stride * config.loop.steps) as batches:
        return run_training(learners, losses, config.loop, session)


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
