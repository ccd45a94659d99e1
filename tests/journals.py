"""A journal without files, for tests of training."""

from __future__ import annotations

import copy
from typing import Any

from lightsim.networks.loop import Session
from lightsim.progress import SilentProgress


class MemoryJournal:
    """As on disk, what is saved no longer changes."""

    def __init__(self, state: dict[str, Any] | None = None) -> None:
        self.state = state
        self.lines: list[dict[str, float]] = []

    def load(self) -> dict[str, Any] | None:
        return self.state

    def save(self, state: dict[str, Any]) -> None:
        self.state = copy.deepcopy(state)

    def record(self, metrics: dict[str, float]) -> None:
        self.lines.append(metrics)

    def session(self) -> Session:
        """A silent training on the CPU."""
        return Session(self, SilentProgress(), device="cpu")
