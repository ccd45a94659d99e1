"""Context of a build that every stage receives."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lightsim.progress import Progress


@dataclass(frozen=True)
class Context:
    """Progress, seed, preset, device and files of given weights of a build."""

    progress: Progress
    seed: int
    preset: str
    device: str = "auto"
    sky_weights: Path | None = None
    inpaint_weights: Path | None = None
