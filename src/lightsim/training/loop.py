"""One training loop for all sky networks: resumable, deterministic, with metrics and averages."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from lightsim.errors import InputError
from lightsim.progress import Progress

_WARM_UP = 50
_LAST_RATE = 0.02
_RECORD_EVERY = 25
_SAVE_EVERY_S = 60.0
_LARGEST_GRADIENT = 1.0
_AVERAGE_DECAY = 0.995


@runtime_checkable
class Journal(Protocol):
    """Where training keeps what must survive an interruption; store/checkpoint.py writes files."""

    def load(self) -> dict[str, Any] | None: ...

    def save(self, state: dict[str, Any]) -> None: ...

    def record(self, metrics: dict[str, float]) -> None: ...


@dataclass(frozen=True)
class LoopConfig:
    """How long and how fast a network learns."""

    steps: int = 3000
    """Optimiser steps."""
    rate: float = 1e-3
    """Highest learning rate (AdamW)."""
    weight_decay: float = 1e-3
    """Of AdamW."""


LossOfStep = Callable[[int], tuple[Tensor, dict[str, Tensor]]]


def run_training(
    network: nn.Module,
    loss_of_step: LossOfStep,
    journal: Journal,
    config: LoopConfig,
    *,
    minutes: float | None = None,
    progress: Progress,
) -> int:
    """Train in place from the journal's last state; the steps done when it stops.

    At the end the network holds the running average of its weights. After `minutes` it stops in
    between, and the next call goes on. Draws must depend on the step alone: an interrupted run
    then gives the very same network on the CPU.
    """
    loop = _Loop(network, config)
    state = journal.load()
    first = 0 if state is None else loop.restore(state)
    started = saved = time.monotonic()
    network.train()
    done = first
    for step in progress.track(range(first, config.steps), "train", config.steps - first):
        loss, terms = loss_of_step(step)
        loop.step(loss, step)
        done = step + 1
        now = time.monotonic()
        is_over = minutes is not None and now - started > 60 * minutes
        if step % _RECORD_EVERY == 0 or done == config.steps:
            values = {name: float(value.detach()) for name, value in terms.items()}
            journal.record(
                {
                    "step": float(step),
                    "seconds": now - started,
                    "loss": float(loss.detach()),
                    **values,
                }
            )
        if now - saved > _SAVE_EVERY_S or is_over or done == config.steps:
            journal.save(loop.state(done))
            saved = now
        if is_over:
            break
    loop.use_average()
    network.eval()
    return done


class _Loop:
    """AdamW with warm-up and half a cosine, and the running average of the weights."""

    def __init__(self, network: nn.Module, config: LoopConfig) -> None:
        self._network = network
        self._config = config
        self._optimiser = torch.optim.AdamW(
            network.parameters(), lr=config.rate, weight_decay=config.weight_decay
        )
        self._average = {k: v.detach().clone() for k, v in network.state_dict().items()}

    def step(self, loss: Tensor, step: int) -> None:
        self._optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self._network.parameters(), _LARGEST_GRADIENT)
        for group in self._optimiser.param_groups:
            group["lr"] = self._config.rate * _rate(step, self._config.steps)
        self._optimiser.step()
        # A young average forgets faster, or the first weights would stay in it.
        decay = min(_AVERAGE_DECAY, (step + 1) / (step + 10))
        with torch.no_grad():
            for name, value in self._network.state_dict().items():
                self._average[name].lerp_(value, 1 - decay)

    def use_average(self) -> None:
        self._network.load_state_dict(self._average)

    def state(self, step: int) -> dict[str, Any]:
        return {
            "step": step,
            "network": self._network.state_dict(),
            "average": self._average,
            "optimiser": self._optimiser.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> int:
        self._network.load_state_dict(state["network"])
        self._average = {
            k: state["average"][k].to(v.device) for k, v in self._network.state_dict().items()
        }
        self._optimiser.load_state_dict(state["optimiser"])
        return int(state["step"])


def _rate(step: int, steps: int) -> float:
    """Warm-up, then half a cosine."""
    warm = min(1.0, (step + 1) / _WARM_UP)
    share = step / max(steps - 1, 1)
    return warm * (_LAST_RATE + (1 - _LAST_RATE) * 0.5 * (1 + math.cos(math.pi * share)))


def choose_device(name: str) -> torch.device:
    """ "auto", "cpu" or "cuda" as a device.

    Raises:
        InputError: cuda is asked for and not there.
    """
    has_cuda = torch.cuda.is_available()
    if name == "cuda" and not has_cuda:
        raise InputError("no CUDA device", got=name, remedy="Use --device cpu.")
    return torch.device("cuda" if has_cuda and name != "cpu" else "cpu")
