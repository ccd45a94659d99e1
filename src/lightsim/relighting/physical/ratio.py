"""Physical relighting: the image divided by its own shading, times that of the target sky.

All texture and detail that no mesh contains is preserved, because only the light is exchanged
(quotient images, Shashua and Riklin-Raviv 2001, doi:10.1109/34.908964). Where the image has no
information (clipped, or in a deep shadow that the target sky lights), the base colour of the twin
is used. Paper, Sec. 4: its network is compared to this method and trained on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.dome import SkyDome, Sun
from lightsim.core.found_visibility import (
    unoccluded_sun,
    with_found_visibility,
    with_sun_visibility,
)
from lightsim.core.frames import RigidTransform
from lightsim.core.solar import angle_between_deg
from lightsim.errors import InputError
from lightsim.relighting.physical.denoise import denoised_where_amplified
from lightsim.relighting.physical.filters import median_smoothed
from lightsim.relighting.physical.light_change import Lights, log_light_change, median_light
from lightsim.relighting.physical.matte import composite, foreground_radiance
from lightsim.relighting.physical.shadow_refine import border_fraction, refine_sun_visibility

# Lower limit of light and variances, against logarithms and quotients of zero.
_TINY = 1e-8

# Chosen by eye on log 002 and the street of seed 0; measured only in combination
# (docs/benchmarks/relighting.md).

# Rim around enclosed pixels, in pixels, where smoothed light is wrong.
_ENCLOSED_RIM_PX = 3
# Largest fraction of a pixel's radiance that may be reflection.
_MOST_REFLECTED = 0.7
# Relative error of a ratio per e-fold by which it changes the light. Larger values, which favour
# the base colour, score higher on noisy synthetic pictures, but remove details of the picture that
# no mesh and no texture contains.
_SHADING_DEVIATION = 0.35
# Absolute error of the recorded radiance in the dark: noise and 8-bit rounding.
_RADIANCE_DEVIATION = 0.004
# Width of the median over reflections, as a fraction of the picture's width.
_REFLECTION_DETAIL = 6 / 480
# Width of the median over corrections by the base colour, as a fraction of the picture's width.
_CORRECTION_DETAIL = 4 / 480
# Angle between both suns, in degrees, up to which estimated shadow edges also apply to the target.
_SAME_SUN_DEG = 2.0


@dataclass(frozen=True, eq=False)
class Circumstances:
    """Camera and skies of a frame, which only networks require.

    Args:
        gain: gain of the camera; radiance times gain is the linear picture, 1 its white.
        world_from_camera: pose of the camera.
        source_sky, target_sky: domes in scene units, sun included.
    """

    gain: Float32[np.ndarray, "3"]
    world_from_camera: RigidTransform
    source_sky: SkyDome
    target_sky: SkyDome


@dataclass(frozen=True, eq=False)
class RelightInputs:
    """One frame. Radiances are linear, in scene units.

    Args:
        radiance: the recorded image, linear, divided by the camera's gain.
        is_clipped: at least one channel of the recorded image is saturated.
        sky_matte: fraction of each pixel that is sky, in [0, 1].
        buffers: geometry, moving actors included.
        source: light of the source sky, under which the image was recorded.
        target: light of the target sky.
        target_sky: the target dome along the pixels' rays, sun included.
        source_sun: the sun of the source sky; without it, its shadows are taken as rendered.
        target_sun: the sun of the target sky, if it has one.
        found_visibility: visibility of the source's sun, estimated from all pictures; NaN where
            there is no estimate and the rendered visibility is used.
        picture_width_px: width of the picture that these arrays are a window of; None if they are
            the whole picture.
        circumstances: further inputs of networks; None for physical relighting.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    is_clipped: Bool[np.ndarray, "h w"]
    sky_matte: Float32[np.ndarray, "h w"]
    buffers: GBuffers
    source: ShadowBuffers
    target: ShadowBuffers
    target_sky: Float32[np.ndarray, "h w 3"]
    source_sun: Sun | None = None
    target_sun: Sun | None = None
    found_visibility: Float32[np.ndarray, "h w"] | None = None
    picture_width_px: int | None = None
    circumstances: Circumstances | None = None

    @property
    def width_px(self) -> int:
        """Width of the whole picture, to which the widths of filters are proportional."""
        return self.picture_width_px or self.radiance.shape[1]

    def __post_init__(self) -> None:
        size = self.radiance.shape[:2]
        arrays = {
            "is_clipped": self.is_clipped,
            "sky_matte": self.sky_matte,
            "buffers": self.buffers.depth_z_m,
            "source": self.source.shaded,
            "target": self.target.shaded,
            "target_sky": self.target_sky,
        }
        for name, array in arrays.items():
            if array.shape[:2] != size:
                raise InputError(
                    "the inputs of relighting differ in size",
                    where=name,
                    got=array.shape[:2],
                    expected=size,
                )


@dataclass(frozen=True)
class RatioConfig:
    """Settings that make shading ratios robust."""

    are_shadows_refined: bool = True
    """Move the source's shadow edges to those of the image."""
    darkest_fraction: float = 0.02
    """Fraction of the frame's median light that is added to the light of both skies."""
    base_colour_deviation: float = 0.3
    """Relative error of the twin's base colour times target light."""


