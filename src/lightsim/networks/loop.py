"""The one training loop: resumable to the bit, on one device or by several processes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from lightsim.errors import ArtefactError
from lightsim.networks.devices import ALONE, Processes, device_of
from lightsim.progress import Progress, SilentProgress

_RECORD_EVERY = 25
_SAVE_EVERY_S = 60.0


@runtime_checkable
class Checkpointer(Protocol):
    """Where training keeps what must survive an interruption; store/checkpoint.py writes files."""

    def load(self) -> dict[str, Any] | None:
        """The state last saved, its tensors on the CPU; None before the first."""
        ...

    def save(self, state: dict[str, Any]) -> None:
        """Replace the saved state, whole or not at all."""
        ...

    def record(self, metrics: dict[str, float]) -> None:
        """Append one line of metrics; `step` is among them."""
        ...


@runtime_checkable
class Optimiser(Protocol):
    """What the loop asks of an optimiser, torch's or the sparse one of the hash grids."""

    param_groups: list[dict[str, Any]]

    def step(self) -> Any:
        """Move the parameters along their gradients."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """What a resumed training needs besides the parameters."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        ...


@dataclass(frozen=True)
class LoopConfig:
    """How long networks learn, and what tames their steps."""

    steps: int = 3000
    """Optimiser steps."""
    warm_up_steps: int = 50
    """Steps in which the learning rate grows to its highest."""
    final_fraction: float = 0.02
    """Of the highest learning rate, reached at the last step by half a cosine; 1 keeps it."""
    largest_gradient: float | None = 1.0
    """Norm to which a learner's gradients are clipped, None leaves them."""
    average_decay: float = 0.995
    """Of the running average of the weights of averaged learners."""
    mixed_precision: bool = False
    """Losses in bfloat16 where that is safe (torch.autocast), on CUDA alone."""
    is_mixed_on_cpu: bool = False
    """On a CPU, too: one with bfloat16 instructions (AVX512-BF16) takes two thirds of the time,
    others take longer."""
    is_compiled: bool = False
    """Compile the networks (torch.compile; it needs a C compiler)."""


@dataclass(frozen=True, eq=False)
class Learner:
    """A network and what moves its weights; the optimisers' first learning rates are the highest.

    Args:
        network: trained in place.
        optimisers: each for some of the parameters.
        is_averaged: at the end it holds the running average of its weights.
    """

    network: nn.Module
    optimisers: tuple[Optimiser, ...]
    is_averaged: bool = False

    @property
    def groups(self) -> list[dict[str, Any]]:
        """The parameter groups of all optimisers: `params` and learning rate `lr`."""
        return [group for optimiser in self.optimisers for group in optimiser.param_groups]


Loss = tuple[str, Tensor, Mapping[str, Tensor]]
"""Name of the learner that the loss moves, the loss, and terms for the metrics."""

Losses = Callable[[int, int], Iterator[Loss]]
"""(number of the step, number of its draw) -> losses, each minimised before the next is asked for.

Random draws must depend on the number of the draw alone. It is the step's number, or with several
processes one that no other process has.
"""


@dataclass(frozen=True, eq=False)
class Session:
    """Where and how long a training runs; what is learned depends on `processes` alone.

    Args:
        checkpointer: keeps checkpoints and metrics.
        progress: shows the steps.
        minutes: stop then, to go on later.
        device: "auto", "cpu" or "cuda".
        processes: that train together. Their gradients are averaged: each draws its own batch, and
            together they learn from one as many times as large. All start with equal weights.
    """

    checkpointer: Checkpointer
    progress: Progress
    minutes: float | None = None
    device: str = "auto"
    processes: Processes = ALONE


def run_training(
    learners: Mapping[str, Learner],
    losses: Losses,
    config: LoopConfig,
    session: Session,
    label: str = "train",
) -> int:
    """Train in place from the checkpointer's last state; the number of steps done when it stops.

    An interrupted run that goes on gives the very same networks on the CPU.

    Raises:
        ArtefactError: the checkpointer's state belongs to other networks.
    """
    checkpointer, processes = session.checkpointer, session.processes
    loop = _Loop(learners, config, processes)
    first, before_s = loop.restore(processes.from_first(checkpointer.load))
    started = saved = time.monotonic()
    done = first
    steps = range(first, config.steps)
    progress = session.progress if processes.is_first else SilentProgress()
    for step in progress.track(steps, label, len(steps)):
        metrics = loop.step(losses, step)
        done, now = step + 1, time.monotonic()
        is_last = done == config.steps
        limit_s = None if session.minutes is None else 60 * session.minutes
        is_over = limit_s is not None and processes.any(now - started > limit_s)
        seconds = before_s + now - started
        if processes.is_first and (step % _RECORD_EVERY == 0 or is_last):
            values = {name: float(value.detach()) for name, value in metrics.items()}
            checkpointer.record({"step": float(step), "seconds": seconds, **values})
        if processes.is_first and (now - saved > _SAVE_EVERY_S or is_over or is_last):
            checkpointer.save(loop.state(done, seconds))
            saved = now
        if is_over:
            break
    loop.finish()
    return done


