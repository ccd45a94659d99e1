"""Context of a build that every stage receives."""

from __future__ import annotations

from dataclasses import dataclass

from lightsim.progress import Progress


@dataclass(frozen=True)
class Context:
    """Progress, seed, preset and device of a build."""

    progress: Progress
    seed: int
    preset: str
    device: str = "auto"
