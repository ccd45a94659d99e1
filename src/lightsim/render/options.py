"""The choice of a renderer, as a user gives it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from lightsim.core.checks import check_choice, check_number

RendererName = Literal["transport", "path", "cycles"]
Backend = Literal["auto", "embree", "mitsuba-cuda", "mitsuba-llvm"]
_MOST_BOUNCES = 64
_MOST_RAYS = 1 << 20
"""Minutes for each pixel; beyond it somebody has slipped a digit."""


@dataclass(frozen=True, kw_only=True)
class LightChoice:
    """Who computes the light on surfaces."""

    renderer: RendererName = "transport"
    """transport: one light transport matrix for all skies; path: Mitsuba's path tracer; cycles:
    Blender's, in a process of its own. The latter two start anew for every sky."""
    rays: int | None = None
    """Rays over the hemisphere of each traced pixel, or paths of each pixel; more are less
    noisy. By default the renderer's own number."""
    bounces: int | None = None
    """Of light between surfaces, 1 to 64; by default 1 with the light transport matrix (4 where a
    log is relit), 4 with the others."""
    blender_python: Path | None = None
    """Python 3.11 that has bpy 4.5, for --renderer cycles."""

    def __post_init__(self) -> None:
        check_choice("--renderer", self.renderer, get_args(RendererName))
        if self.rays is not None:
            check_number("--rays", self.rays, 1, _MOST_RAYS)
        if self.bounces is not None:
            check_number("--bounces", self.bounces, 1, _MOST_BOUNCES)


@dataclass(frozen=True, kw_only=True)
class RendererChoice(LightChoice):
    """How light is computed, and images of it."""

    backend: Backend = "auto"
    """What casts the rays of the light transport matrix: auto takes CUDA where there is one, else
    Embree."""
    pixel_samples: int = 4
    """Points of each pixel at which the light transport matrix looks: 1, 4, 9, 16; more are
    smoother edges."""
    denoise: bool = False
    """Remove noise from `image` with Open Image Denoise (extra `denoise`)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("--backend", self.backend, get_args(Backend))