def relight_physical(inputs: RelightInputs, config: RatioConfig) -> Float32[np.ndarray, "h w 3"]:
    """Return the scene radiance of the frame under the target sky, linear, before camera gain.

    With the source sky as target, the result is the source image, except in clipped pixels and sky.
    """
    foreground = foreground_radiance(inputs.radiance, inputs.sky_matte)
    lights = Lights(inputs.source, inputs.target)
    if config.are_shadows_refined:
        lights = _refined(inputs)
    if inputs.circumstances is not None:
        lights = replace(lights, around=_change_around(inputs.circumstances))
    # Pixels that are mostly sky have no surface of their own; enclosed ones a meaningless one.
    is_surface = inputs.buffers.has_surface & (inputs.sky_matte < 0.5)
    is_surface &= ~_is_enclosed(foreground, inputs.source, is_surface, config)
    ratio = np.exp(
        log_light_change(
            lights, inputs.buffers, is_surface, config.darkest_fraction, inputs.width_px
        )
    )
    foreground = denoised_where_amplified(foreground, ratio.max(axis=-1))
    diffuse, reflected = _exchanged_reflections(foreground, lights, is_surface, inputs.width_px)
    relit = _relit_surface(diffuse, ratio, inputs, lights.target, is_surface, config) + reflected
    return composite(relit, inputs.target_sky, inputs.sky_matte)


def shown_visibility(inputs: RelightInputs, sun: Sun) -> Float32[np.ndarray, "h w"]:
    """Visibility of the source's sun, from all pictures and refined by the image."""
    found = with_found_visibility(inputs.source, inputs.buffers, sun, inputs.found_visibility)
    return refine_sun_visibility(
        inputs.radiance,
        inputs.buffers,
        found,
        sun,
        inputs.sky_matte < 0.5,
        inputs.width_px,
    )


def _refined(inputs: RelightInputs) -> Lights:
    """Source and target light with the shadow edges of the image."""
    sun = inputs.source_sun
    if sun is None or sun.direction_world[2] <= 0:
        return Lights(inputs.source, inputs.target)
    rendered = inputs.source.sun_visibility
    visibility = shown_visibility(inputs, sun)
    sunlight = unoccluded_sun(inputs.buffers, inputs.source, sun)
    source = with_sun_visibility(inputs.source, sunlight, visibility)
    weight = np.zeros_like(visibility)
    if inputs.found_visibility is not None:
        # Away from shadow borders the estimate from pictures is mostly noise.
        weight = border_fraction(visibility, inputs.width_px)
        weight *= np.isfinite(inputs.found_visibility)
    if inputs.target_sun is None:
        return Lights(source, inputs.target, sunlight, weight)
    # Equal suns have equal shadow edges; the errors of distant suns are independent.
    angle = angle_between_deg(sun.direction_world, inputs.target_sun.direction_world)
    fraction = np.float32(max(0.0, 1.0 - angle / _SAME_SUN_DEG))
    if fraction == 0:
        return Lights(source, inputs.target, sunlight, weight)
    moved = np.clip(inputs.target.sun_visibility + fraction * (visibility - rendered), 0.0, 1.0)
    other = unoccluded_sun(inputs.buffers, inputs.target, inputs.target_sun)
    target = with_sun_visibility(inputs.target, other, moved.astype(np.float32))
    return Lights(source, target, sunlight, (1 - fraction) * weight)


def _change_around(circumstances: Circumstances) -> Float32[np.ndarray, "3"]:
    """Log of the target sky's mean radiance over the source's (`Lights.around`)."""
    source, target = (
        np.log(np.maximum(sky.mean_radiance, _TINY))
        for sky in (circumstances.source_sky, circumstances.target_sky)
    )
    return (target - source).astype(np.float32)


def _is_enclosed(
    foreground: Float32[np.ndarray, "h w 3"],
    source: ShadowBuffers,
    is_surface: Bool[np.ndarray, "h w"],
    config: RatioConfig,
) -> Bool[np.ndarray, "h w"]:
    """Pixels without light in the rendering but not in the picture, with a rim.

    There the camera looks through a hole of the mesh into a closed volume, whose surfaces carry no
    information; neither does the rim of the hole, where light is smoothed.
    """
    from scipy.ndimage import binary_dilation

    least = np.float32(config.darkest_fraction) * median_light(source.shaded, is_surface)
    is_dark = (source.shaded <= 0.25 * least).all(axis=-1)
    is_bright = (foreground > least).any(axis=-1)
    return np.asarray(
        binary_dilation(is_surface & is_dark & is_bright, iterations=_ENCLOSED_RIM_PX)
    )


