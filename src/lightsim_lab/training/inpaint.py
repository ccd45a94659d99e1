"""Adversarial training of the inpainting of panoramas."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lightsim.errors import InputError
from lightsim.lighting.panorama.inpaint_network import (
    TOTAL_STRIDE,
    InpaintGenerator,
    PatchDiscriminator,
)
from lightsim.lighting.sample import PanoramaBatch, PanoramaData
from lightsim.networks.devices import choose_device
from lightsim.networks.loop import Learner, LoopConfig, Loss, Session, run_training
from lightsim_lab.training.inpaint_losses import (
    discriminator_loss,
    generator_loss,
    reconstruction_loss,
    row_weights,
)
from lightsim_lab.training.prefetch import Prefetcher

# Fraction of the steps over which the adversarial weight grows from 0. Sensitivity not measured.
_RAMP_FRACTION = 0.1
# Weight of known pixels in the L1 loss, relative to 1 in holes. Sensitivity not measured.
_KNOWN_WEIGHT = 0.1


@dataclass(frozen=True)
class InpaintConfig:
    """Networks and settings of the training. The size of the panoramas is that of the data."""

    loop: LoopConfig = field(default_factory=lambda: LoopConfig(2500))
    """Steps of both optimisers, and averaging of the generator's weights."""
    batch: int = 8
    """Panoramas per step."""
    width: int = 10
    """Channels of the generator at the full resolution (DeepFill v2: 48 at 256 x 256)."""
    dilations: tuple[int, ...] = (1, 2, 4, 8)
    """Dilations of the layers at a quarter of the size; at most a quarter of the rows."""
    is_residual: bool = True
    """Both stages add to a smooth continuation of the known pixels; False: they predict all values,
    as published."""
    discriminator_width: int = 16
    """Channels of the discriminator's first layer."""
    discriminator_layers: int = 4
    """Strided layers of the discriminator."""
    rate: float = 1e-3
    """Highest learning rate of the generator."""
    discriminator_rate: float = 4e-4
    """Highest learning rate of the discriminator."""
    adversarial_weight: float = 0.005
    """Final weight of the adversarial loss; the weight of the L1 losses is 1."""
    adversarial_from: float = 0.4
    """Fraction of the steps before the discriminator takes part."""
    workers: int = 0
    """Threads that prepare batches in advance; 0: each batch is made when it is needed."""
    seed: int = 0
    """Seed of the initial weights and of the batches."""

    @staticmethod
    def small() -> InpaintConfig:
        """Return the settings for 64 x 128 panoramas: about half an hour on one CPU core."""
        return InpaintConfig()

    @staticmethod
    def full() -> InpaintConfig:
        """Return the settings of the published size, for a GPU and 256 x 512 panoramas."""
        return InpaintConfig(
            LoopConfig(60_000, average_decay=0.999, mixed_precision=True),
            batch=32,
            width=48,
            dilations=(2, 4, 8, 16),
            discriminator_width=64,
            discriminator_layers=6,
            rate=3e-4,
            discriminator_rate=3e-4,
            adversarial_from=0.1,
            workers=12,
        )


@dataclass(frozen=True, eq=False)
class InpaintTensors:
    """Batch of complete panoramas, sRGB scaled to [-1, 1], and masks that are 1 in the holes."""

    truth: Float[Tensor, "n 3 h w"]
    hole: Float[Tensor, "n 1 h w"]


def inpaint_tensors(batch: PanoramaBatch, device: torch.device) -> InpaintTensors:
    """Convert a batch to tensors on a device."""
    truth = torch.from_numpy(np.ascontiguousarray(batch.panorama.transpose(0, 3, 1, 2)))
    hole = torch.from_numpy(~batch.visibility)[:, None].float()
    return InpaintTensors(truth.to(device) * 2 - 1, hole.to(device))


def train_inpaint(
    data: PanoramaData, config: InpaintConfig, session: Session
) -> tuple[dict[str, Tensor], int]:
    """Train, from the last checkpoint if there is one.

    The batch of a step depends on (seed, step) alone, so that an interrupted and resumed run gives
    exactly the same weights on the CPU.

    Returns:
        Averaged weights of the generator by name, and the number of steps done.

    Raises:
        InputError: the size of the data does not fit the network, or there is no CUDA device.
    """
    _check_size(data.height_px, config)
    target, count = choose_device(session.device), session.processes.count
    pair = _Pair(config, data.height_px, target)

    def make(number: int) -> PanoramaBatch:
        return data.panoramas(config.batch, config.seed, number)

    def losses(step: int, draw: int) -> Iterator[Loss]:
        return pair.losses(inpaint_tensors(batches.get(draw), target), step)

    with Prefetcher(make, config.workers, count, count * config.loop.steps) as batches:
        done = run_training(pair.learners(), losses, config.loop, session, "train the inpainting")
    return {name: value.cpu() for name, value in pair.generator.state_dict().items()}, done


