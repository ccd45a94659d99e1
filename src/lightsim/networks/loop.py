"""Training loop of all networks: resumable bit for bit, on one device or in several processes."""

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

# Steps between two lines of metrics.
_RECORD_EVERY = 25
# Seconds between two checkpoints: at most this much work is lost by an interruption.
_SAVE_EVERY_S = 60.0


@runtime_checkable
class Checkpointer(Protocol):
    """Storage of a training's state and metrics; store/checkpoint.py implements it with files."""

    def load(self) -> dict[str, Any] | None:
        """Return the last saved state, its tensors on the CPU; None before the first."""
        ...

    def save(self, state: dict[str, Any]) -> None:
        """Replace the saved state atomically."""
        ...

    def record(self, metrics: dict[str, float]) -> None:
        """Append one line of metrics; `step` is among them."""
        ...


@runtime_checkable
class Optimiser(Protocol):
    """Interface of optimisers: torch's, and the sparse optimiser of the hash grids."""

    param_groups: list[dict[str, Any]]

    def step(self) -> Any:
        """Move the parameters along their gradients."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return the state that a resumed training needs besides the parameters."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        ...


@dataclass(frozen=True)
class LoopConfig:
    """Duration of a training, learning rates, and precision."""

    steps: int = 3000
    """Optimiser steps."""
    warm_up_steps: int = 50
    """Steps in which the learning rate grows linearly to its highest."""
    final_fraction: float = 0.02
    """Last learning rate as a fraction of the highest, reached by half a cosine; 1 is constant."""
    largest_gradient: float | None = 1.0
    """Norm to which a learner's gradients are clipped; None: not clipped."""
    average_decay: float = 0.995
    """Decay of the running average of the weights of averaged learners."""
    mixed_precision: bool = False
    """Compute losses in bfloat16 where that is safe (torch.autocast), on CUDA only."""
    is_mixed_on_cpu: bool = False
    """Compute losses in bfloat16 on a CPU: two thirds of the time with bfloat16 instructions
    (AVX512-BF16), slower without."""
    is_compiled: bool = False
    """Compile the networks (torch.compile; requires a C compiler)."""


@dataclass(frozen=True, eq=False)
class Learner:
    """Network and its optimisers, whose initial learning rates are the highest of the training.

    Args:
        network: network that is trained in place.
        optimisers: one for each group of parameters.
        is_averaged: replace the weights by their running average at the end.
    """

    network: nn.Module
    optimisers: tuple[Optimiser, ...]
    is_averaged: bool = False

    @property
    def groups(self) -> list[dict[str, Any]]:
        """Parameter groups of all optimisers: `params` and learning rate `lr`."""
        return [group for optimiser in self.optimisers for group in optimiser.param_groups]


Loss = tuple[str, Tensor, Mapping[str, Tensor]]
"""Name of the learner that the loss trains, the loss, and terms for the metrics."""

Losses = Callable[[int, int], Iterator[Loss]]
"""(index of the step, index of the draw) -> losses; each is minimised before the next is computed.

Random draws must depend on the index of the draw only. It equals the index of the step, or with
several processes it is unique to step and process.
"""


@dataclass(frozen=True, eq=False)
class Session:
    """Device, duration and storage of one run of a training; only `processes` affects the result.

    Args:
        checkpointer: stores checkpoints and metrics.
        progress: reports the steps.
        minutes: time after which the run stops; a later run continues it.
        device: "auto", "cpu" or "cuda".
        processes: processes that train together, from equal weights. Each draws its own batch and
            their gradients are averaged, which multiplies the batch size.
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
    """Train in place from the checkpointer's last state and return the number of completed steps.

    On the CPU, a run that was interrupted and continued results in identical networks.

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
    """Updates, learning rates, averages and state of the learners."""

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
                # In place and with its parts: losses call more of a network than its forward.
                for module in (learner.network, *learner.network.children()):
                    module.compile()

    def step(self, losses: Losses, step: int) -> dict[str, Tensor]:
        """Apply all updates of one step and return the last loss and all terms."""
        metrics: dict[str, Tensor] = {}
        draw = step * self._processes.count + self._processes.rank
        coming = losses(step, draw)
        while (found := self._next(coming)) is not None:
            name, loss, terms = found
            self._update(name, loss, step)
            metrics.update(terms, loss=loss)
        # The decay is smaller at first, else the initial weights would remain in the average.
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
        """Load the averaged weights and set every network to evaluation mode."""
        for name, average in self._averages.items():
            self._learners[name].network.load_state_dict(average)
        for learner in self._learners.values():
            learner.network.eval()

    def state(self, step: int, seconds: float) -> dict[str, Any]:
        """Return the state for `restore`: weights, optimisers, averages, steps and seconds."""
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
        """Load a state of `state`; return completed steps and seconds, (0, 0) for None."""
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
                expected="networks and optimisers of this training",
                remedy="Train with the settings of the checkpoint, or delete checkpoint.pt.",
            ) from error


def _rate_fraction(step: int, config: LoopConfig) -> float:
    """Return the fraction of the highest learning rate: linear warm-up times half a cosine
    (arXiv:1608.03983, without restarts)."""
    warm = min(1.0, (step + 1) / config.warm_up_steps)
    cosine = 0.5 * (1 + math.cos(math.pi * (step / max(config.steps - 1, 1))))
    return warm * (config.final_fraction + (1 - config.final_fraction) * cosine)
