"""By how much a target sky's light exceeds the source's, pixel by pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.relighting.physical.filters import fill_holes, median_smoothed

# Widths of the medians, as fractions of the picture's, over the light's change on upright and on
# level surfaces: reveals, ledges, leaves and panes of meshes are rough guesses that say less than
# the picture's own details. Level surfaces have no relief; on them thin shadows are known.
_UPRIGHT_DETAIL, _LEVEL_DETAIL = 14 / 480, 5 / 480
_LEVEL = 0.8
# Fractions of the picture's width: surfaces so near tell what light a pixel without one gets, and
# surfaces so far away nothing.
_NEAR, _FAR = 0.01, 0.04
_TINY = np.float32(1e-8)


@dataclass(frozen=True, eq=False)
class Lights:
    """Of both skies, on one frame.

    Args:
        source: with the sun visibility that pictures show, where they show any.
        sunlight: of the source without visibility, over pi; None without a sun.
        around: log of the target sky's light over the source's, over all directions; None: unknown.
        told: how far its visibility is what pictures show and meshes do not, 0 to 1; None: nowhere.
    """

    source: ShadowBuffers
    target: ShadowBuffers
    sunlight: Float32[np.ndarray, "h w 3"] | None = None
    told: Float32[np.ndarray, "h w"] | None = None
    around: Float32[np.ndarray, "3"] | None = None


def log_light_change(
    lights: Lights,
    buffers: GBuffers,
    is_surface: Bool[np.ndarray, "h w"],
    darkest_fraction: float,
    width_px: int,
) -> Float32[np.ndarray, "h w 3"]:
    """Log of target over source light, without thin details, which meshes only guess; where no mesh
    is, that of the surroundings (0 if there are none), and far from all meshes that of the skies
    as a whole: wires have no side that a sun behind the camera lights.

    The source's shadows as pictures show them are no guess: they stay as thin as they are. Light of
    the unlit and of the lit source, over the target's, is smooth; the visibility mixes the two.

    Args:
        is_surface: where a mesh tells of light.
        darkest_fraction: both lights get this fraction of their own median added, so that a pixel
            in the dark under both keeps its radiance instead of an arbitrary quotient.
        width_px: of the picture that these arrays may be a window of.
    """
    source, target = lights.source, lights.target
    if not is_surface.any():
        return np.zeros_like(source.shaded)
    is_level = _with_steps(np.abs(buffers.normal_world[..., 2]) > _LEVEL, width_px)
    floors = [
        np.float32(darkest_fraction) * median_light(light.shaded, is_surface) + _TINY
        for light in (source, target)
    ]
    wanted = np.log(target.shaded + floors[1])
    far = None if lights.around is None else _far_fraction(is_surface, width_px)[..., None]

    def change(light: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
        raw = fill_holes((wanted - np.log(light + floors[0])).astype(np.float32), is_surface)
        if far is not None:
            raw = raw + far * (lights.around - raw)
        return _without_relief(raw, is_level, width_px)

    calm = change(source.shaded)
    if lights.sunlight is None or lights.told is None or not lights.told.any():
        return calm
    unlit = source.sky + source.bounce
    visibility = source.sun_visibility[..., None]
    of_source = (1 - visibility) * np.exp(-change(unlit))
    of_source += visibility * np.exp(-change(unlit + lights.sunlight))
    told = np.where(is_surface, lights.told, np.float32(0))[..., None]
    return (calm - told * (np.log(of_source) + calm)).astype(np.float32)


def median_light(
    light: Float32[np.ndarray, "h w 3"], is_surface: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "3"]:
    """Per channel over the surfaces; every seventh pixel is plenty."""
    values = light[is_surface][::7]
    return np.median(values, axis=0).astype(np.float32) if len(values) else np.zeros(3, np.float32)


def _far_fraction(is_surface: Bool[np.ndarray, "h w"], width_px: int) -> Float32[np.ndarray, "h w"]:
    """How little the nearest surfaces tell of a pixel's light."""
    if is_surface.all():
        return np.zeros(is_surface.shape, np.float32)
    away = np.asarray(ndimage.distance_transform_edt(~is_surface)) / width_px
    return np.clip((away - _NEAR) / (_FAR - _NEAR), 0.0, 1.0).astype(np.float32)


def _without_relief(
    log_ratio: Float32[np.ndarray, "h w 3"], is_level: Bool[np.ndarray, "h w"], width_px: int
) -> Float32[np.ndarray, "h w 3"]:
    details = _LEVEL_DETAIL, _UPRIGHT_DETAIL
    level, upright = (median_smoothed(log_ratio, detail, width_px) for detail in details)
    return np.where(is_level[..., None], level, upright)


def _with_steps(is_level: Bool[np.ndarray, "h w"], width_px: int) -> Bool[np.ndarray, "h w"]:
    """Level pixels, and upright ones between level ones above and below, nearer than the median
    over upright surfaces is wide: kerbs and stairs are no relief."""
    size = 2 * (round(_UPRIGHT_DETAIL * width_px) // 2) + 1
    wider = ndimage.maximum_filter1d(is_level.astype(np.uint8), size, axis=0)
    return ndimage.minimum_filter1d(wider, size, axis=0).astype(bool)
