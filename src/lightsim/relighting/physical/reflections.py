"""Exchange of the reflections of the source sky in a picture for those of the target sky."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.buffers import ShadowBuffers
from lightsim.relighting.physical.filters import median_smoothed
from lightsim.relighting.physical.light_change import Lights

# Chosen by eye on log 002 and the street of seed 0; measured only in combination
# (docs/benchmarks/relighting.md).

# Largest fraction of a pixel's radiance that may be reflection.
_MAX_REFLECTED = 0.7
# Width of the median over reflections, as a fraction of the picture's width.
_REFLECTION_DETAIL = 6 / 480


@dataclass(frozen=True, eq=False)
class SourceLight:
    """Light of the source sky, and its reflections without thin details.

    Args:
        light, sunlight, picture_weight: see `Lights`.
        reflected: smoothed reflections; undefined at pixels that are mostly sky.
        sharp_reflected: reflections in which shadows of the sun are as thin as in the pictures,
            such as that of a post on a wet road; undefined where `picture_weight` is 0.
    """

    light: ShadowBuffers
    sunlight: Float32[np.ndarray, "h w 3"] | None
    picture_weight: Float32[np.ndarray, "h w"] | None
    reflected: Float32[np.ndarray, "h w 3"]
    sharp_reflected: Float32[np.ndarray, "h w 3"] | None


def source_light(
    light: ShadowBuffers,
    sunlight: Float32[np.ndarray, "h w 3"] | None,
    picture_weight: Float32[np.ndarray, "h w"] | None,
    is_not_sky: Bool[np.ndarray, "h w"],
    width_px: int,
) -> SourceLight:
    """Smooth the reflections of the source sky at pixels that are mostly not sky."""
    reflected = median_smoothed(light.reflected, _REFLECTION_DETAIL, width_px, is_not_sky)
    sharp_reflected = None
    if picture_weight is not None:
        open_sun, visibility = light.reflected_sun, light.sun_visibility[..., None]
        rest = np.maximum(light.reflected - visibility * open_sun, 0.0)
        rest, open_sun = (
            median_smoothed(part, _REFLECTION_DETAIL, width_px, is_not_sky & (picture_weight > 0))
            for part in (rest, open_sun)
        )
        sharp_reflected = rest + visibility * open_sun
    return SourceLight(light, sunlight, picture_weight, reflected, sharp_reflected)


def exchanged_reflections(
    foreground: Float32[np.ndarray, "h w 3"],
    source: SourceLight,
    lights: Lights,
    is_surface: Bool[np.ndarray, "h w"],
    width_px: int,
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"]]:
    """Return the picture without the reflections of the source, and the reflections of the target.

    Where the modelled reflection exceeds the maximum fraction of the picture's radiance, it is
    reduced; that of the target is reduced by the same factor.
    """
    before = source.reflected
    if lights.picture_weight is not None and source.sharp_reflected is not None:
        before = before + lights.picture_weight[..., None] * (source.sharp_reflected - before)
    after = median_smoothed(lights.target.reflected, _REFLECTION_DETAIL, width_px, is_surface)
    held = np.where(is_surface[..., None], before, 0.0)
    most = np.float32(_MAX_REFLECTED) * foreground
    part = np.where(held > most, most / np.maximum(held, np.float32(1e-9)), 1.0)
    reflected = np.where(is_surface[..., None], part * after, 0.0)
    return (foreground - part * held).astype(np.float32), reflected.astype(np.float32)
