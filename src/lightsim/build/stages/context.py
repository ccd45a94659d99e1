"""What every stage of the build gets besides its inputs."""

from __future__ import annotations

from dataclasses import dataclass

from lightsim.progress import Progress


@dataclass(frozen=True)
class Context:
    """What every stage gets besides its inputs."""

    progress: Progress
    seed: int
    preset: str
    device: str = "auto"
