"""Training of the inpainting of panoramas: generator and discriminator in the common loop."""

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
from lightsim_lab.training.ahead import Ahead
from lightsim_lab.training.inpaint_losses import (
    discriminator_loss,
    generator_loss,
    reconstruction_loss,
    row_weights,
)

_RAMP = 0.1


# Weight of known pixels in the L1 loss; a pixel of a hole has 1.
_KNOWN_WEIGHT = 0.1


@dataclass(frozen=True)
class InpaintConfig:
    """The networks and how they learn. The size of the panoramas is that of the data."""

    loop: LoopConfig = field(default_factory=lambda: LoopConfig(2500))
    """Steps of both optimisers; the running average of the generator's weights is kept."""
    batch: int = 8
    """Panoramas a step."""
    width: int = 10
    """Channels of the generator at the full resolution (DeepFill v2: 48 at 256 x 256)."""
    dilations: tuple[int, ...] = (1, 2, 4, 8)
    """Of the layers at a quarter of the size; at most a quarter of the rows."""
    propagates: bool = False
    """Neighbours vote for neighbouring patches in the attention."""
    is_residual: bool = True
    """Holes start as a smooth continuation of what is known, to which both stages add; else both
    paint anew, as published."""
    discriminator_width: int = 16
    """Channels of the discriminator's first layer."""
    discriminator_layers: int = 4
    """Strided layers of the discriminator."""
    rate: float = 1e-3
    """Highest learning rate of the generator."""
    discriminator_rate: float = 4e-4
    """Highest learning rate of the discriminator."""
    adversarial_weight: float = 0.005
    """Weight of the discriminator's judgement beside the L1 losses, after it has grown from 0."""
    adversarial_from: float = 0.4
    """Fraction of the steps before the discriminator takes part."""
    workers: int = 0
    """Threads that draw batches ahead; 0 draws each when it is needed."""
    seed: int = 0
    """Of the first weights and of all batches."""

    @staticmethod
    def small() -> InpaintConfig:
        """About half an hour on one core for panoramas of 64 x 128."""
        return InpaintConfig()

    @staticmethod
    def full() -> InpaintConfig:
        """The published size, for a GPU and panoramas of 256 x 512."""
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
    """A batch: complete panoramas, -1 to 1, and 1 where they are to be filled."""

    truth: Float[Tensor, "n 3 h w"]
    hole: Float[Tensor, "n 1 h w"]


def inpaint_tensors(batch: PanoramaBatch, device: torch.device) -> InpaintTensors:
    """What inpainting needs of a batch."""
    truth = torch.from_numpy(np.ascontiguousarray(batch.panorama.transpose(0, 3, 1, 2)))
    hole = torch.from_numpy(~batch.visibility)[:, None].float()
    return InpaintTensors(truth.to(device) * 2 - 1, hole.to(device))


def train_inpaint(
    data: PanoramaData, config: InpaintConfig, session: Session
) -> tuple[dict[str, Tensor], int]:
    """Train from the last checkpoint on; the generator's averaged weights and the steps done.

    Every step draws its batch from (seed, step) alone: an interrupted run that goes on gives the
    very same weights on the CPU.

    Raises:
        InputError: the data's size does not fit the network, or cuda is asked for and not there.
    """
    _check_size(data.height_px, config)
    target, count = choose_device(session.device), session.processes.count
    pair = _Pair(config, data.height_px, target)

    def make(number: int) -> PanoramaBatch:
        return data.panoramas(config.batch, config.seed, number)

    def losses(step: int, draw: int) -> Iterator[Loss]:
        return pair.losses(inpaint_tensors(batches.get(draw), target), step)

    with Ahead(make, config.workers, count, count * config.loop.steps) as batches:
        done = run_training(pair.learners(), losses, config.loop, session, "train the inpainting")
    return {name: value.cpu() for name, value in pair.generator.state_dict().items()}, done