def _exchanged_reflections(
    foreground: Float32[np.ndarray, "h w 3"],
    lights: Lights,
    is_surface: Bool[np.ndarray, "h w"],
    width_px: int,
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"]]:
    """Return the picture without the reflections of the source, and the reflections of the target.

    Where the modelled reflection exceeds the possible part of the picture, it is reduced, and the
    target's by the same factor.
    """
    source = lights.source
    before, after = (
        median_smoothed(light.reflected, _REFLECTION_DETAIL, width_px)
        for light in (source, lights.target)
    )
    if lights.picture_weight is not None:
        # Shadows in the sun's reflection stay as thin as in the pictures: that of a post on a wet
        # road, for example.
        open_sun, visibility = source.reflected_sun, source.sun_visibility[..., None]
        rest = np.maximum(source.reflected - visibility * open_sun, 0.0)
        rest, open_sun = (
            median_smoothed(part, _REFLECTION_DETAIL, width_px) for part in (rest, open_sun)
        )
        weight = lights.picture_weight[..., None]
        before = before + weight * (rest + visibility * open_sun - before)
    held = np.where(is_surface[..., None], before, 0.0)
    most = np.float32(_MOST_REFLECTED) * foreground
    part = np.where(held > most, most / np.maximum(held, np.float32(1e-9)), 1.0)
    reflected = np.where(is_surface[..., None], part * after, 0.0)
    return (foreground - part * held).astype(np.float32), reflected.astype(np.float32)


def _relit_surface(
    foreground: Float32[np.ndarray, "h w 3"],
    ratio: Float32[np.ndarray, "h w 3"],
    inputs: RelightInputs,
    target: ShadowBuffers,
    is_surface: Bool[np.ndarray, "h w"],
    config: RatioConfig,
) -> Float32[np.ndarray, "h w 3"]:
    """Combine ratio and base colour by the inverse of their variances.

    All channels have the same weight, so that hues do not shift. Where the picture has information,
    the correction by the base colour is smoothed, so that details come from the picture.
    """
    by_ratio = foreground * ratio
    by_model = inputs.buffers.base_colour * target.shaded
    change = np.abs(np.log(np.maximum(ratio, _TINY)))
    variance_ratio = np.square(by_ratio * change * np.float32(_SHADING_DEVIATION))
    variance_ratio += np.square(np.maximum(ratio - 1, 0) * np.float32(_RADIANCE_DEVIATION))
    # The radiance of clipped pixels is unknown: relative error of 1.
    variance_ratio += np.square(np.where(inputs.is_clipped[..., None], by_ratio, 0.0))
    doubt = np.float32(config.base_colour_deviation) ** 2 + _other_surface(
        foreground, inputs, config
    )
    variance_model = np.square(by_model) * doubt + np.float32(_TINY)
    of_ratio, of_model = (v.sum(axis=-1, keepdims=True) for v in (variance_ratio, variance_model))
    weight = np.where(is_surface[..., None], of_model / (of_model + of_ratio), 1.0)
    mixed = weight * by_ratio + (1 - weight) * by_model
    floor = np.float32(config.darkest_fraction) * median_light(target.shaded, is_surface) + _TINY
    correction = np.log(np.maximum(mixed, 0) + floor) - np.log(np.maximum(by_ratio, 0) + floor)
    smooth = median_smoothed(correction.astype(np.float32), _CORRECTION_DETAIL, inputs.width_px)
    detailed = (np.maximum(by_ratio, 0) + floor) * np.exp(smooth) - floor
    is_informative = is_surface & ~inputs.is_clipped
    return np.where(is_informative[..., None], np.maximum(detailed, 0), mixed).astype(np.float32)


def _other_surface(
    foreground: Float32[np.ndarray, "h w 3"], inputs: RelightInputs, config: RatioConfig
) -> Float32[np.ndarray, "h w 1"]:
    """Squared difference, in logs, of the picture from all that the model can show under the source
    sky.

    It is the sum of the difference in colour and of the difference in brightness beyond full sun or
    full shadow. Meshes have wrong outlines: the green of a crown must not appear on the wall beside
    it.
    """
    light = inputs.source
    floor = np.float32(config.darkest_fraction) * median_light(
        light.shaded, inputs.buffers.has_surface
    ) + np.float32(_TINY)
    modelled = np.log(inputs.buffers.base_colour * light.shaded + floor)
    apart = median_smoothed(
        (np.log(np.maximum(foreground, 0) + floor) - modelled).astype(np.float32),
        _CORRECTION_DETAIL,
        inputs.width_px,
    )
    # The mean over channels is a difference of brightness, the rest a difference of hue.
    brighter = apart.mean(axis=-1, keepdims=True)
    colour = np.square(apart - brighter).sum(axis=-1, keepdims=True)
    most = least = light.shaded
    if inputs.source_sun is not None:
        sun = unoccluded_sun(inputs.buffers, light, inputs.source_sun)
        visibility = light.sun_visibility[..., None]
        most, least = light.shaded + (1 - visibility) * sun, light.shaded - visibility * sun
    here, high, low = (
        np.log(np.maximum(x, 0).mean(axis=-1, keepdims=True) + floor.mean())
        for x in (light.shaded, most, least)
    )
    beyond = np.maximum(brighter - (high - here), 0) + np.maximum((low - here) - brighter, 0)
    return (colour + np.square(beyond)).astype(np.float32)
