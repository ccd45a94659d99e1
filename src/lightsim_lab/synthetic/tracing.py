"""Common part of the street's path tracers (Mitsuba, Cycles)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float32

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.render.denoise import denoise
from lightsim_lab.synthetic.guides import Guides
from lightsim_lab.synthetic.shapes import Part

# Number of reflections between surfaces: a path has up to five surfaces before the light.
BOUNCES = 4
# Number of independent passes per image, whose median detects outliers.
_PASSES = 6
# Largest ratio of a pass to the median of all passes. Sunlight that glass and paint reflect onto
# other surfaces (caustics) causes rare, very bright samples; they are clipped.
_MAX_PASS_RATIO = 2.5


@dataclass(frozen=True, eq=False)
class Placed:
    """Parts of one actor, with the key under which they can be moved."""

    key: str
    parts: tuple[Part, ...]


class StreetTracer(Protocol):
    """Path-traced street under one sky."""

    @property
    def variant(self) -> str:
        """Name of the renderer's variant."""
        ...

    def place(self, world_from_actors: Mapping[str, RigidTransform]) -> None:
        """Set the poses of the named actors."""
        ...

    def render(
        self,
        camera: PinholeCamera,
        margin_px: tuple[int, int],
        world_from_camera: RigidTransform,
        samples: int,
        seed: int,
        guides: Guides | None = None,
    ) -> Float32[np.ndarray, "h w 3"]:
        """Render the radiance in scene units, box filtered over each pixel.

        Args:
            margin_px: offset (u, v) of the principal point from the image centre.
            samples: light paths per pixel.
            guides: guides of this view for denoising; None: no denoising.
        """
        ...


def traced(
    one_pass: Callable[[int, int], Float32[np.ndarray, "h w 3"]],
    samples: int,
    seed: int,
    guides: Guides | None,
) -> Float32[np.ndarray, "h w 3"]:
    """Return the mean of several passes, clipped at a multiple of their median, and denoised.

    Args:
        one_pass: renders an image of a number of light paths per pixel and a seed.
        samples: light paths per pixel in total; below 24 there is one pass, which is not clipped.
        guides: guides of the view for denoising; None: no denoising.
    """
    # With fewer than 4 paths per pass, the median of the passes is too noisy as a reference.
    if samples < 4 * _PASSES:
        radiance = one_pass(samples, seed)
    else:
        seeds = range(seed * _PASSES, (seed + 1) * _PASSES)
        images = np.stack([one_pass(samples // _PASSES, one) for one in seeds])
        # The offset, in scene units, protects dark pixels, where the median is unreliable.
        limit = _MAX_PASS_RATIO * np.median(images, axis=0) + 0.02
        radiance = np.minimum(images, limit).mean(axis=0)
    if guides is None:
        return radiance
    return denoise(radiance, guides.base_colour, guides.normal_world)
