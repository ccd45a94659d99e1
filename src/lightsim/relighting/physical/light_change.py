"""Change of light between source and target sky, per pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.relighting.physical.filters import fill_holes, median_smoothed

# Width of the median over the light's change on upright surfaces, as a fraction of the picture's
# width. Reveals, ledges, leaves and panes of meshes are inaccurate, so that details of the picture
# are preferred. Chosen on log 002 and the street of seed 0; sensitivity not measured.
_UPRIGHT_DETAIL = 14 / 480
# Width of the median on level surfaces, smaller because they have no relief and thin shadows on
# them are accurate.
_LEVEL_DETAIL = 5 / 480
# Vertical component of the normal, in magnitude, above which a surface is level.
_LEVEL = 0.8
# Distances to the nearest surface, as fractions of the picture's width, between which the light of
# a pixel without surface changes from that of the nearest surfaces to that of the whole sky.
_FAR = (0.01, 0.04)
# Added to light, against the logarithm of zero.
_TINY = np.float32(1e-8)


@dataclass(frozen=True, eq=False)
class Lights:
    """Light of source and target sky on one frame.

    Args:
        source: light of the source sky, with the sun visibility estimated from pictures where
            there is an estimate.
        target: light of the target sky.
        sunlight: irradiance of the unoccluded source sun, over pi; None without a sun.
        picture_weight: weight, in [0, 1], with which the source's sun visibility is taken from
            pictures rather than meshes; None means 0.
        log_sky_ratio: log of the target sky's light over the source's, over all directions; None if
            unknown.
    """

    source: ShadowBuffers
    target: ShadowBuffers
    sunlight: Float32[np.ndarray, "h w 3"] | None = None
    picture_weight: Float32[np.ndarray, "h w"] | None = None
    log_sky_ratio: Float32[np.ndarray, "3"] | None = None


def log_light_change(
    lights: Lights,
    buffers: GBuffers,
    is_surface: Bool[np.ndarray, "h w"],
    darkest_fraction: float,
    width_px: int,
) -> Float32[np.ndarray, "h w 3"]:
    """Return the log of target over source light, without thin details, which are inaccurate in
    meshes.

    Pixels without a mesh receive the value of their surroundings (0 without any). Far from all
    meshes they receive the ratio of the whole skies, because thin objects such as wires have no
    front that a sun behind the camera could light.

    Source shadows estimated from pictures are accurate and stay thin: the logs of target light over
    unlit and over lit source light are smoothed, and the visibility mixes the two.

    Args:
        is_surface: pixels whose light a mesh defines.
        darkest_fraction: fraction of its median that is added to each light, so that a pixel dark
            under both keeps its radiance instead of an arbitrary quotient.
        width_px: width of the picture that these arrays may be a window of.
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
    far = None if lights.log_sky_ratio is None else _far_fraction(is_surface, width_px)[..., None]

    def change(
        light: Float32[np.ndarray, "h w 3"], is_wanted: Bool[np.ndarray, "h w"]
    ) -> Float32[np.ndarray, "h w 3"]:
        raw = fill_holes((wanted - np.log(light + floors[0])).astype(np.float32), is_surface)
        if far is not None:
            raw = raw + far * (lights.log_sky_ratio - raw)
        return _without_relief(raw, is_level, is_wanted, width_px)

    smooth = change(source.shaded, np.ones_like(is_surface))
    weight = lights.picture_weight
    if lights.sunlight is None or weight is None or not weight.any():
        return smooth
    weight = np.where(is_surface, weight, np.float32(0))
    unlit = source.sky + source.bounce
    visibility = source.sun_visibility[..., None]
    cached_for_source = (1 - visibility) * np.exp(-change(unlit, weight > 0))
    cached_for_source += visibility * np.exp(-change(unlit + lights.sunlight, weight > 0))
    weight = weight[..., None]
    return (smooth - weight * (np.log(cached_for_source) + smooth)).astype(np.float32)


def median_light(
    light: Float32[np.ndarray, "h w 3"], is_surface: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "3"]:
    """Median of the light over the surfaces, per channel; every seventh pixel is sufficient."""
    values = light[is_surface][::7]
    return np.median(values, axis=0).astype(np.float32) if len(values) else np.zeros(3, np.float32)


def _far_fraction(is_surface: Bool[np.ndarray, "h w"], width_px: int) -> Float32[np.ndarray, "h w"]:
    """Weight of the whole sky in a pixel's light: 0 near surfaces, 1 far from all."""
    if is_surface.all():
        return np.zeros(is_surface.shape, np.float32)
    away = np.asarray(ndimage.distance_transform_edt(~is_surface)) / width_px
    near, far = _FAR
    return np.clip((away - near) / (far - near), 0.0, 1.0).astype(np.float32)


def _without_relief(
    log_ratio: Float32[np.ndarray, "h w 3"],
    is_level: Bool[np.ndarray, "h w"],
    is_wanted: Bool[np.ndarray, "h w"],
    width_px: int,
) -> Float32[np.ndarray, "h w 3"]:
    """Log ratio smoothed by medians: wide on upright surfaces, narrow on level ones; undefined at
    pixels that are not wanted."""
    level = median_smoothed(log_ratio, _LEVEL_DETAIL, width_px, is_wanted & is_level)
    upright = median_smoothed(log_ratio, _UPRIGHT_DETAIL, width_px, is_wanted & ~is_level)
    return np.where(is_level[..., None], level, upright)


def _with_steps(is_level: Bool[np.ndarray, "h w"], width_px: int) -> Bool[np.ndarray, "h w"]:
    """Level pixels, and upright ones between level ones above and below within the width of the
    upright median: kerbs and stairs count as level."""
    size = 2 * (round(_UPRIGHT_DETAIL * width_px) // 2) + 1
    wider = ndimage.maximum_filter1d(is_level.astype(np.uint8), size, axis=0)
    return ndimage.minimum_filter1d(wider, size, axis=0).astype(bool)