def _check_size(height_px: int, config: InpaintConfig) -> None:
    fits = height_px % TOTAL_STRIDE == 0 and max(config.dilations) <= height_px // 4
    if not fits:
        raise InputError(
            "the inpainting network does not fit the height of the panoramas",
            got=f"{height_px} rows and dilations {config.dilations}",
            expected=f"a multiple of {TOTAL_STRIDE} and at least 4 times the largest dilation",
        )


class _Pair:
    """Generator and discriminator, and their losses."""

    def __init__(self, config: InpaintConfig, height_px: int, device: torch.device) -> None:
        self._config = config
        # The initial weights depend on the seed alone, and the global random state is unchanged.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            generator = InpaintGenerator(
                config.width,
                height_px,
                config.dilations,
                is_residual=config.is_residual,
            )
            discriminator = PatchDiscriminator(
                config.discriminator_width, config.discriminator_layers
            )
        self.generator = generator.to(device)
        self.discriminator = discriminator.to(device)

    def learners(self) -> dict[str, Learner]:
        """Return the generator, whose weights are averaged, and the discriminator, with Adam."""
        # Momentum 0.5 instead of 0.9 is usual in adversarial training.
        betas, config = (0.5, 0.99), self._config
        adam = torch.optim.Adam(self.generator.parameters(), config.rate, betas)
        adam_d = torch.optim.Adam(self.discriminator.parameters(), config.discriminator_rate, betas)
        return {
            "generator": Learner(self.generator, (adam,), is_averaged=True),
            "discriminator": Learner(self.discriminator, (adam_d,)),
        }

    def losses(self, batch: InpaintTensors, step: int) -> Iterator[Loss]:
        """Yield the loss of the discriminator, once it takes part, then that of the generator."""
        coarse, refined = self.generator(batch.truth, batch.hole)
        terms = {
            "l1_coarse": reconstruction_loss(coarse, batch.truth, batch.hole, _KNOWN_WEIGHT),
            "l1": reconstruction_loss(refined, batch.truth, batch.hole, _KNOWN_WEIGHT),
        }
        loss = terms["l1_coarse"] + terms["l1"]
        composite = batch.truth * (1 - batch.hole) + refined * batch.hole
        weight = self._adversarial_weight(step)
        if weight is not None:
            own = self._discriminator_loss(batch, composite.detach())
            yield "discriminator", own, {"discriminator": own}
            # The generator's loss must not add gradients to the discriminator.
            self.discriminator.requires_grad_(False)
            scores = self.discriminator(composite, batch.hole)
            # The adversarial loss is in single precision, also in mixed precision training.
            terms["adversarial"] = generator_loss(scores.float())
            loss = loss + weight * terms["adversarial"]
        yield "generator", loss, {**terms, "psnr_db": _psnr_db(composite, batch)}

    def _adversarial_weight(self, step: int) -> float | None:
        """Return the weight of the adversarial loss; None while the discriminator is unused."""
        since = step / self._config.loop.steps - self._config.adversarial_from
        if since < 0 or self._config.adversarial_weight == 0:
            return None
        return self._config.adversarial_weight * min(1.0, since / _RAMP_FRACTION)

    def _discriminator_loss(
        self, batch: InpaintTensors, composite: Float[Tensor, "n 3 h w"]
    ) -> Float[Tensor, ""]:
        self.discriminator.requires_grad_(True)
        # One pass for truth and result, which have the same masks.
        both = torch.cat([batch.truth, composite])
        scores = self.discriminator(both, torch.cat([batch.hole, batch.hole]))
        of_truth, of_result = scores.float().chunk(2)
        return discriminator_loss(of_truth, of_result)


def _psnr_db(composite: Float[Tensor, "n 3 h w"], batch: InpaintTensors) -> Float[Tensor, ""]:
    """Return the PSNR in the holes, weighted by solid angle."""
    with torch.no_grad():
        # Values span [-1, 1]; a quarter of the squared error is that of values in [0, 1].
        error = (composite.clamp(-1, 1) - batch.truth).square().mean(1, keepdim=True) / 4
        weight = batch.hole * row_weights(error.shape[-2]).to(error.device)
        mse = (error * weight).sum() / weight.sum().clamp_min(1e-6)
        return -10 * torch.log10(mse.clamp_min(1e-12))
