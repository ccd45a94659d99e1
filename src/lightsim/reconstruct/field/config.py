"""Settings of the neural field and its training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from lightsim.errors import ArtefactError
from lightsim.reconstruct.field.hash_grid.spec import HashGridSpec


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms of the scene loss (paper Sec. 3.3); 0 switches a term off."""

    lidar: float = 0.2
    """Depth error of LiDAR rays, by `depth_norm`."""
    opacity: float = 0.02
    """Deviation of the total opacity of LiDAR rays from 1."""
    eikonal: float = 0.02
    """Deviation of the gradient length near surfaces from 1 (paper: L_reg;
    doi:10.48550/arXiv.2002.10099)."""
    occupancy: float = 0.0
    """Rendering weights away from returns (paper: L_reg, "free space"; UniSim's L_reg)."""
    free_space: float = 0.5
    """Hinge loss on a signed distance of less than 0.3 m in front of a return."""
    surface: float = 2.0
    """Deviation of the signed distance at a return from 0."""
    sky: float = 0.05
    """Deviation of the total opacity of camera rays into the sky from 0."""
    residual: float = 0.5
    """Difference from the prior, weighted by the prior's confidence."""
    smooth: float = 0.1
    """Gradient of the difference from the prior."""


@dataclass(frozen=True)
class NeuralConfig:
    """Settings of the field F: x -> (s, k_d) and of its training."""

    steps: int = 2000
    """Most optimiser steps; 0 uses the fused LiDAR unchanged."""
    steps_a_sweep: int | None = None
    """Optimiser steps for each sweep, at least half of the most; None: always the most."""
    background_grid: HashGridSpec = field(default_factory=HashGridSpec)
    """Features of the static scene, frame `world`."""
    actor_grid: HashGridSpec = field(
        default_factory=lambda: HashGridSpec(
            levels=8, log2_entries=18, coarsest_m=1.0, finest_m=0.05
        )
    )
    """Features of all actors, each in its box frame with its own salt."""
    has_prior: bool = True
    """Learn a residual on the fused LiDAR instead of the whole signed distance."""
    cameras: tuple[str, ...] = ()
    """Cameras whose pictures train the field; empty for all."""
    has_camera_gains: bool = True
    """Learn exposure and white balance of each camera."""
    conversion: Literal["neus", "unisim"] = "neus"
    """Signed distance to opacity: Wang et al. 2021 (doi:10.48550/arXiv.2106.10689), or UniSim's
    1 / (1 + exp(beta s))."""
    depth_norm: Literal["smooth", "l2"] = "smooth"
    """LiDAR depth error: smooth L1 over (1 + t / 10), or the paper's plain distance."""
    colour_norm: Literal["l2", "squared"] = "squared"
    """Colour error of a ray: the paper's Euclidean norm, or its square."""
    weights: LossWeights = field(default_factory=LossWeights)
    """Weights of the loss terms."""
    camera_batch: int = 3072
    """Camera rays a step."""
    lidar_batch: int = 1024
    """LiDAR rays a step."""

    def with_steps_for(self, sweeps: int) -> NeuralConfig:
        """Return the settings with the number of steps that a log of so many sweeps needs."""
        if self.steps_a_sweep is None:
            return self
        steps = min(self.steps, max(self.steps // 2, self.steps_a_sweep * sweeps))
        return replace(self, steps=steps, steps_a_sweep=None)


def config_from_json(value: Mapping[str, Any]) -> NeuralConfig:
    """Make settings from a mapping (the inverse of `dataclasses.asdict`).

    Raises:
        ArtefactError: fields are missing or unknown.
    """
    try:
        nested = {
            "background_grid": HashGridSpec(**value["background_grid"]),
            "actor_grid": HashGridSpec(**value["actor_grid"]),
            "weights": LossWeights(**value["weights"]),
            "cameras": tuple(value["cameras"]),
        }
        return NeuralConfig(**{**value, **nested})
    except (KeyError, TypeError) as error:
        raise ArtefactError(
            "the settings of the neural field have missing or unknown fields",
            got=error,
            remedy="Build again.",
        ) from error


def draft() -> NeuralConfig:
    """Preview settings: two minutes on two cores."""
    return NeuralConfig(steps=600)


def standard() -> NeuralConfig:
    """Default settings: a residual on the fused LiDAR.

    On log 002 (13 sweeps) 1,000 steps are as good as 2,000 (docs/benchmarks/throughput.md); fewer
    steps than 2,000 were not measured on long logs.
    """
    return NeuralConfig(steps_a_sweep=50)


def paper() -> NeuralConfig:
    """Field and losses of the paper (Sec. 3.3): no prior; L_rgb, L_lidar, L_reg; UniSim opacity."""
    return NeuralConfig(
        steps=20_000,
        has_prior=False,
        has_camera_gains=False,
        conversion="unisim",
        depth_norm="l2",
        colour_norm="l2",
        weights=LossWeights(
            lidar=0.1,
            opacity=0.0,
            eikonal=0.1,
            occupancy=0.1,
            free_space=0.0,
            surface=0.0,
            sky=0.0,
            residual=0.0,
            smooth=0.0,
        ),
    )
