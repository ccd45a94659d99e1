"""Command-line options that choose a renderer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from lightsim.core.checks import check_choice, check_number

RendererName = Literal["transport", "path", "cycles"]
Backend = Literal["auto", "embree", "mitsuba-cuda", "mitsuba-llvm"]


@dataclass(frozen=True, kw_only=True)
class LightChoice:
    """Method that computes the light on surfaces."""

    renderer: RendererName = "transport"
    """transport: one light transport matrix for all skies; path: Mitsuba's path tracer; cycles:
    Blender's path tracer, in a separate process. The latter two start anew for every sky."""
    rays: int | None = None
    """Rays over the hemisphere of each traced pixel, or paths of each pixel; more rays give less
    noise. The default depends on the renderer."""
    bounces: int | None = None
    """Bounces of light between surfaces, 1 to 64; by default 1 with the light transport matrix (4
    for relighting a log), 4 with the path tracers."""
    blender_python: Path | None = None
    """Python 3.11 interpreter that has bpy 4.5, for --renderer cycles."""

    def __post_init__(self) -> None:
        # Options are checked at construction, before any data is read.
        check_choice("--renderer", self.renderer, get_args(RendererName))
        if self.rays is not None:
            # A million rays take minutes a pixel: a larger number is a typing error.
            check_number("--rays", self.rays, 1, 1 << 20)
        if self.bounces is not None:
            check_number("--bounces", self.bounces, 1, 64)


@dataclass(frozen=True, kw_only=True)
class RendererChoice(LightChoice):
    """Method that computes light, and settings of its images."""

    backend: Backend = "auto"
    """Ray caster of the light transport matrix; auto: CUDA if available, else Embree."""
    pixel_samples: int = 4
    """Samples of each pixel in the light transport matrix: 1, 4, 9, 16; more samples give smoother
    edges."""
    denoise: bool = False
    """Remove noise from `image` with Open Image Denoise (extra `denoise`)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("--backend", self.backend, get_args(Backend))
