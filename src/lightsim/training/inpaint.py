"""Training of the inpainting of panoramas: resumable, deterministic, with metrics."""

from __future__ import annotations

import math
import time
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from lightsim.errors import InputError
from lightsim.lighting.panorama.inpaint_network import (
    TOTAL_STRIDE,
    InpaintGenerator,
    PatchDiscriminator,
)
from lightsim.lighting.sample import LightingBatch, LightingData
from lightsim.progress import Progress
from lightsim.training.inpaint_losses import (
    discriminator_loss,
    generator_loss,
    reconstruction_loss,
    row_weights,
)
from lightsim.training.loop import Journal, choose_device

_WARM_UP = 50
_LAST_RATE = 0.02
_RECORD_EVERY = 25
_SAVE_EVERY_S = 60.0
_LARGEST_GRADIENT = 1.0
_RAMP = 0.1


# Weight of known pixels in the L1 loss; a pixel of a hole has 1.
_KNOWN_WEIGHT = 0.1


@dataclass(frozen=True)
class InpaintConfig:
    """The networks and how they learn. The size of the panoramas is that of the data."""

    steps: int = 2500
    """Steps of both optimisers."""
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
    """Share of the steps before the discriminator takes part."""
    average_decay: float = 0.995
    """Of the running average of the generator's weights, which is what is kept."""
    mixed_precision: bool = False
    """Convolutions in bfloat16."""
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
            steps=60_000,
            batch=32,
            width=48,
            dilations=(2, 4, 8, 16),
            discriminator_width=64,
            discriminator_layers=6,
            rate=3e-4,
            discriminator_rate=3e-4,
            adversarial_from=0.1,
            average_decay=0.999,
            mixed_precision=True,
            workers=12,
        )


@dataclass(frozen=True, eq=False)
class InpaintTensors:
    """A batch: complete panoramas, -1 to 1, and 1 where they are to be filled."""

    truth: Float[Tensor, "n 3 h w"]
    hole: Float[Tensor, "n 1 h w"]


def inpaint_tensors(batch: LightingBatch, device: torch.device) -> InpaintTensors:
    """What inpainting needs of a batch."""
    truth = torch.from_numpy(np.ascontiguousarray(batch.panorama.transpose(0, 3, 1, 2)))
    hole = torch.from_numpy(~batch.visibility)[:, None].float()
    return InpaintTensors(truth.to(device) * 2 - 1, hole.to(device))


def train_inpaint(
    data: LightingData,
    journal: Journal,
    config: InpaintConfig,
    *,
    device: str = "auto",
    minutes: float | None = None,
    progress: Progress,
) -> dict[str, Tensor]:
    """Train from the journal's last state on; the generator's averaged weights when it stops.

    After `minutes` it stops in between, and the next call goes on. Every step draws its batch from
    (seed, step) alone: an interrupted run that goes on gives the very same weights on the CPU.

    Raises:
        InputError: the data's size does not fit the network, or cuda is asked for and not there.
    """
    _check_size(data.height_px, config)
    training = _Training(config, data.height_px, choose_device(device))
    state = journal.load()
    before_s = 0.0
    if state is not None:
        training.restore(state)
        before_s = float(state["seconds"])
    started = saved = time.monotonic()
    batches = _batches(data, config, training.done)
    first = training.done
    for batch in progress.track(batches, "train the inpainting", config.steps - first):
        metrics = training.step(inpaint_tensors(batch, training.device))
        now = time.monotonic()
        is_last = training.done == config.steps
        is_over = minutes is not None and now - started > 60 * minutes
        seconds = before_s + now - started
        if (training.done - 1) % _RECORD_EVERY == 0 or is_last:
            step = float(training.done - 1)
            values = {name: float(value) for name, value in metrics.items()}
            journal.record({"step": step, "seconds": seconds, **values})
        if now - saved > _SAVE_EVERY_S or is_last or is_over:
            journal.save(training.state(seconds))
            saved = now
        if is_over:
            break
    return {name: value.cpu() for name, value in training.average.items()}


def _check_size(height_px: int, config: InpaintConfig) -> None:
    fits = height_px % TOTAL_STRIDE == 0 and max(config.dilations) <= height_px // 4
    if not fits:
        raise InputError(
            "the inpainting network does not fit panoramas of this size",
            got=f"{height_px} rows and dilations {config.dilations}",
            expected=f"a multiple of {TOTAL_STRIDE} and at least 4 times the largest dilation",
        )


def _batches(
    data: LightingData, config: InpaintConfig, first: int
) -> Generator[LightingBatch, None, None]:
    """The batches of all steps from `first` on, some drawn ahead by threads."""

    def draw(step: int) -> LightingBatch:
        return data.batch(config.batch, config.seed, step, only_sunny=False)

    if not config.workers:
        yield from (draw(step) for step in range(first, config.steps))
        return
    pool = ThreadPoolExecutor(config.workers)
    try:
        ahead = 2 * config.workers
        futures = {s: pool.submit(draw, s) for s in range(first, min(first + ahead, config.steps))}
        for step in range(first, config.steps):
            batch = futures.pop(step).result()
            if step + ahead < config.steps:
                futures[step + ahead] = pool.submit(draw, step + ahead)
            yield batch
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