class _Loop:
    """The learners' steps, learning rates, averages and state."""

    def __init__(
        self, learners: Mapping[str, Learner], config: LoopConfig, processes: Processes
    ) -> None:
        self._learners = learners
        self._config = config
        self._processes = processes
        self._device = device_of(next(iter(learners.values())).network)
        self._rates = {name: [g["lr"] for g in own.groups] for name, own in learners.items()}
        self._averages = {
            name: {k: v.detach().clone() for k, v in learner.network.state_dict().items()}
            for name, learner in learners.items()
            if learner.is_averaged
        }
        for learner in learners.values():
            learner.network.train()
            if config.is_compiled:
                # In place, parts too: losses call more of a network than its forward.
                for module in (learner.network, *learner.network.children()):
                    module.compile()

    def step(self, losses: Losses, step: int) -> dict[str, Tensor]:
        """All updates of one step; the last loss and all terms."""
        metrics: dict[str, Tensor] = {}
        draw = step * self._processes.count + self._processes.rank
        coming = losses(step, draw)
        while (found := self._next(coming)) is not None:
            name, loss, terms = found
            self._update(name, loss, step)
            metrics.update(terms, loss=loss)
        # A young average forgets faster, or the first weights would stay in it.
        decay = min(self._config.average_decay, (step + 1) / (step + 10))
        with torch.no_grad():
            for name, average in self._averages.items():
                now = self._learners[name].network.state_dict()
                get_ema_multi_avg_fn(decay)(list(average.values()), list(now.values()), 0)
        return metrics

    def _next(self, coming: Iterator[Loss]) -> Loss | None:
        is_cuda = self._device.type == "cuda"
        is_mixed = self._config.mixed_precision if is_cuda else self._config.is_mixed_on_cpu
        with torch.autocast(self._device.type, torch.bfloat16, enabled=is_mixed):
            return next(coming, None)

    def _update(self, name: str, loss: Tensor, step: int) -> None:
        groups = self._learners[name].groups
        parameters = [parameter for group in groups for parameter in group["params"]]
        for parameter in parameters:
            parameter.grad = None
        loss.backward()
        self._processes.average([p.grad for p in parameters if p.grad is not None])
        if self._config.largest_gradient is not None:
            nn.utils.clip_grad_norm_(parameters, self._config.largest_gradient)
        for group, highest in zip(groups, self._rates[name], strict=True):
            group["lr"] = highest * _rate_fraction(step, self._config)
        for optimiser in self._learners[name].optimisers:
            optimiser.step()

    def finish(self) -> None:
        """Loads the averaged weights and leaves every network in evaluation mode."""
        for name, average in self._averages.items():
            self._learners[name].network.load_state_dict(average)
        for learner in self._learners.values():
            learner.network.eval()

    def state(self, step: int, seconds: float) -> dict[str, Any]:
        """What `restore` takes to resume exactly: weights, optimisers, averages, steps, seconds."""
        learners = self._learners.items()
        return {
            "step": step,
            "seconds": seconds,
            "networks": {name: learner.network.state_dict() for name, learner in learners},
            "optimisers": {
                n: [o.state_dict() for o in learner.optimisers] for n, learner in learners
            },
            "averages": self._averages,
        }

    def restore(self, state: dict[str, Any] | None) -> tuple[int, float]:
        """The steps done and the seconds they took."""
        if state is None:
            return 0, 0.0
        try:
            for name, learner in self._learners.items():
                learner.network.load_state_dict(state["networks"][name])
                saved = state["optimisers"][name]
                for optimiser, value in zip(learner.optimisers, saved, strict=True):
                    optimiser.load_state_dict(value)
            for name, average in self._averages.items():
                for key, value in average.items():
                    value.copy_(state["averages"][name][key])
            return int(state["step"]), float(state["seconds"])
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise ArtefactError(
                "the checkpoint belongs to another training",
                got=f"{type(error).__name__}: {error}"[:200],
                remedy="Train with the settings that it was made with, or delete checkpoint.pt.",
            ) from error


def _rate_fraction(step: int, config: LoopConfig) -> float:
    """Of the highest learning rate: warm-up, then half a cosine (arXiv:1608.03983, no restarts)."""
    warm = min(1.0, (step + 1) / config.warm_up_steps)
    cosine = 0.5 * (1 + math.cos(math.pi * (step / max(config.steps - 1, 1))))
    return warm * (config.final_fraction + (1 - config.final_fraction) * cosine)
