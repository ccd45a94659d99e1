"""Context of a build that every stage receives."""

from __future__ import annotations

from dataclasses import dataclass, field

from lightsim.lighting.weights import LightingWeights
from lightsim.progress import Progress


@dataclass(frozen=True)
class Context:
    """Progress, seed, preset, device and weights of the lighting networks of a build."""

    progress: Progress
    seed: int
    preset: str
    device: str = "auto"
    lighting: LightingWeights = field(default_factory=LightingWeights)
