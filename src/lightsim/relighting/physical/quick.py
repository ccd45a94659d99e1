"""Relighting of a small picture by the plain ratio of two lights, for previews."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.found_visibility import unoccluded_sun, with_sun_visibility
from lightsim.relighting.physical.light_change import median_light
from lightsim.relighting.physical.matte import composite, foreground_radiance
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs, refined_visibility


@dataclass(frozen=True, eq=False)
class QuickFrame:
    """Quantities of one frame that do not depend on the target sky.

    Args:
        foreground: linear radiance of the surfaces, scene units, without the recorded sky.
        sky_matte: fraction of each pixel that is sky, in [0, 1].
        is_surface: pixels with geometry that are mostly surface.
        light: irradiance / pi under the source sky, with the shadow edges of the picture.
        floor: light that is added to both lights, which limits the ratio in the dark.
    """

    foreground: Float32[np.ndarray, "h w 3"]
    sky_matte: Float32[np.ndarray, "h w"]
    is_surface: Bool[np.ndarray, "h w"]
    light: Float32[np.ndarray, "h w 3"]
    floor: Float32[np.ndarray, "3"]


def quick_frame(inputs: RelightInputs, config: RatioConfig) -> QuickFrame:
    """Prepare a frame; the target light of `inputs` is not used."""
    source, sun = inputs.source, inputs.source_sun
    if sun is not None and sun.direction_world[2] > 0:
        # Shadow edges of the picture: rendered ones would leave a rim of the recorded shadow.
        sunlight = unoccluded_sun(inputs.buffers, source, sun)
        source = with_sun_visibility(source, sunlight, refined_visibility(inputs, sun))
    is_surface = inputs.buffers.has_surface & (inputs.sky_matte < 0.5)
    floor = np.float32(config.darkest_fraction) * median_light(source.shaded, is_surface)
    # The lower bound prevents a division by zero in a frame without light.
    floor = np.maximum(floor, np.float32(1e-8))
    foreground = foreground_radiance(inputs.radiance, inputs.sky_matte)
    return QuickFrame(foreground, inputs.sky_matte, is_surface, source.shaded, floor)


def quick_relit(
    frame: QuickFrame,
    light: Float32[np.ndarray, "h w 3"],
    sky: Float32[np.ndarray, "h w 3"],
) -> Float32[np.ndarray, "h w 3"]:
    """Return the linear radiance of a frame under a target sky, without smoothing of the ratio.

    Args:
        light: irradiance / pi under the target sky.
        sky: target sky along the pixels' rays.
    """
    ratio = (light + frame.floor) / (frame.light + frame.floor)
    if frame.is_surface.any():
        # Thin objects without geometry, such as wires, change like the median surface.
        typical = np.median(ratio[frame.is_surface][::7], axis=0).astype(np.float32)
        ratio = np.where(frame.is_surface[..., None], ratio, typical)
    return composite((frame.foreground * ratio).astype(np.float32), sky, frame.sky_matte)