def _check_size(height_px: int, config: InpaintConfig) -> None:
    fits = height_px % TOTAL_STRIDE == 0 and max(config.dilations) <= height_px // 4
    if not fits:
        raise InputError(
            "the inpainting network does not fit panoramas of this size",
            got=f"{height_px} rows and dilations {config.dilations}",
            expected=f"a multiple of {TOTAL_STRIDE} and at least 4 times the largest dilation",
        )


class _Pair:
    """Generator and discriminator, and what each learns from a batch."""

    def __init__(self, config: InpaintConfig, height_px: int, device: torch.device) -> None:
        self._config = config
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            generator = InpaintGenerator(
                config.width,
                height_px,
                config.dilations,
                propagates=config.propagates,
                is_residual=config.is_residual,
            )
            discriminator = PatchDiscriminator(
                config.discriminator_width, config.discriminator_layers
            )
        self.generator = generator.to(device)
        self.discriminator = discriminator.to(device)

    def learners(self) -> dict[str, Learner]:
        """Generator, whose weights are averaged, and discriminator, with Adam."""
        betas, config = (0.5, 0.99), self._config
        adam = torch.optim.Adam(self.generator.parameters(), config.rate, betas)
        adam_d = torch.optim.Adam(self.discriminator.parameters(), config.discriminator_rate, betas)
        return {
            "generator": Learner(self.generator, (adam,), is_averaged=True),
            "discriminator": Learner(self.discriminator, (adam_d,)),
        }

    def losses(self, batch: InpaintTensors, step: int) -> Iterator[Loss]:
        """Of the discriminator once it takes part, then of the generator."""
        coarse, refined = self.generator(batch.truth, batch.hole)
        terms = {
            "l1_coarse": reconstruction_loss(coarse, batch.truth, batch.hole, _KNOWN_WEIGHT),
            "l1": reconstruction_loss(refined, batch.truth, batch.hole, _KNOWN_WEIGHT),
        }
        loss = terms["l1_coarse"] + terms["l1"]
        composite = batch.truth * (1 - batch.hole) + refined * batch.hole
        weight = self._adversarial_weight(step)
        if weight is not None:
            judged = self._discriminator_loss(batch, composite.detach())
            yield "discriminator", judged, {"discriminator": judged}
            self.discriminator.requires_grad_(False)
            scores = self.discriminator(composite, batch.hole)
            terms["adversarial"] = generator_loss(scores.float())
            loss = loss + weight * terms["adversarial"]
        yield "generator", loss, {**terms, "psnr_db": _psnr_db(composite, batch)}

    def _adversarial_weight(self, step: int) -> float | None:
        """None before the discriminator takes part; then growing over a tenth of the steps."""
        since = step / self._config.loop.steps - self._config.adversarial_from
        if since < 0 or self._config.adversarial_weight == 0:
            return None
        return self._config.adversarial_weight * min(1.0, since / _RAMP)

    def _discriminator_loss(
        self, batch: InpaintTensors, composite: Float[Tensor, "n 3 h w"]
    ) -> Float[Tensor, ""]:
        self.discriminator.requires_grad_(True)
        both = torch.cat([batch.truth, composite])
        scores = self.discriminator(both, torch.cat([batch.hole, batch.hole]))
        of_truth, of_result = scores.float().chunk(2)
        return discriminator_loss(of_truth, of_result)


def _psnr_db(composite: Float[Tensor, "n 3 h w"], batch: InpaintTensors) -> Float[Tensor, ""]:
    """Of the holes, by solid angle, values in [0, 1]."""
    with torch.no_grad():
        error = (composite.clamp(-1, 1) - batch.truth).square().mean(1, keepdim=True) / 4
        weight = batch.hole * row_weights(error.shape[-2]).to(error.device)
        mse = (error * weight).sum() / weight.sum().clamp_min(1e-6)
        return -10 * torch.log10(mse.clamp_min(1e-12))