class _Training:
    """Both networks, their optimisers and the running average of the generator."""

    def __init__(self, config: InpaintConfig, height_px: int, device: torch.device) -> None:
        self.device = device
        self.done = 0
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
        self.average = {k: v.detach().clone() for k, v in generator.state_dict().items()}
        self._adam = torch.optim.Adam(generator.parameters(), config.rate, (0.5, 0.99))
        self._adam_d = torch.optim.Adam(
            discriminator.parameters(), config.discriminator_rate, (0.5, 0.99)
        )

    def step(self, batch: InpaintTensors) -> dict[str, Tensor]:
        """One update of the generator, and of the discriminator once it takes part."""
        config = self._config
        rate = _rate(self.done, config.steps)
        for adam, highest in ((self._adam, config.rate), (self._adam_d, config.discriminator_rate)):
            for group in adam.param_groups:
                group["lr"] = highest * rate
        with self._precision():
            coarse, refined = self.generator(batch.truth, batch.hole)
        terms = {
            "l1_coarse": reconstruction_loss(coarse, batch.truth, batch.hole, _KNOWN_WEIGHT),
            "l1": reconstruction_loss(refined, batch.truth, batch.hole, _KNOWN_WEIGHT),
        }
        loss = terms["l1_coarse"] + terms["l1"]
        composite = batch.truth * (1 - batch.hole) + refined * batch.hole
        weight = self._adversarial_weight()
        if weight is not None:
            terms["discriminator"] = self._step_discriminator(batch, composite.detach())
            terms["adversarial"] = self._judge(composite, batch.hole)
            loss = loss + weight * terms["adversarial"]
        _update(loss, self.generator, self._adam)
        self._update_average()
        self.done += 1
        return {**{k: v.detach() for k, v in terms.items()}, "psnr_db": _psnr_db(composite, batch)}

    def _precision(self) -> torch.autocast:
        enabled = self._config.mixed_precision
        return torch.autocast(self.device.type, torch.bfloat16, enabled=enabled)

    def _adversarial_weight(self) -> float | None:
        """None before the discriminator takes part; then growing over a tenth of the steps."""
        since = self.done / self._config.steps - self._config.adversarial_from
        if since < 0 or self._config.adversarial_weight == 0:
            return None
        return self._config.adversarial_weight * min(1.0, since / _RAMP)

    def _step_discriminator(
        self, batch: InpaintTensors, composite: Float[Tensor, "n 3 h w"]
    ) -> Float[Tensor, ""]:
        self.discriminator.requires_grad_(True)
        with self._precision():
            both = torch.cat([batch.truth, composite])
            scores = self.discriminator(both, torch.cat([batch.hole, batch.hole]))
        of_truth, of_result = scores.float().chunk(2)
        loss = discriminator_loss(of_truth, of_result)
        _update(loss, self.discriminator, self._adam_d)
        return loss.detach()

    def _judge(
        self, composite: Float[Tensor, "n 3 h w"], hole: Float[Tensor, "n 1 h w"]
    ) -> Float[Tensor, ""]:
        self.discriminator.requires_grad_(False)
        with self._precision():
            scores = self.discriminator(composite, hole)
        return generator_loss(scores.float())

    @torch.no_grad()
    def _update_average(self) -> None:
        # A young average forgets faster, or the first weights would stay in it.
        decay = min(self._config.average_decay, (self.done + 1) / (self.done + 10))
        for name, value in self.generator.state_dict().items():
            self.average[name].lerp_(value, 1 - decay)

    def state(self, seconds: float) -> dict[str, Any]:
        return {
            "step": self.done,
            "seconds": seconds,
            "generator": self.generator.state_dict(),
            "average": self.average,
            "discriminator": self.discriminator.state_dict(),
            "adam": self._adam.state_dict(),
            "adam_discriminator": self._adam_d.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self.done = int(state["step"])
        self.generator.load_state_dict(state["generator"])
        self.average = {k: v.to(self.device) for k, v in state["average"].items()}
        self.discriminator.load_state_dict(state["discriminator"])
        self._adam.load_state_dict(state["adam"])
        self._adam_d.load_state_dict(state["adam_discriminator"])


def _update(loss: Float[Tensor, ""], network: nn.Module, adam: torch.optim.Adam) -> None:
    adam.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), _LARGEST_GRADIENT)
    adam.step()


def _psnr_db(composite: Float[Tensor, "n 3 h w"], batch: InpaintTensors) -> Float[Tensor, ""]:
    """Of the holes, by solid angle, values in [0, 1]."""
    with torch.no_grad():
        error = (composite.clamp(-1, 1) - batch.truth).square().mean(1, keepdim=True) / 4
        weight = batch.hole * row_weights(error.shape[-2]).to(error.device)
        mse = (error * weight).sum() / weight.sum().clamp_min(1e-6)
        return -10 * torch.log10(mse.clamp_min(1e-12))


def _rate(step: int, steps: int) -> float:
    """Warm-up, then half a cosine."""
    warm = min(1.0, (step + 1) / _WARM_UP)
    share = step / max(steps - 1, 1)
    return warm * (_LAST_RATE + (1 - _LAST_RATE) * 0.5 * (1 + math.cos(math.pi * share)))
