"""Physical relighting: the image divided by its shading and multiplied by that of the target sky.

Texture and detail that the mesh omits are preserved, because only the light is exchanged
(quotient images, Shashua and Riklin-Raviv 2001, doi:10.1109/34.908964). Where the image has no
information (clipped, or in a deep shadow that the target sky lights), the base colour of the twin
is used. Paper, Sec. 4: its network is compared to this method and trained on it.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

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
from lightsim.relighting.physical.reflections import (
    SourceLight,
    exchanged_reflections,
    source_light,
)
from lightsim.relighting.physical.shadow_refine import border_fraction, refine_sun_visibility

Result = TypeVar("Result")

# Lower limit of light and variances, against logarithms and quotients of zero.
_TINY = 1e-8

# Chosen by eye on log 002 and the street of seed 0; measured only in combination
# (docs/benchmarks/relighting.md).

# Width of the rim around enclosed pixels, in pixels, in which smoothed light is wrong.
_ENCLOSED_RIM_PX = 3
# Relative error of a ratio per e-fold by which it changes the light. Larger values, which favour
# the base colour, score higher on noisy synthetic pictures, but remove details of the picture that
# no mesh and no texture contains.
_SHADING_DEVIATION = 0.35
# Absolute error of the recorded radiance in the dark: noise and 8-bit rounding.
_RADIANCE_DEVIATION = 0.004
# Width of the median over corrections by the base colour, as a fraction of the picture's width.
_CORRECTION_DETAIL = 4 / 480
# Angle between both suns, in degrees, up to which estimated shadow edges also apply to the target.
_SAME_SUN_DEG = 2.0


@dataclass(frozen=True, eq=False)
class CameraAndSkies:
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
        camera_and_skies: further inputs of networks; None for physical relighting.
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
    camera_and_skies: CameraAndSkies | None = None
    # Results of `cached_for_source`; `replace` starts an empty table, as the source may change.
    _source_cache: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False)

    def under(
        self,
        target: ShadowBuffers,
        target_sky: Float32[np.ndarray, "h w 3"],
        target_sun: Sun | None,
        camera_and_skies: CameraAndSkies | None,
    ) -> RelightInputs:
        """Return the same frame under another target sky, with the cache of the source."""
        other = replace(
            self,
            target=target,
            target_sky=target_sky,
            target_sun=target_sun,
            camera_and_skies=camera_and_skies,
        )
        object.__setattr__(other, "_source_cache", self._source_cache)
        return other

    def cached_for_source(self, compute: Callable[..., Result], *settings: Hashable) -> Result:
        """Return compute(self, *settings), computed once for all target skies of the frame.

        Args:
            compute: function that depends on no field of the target.
        """
        key = compute, *settings
        if key not in self._source_cache:
            self._source_cache[key] = compute(self, *settings)
        return self._source_cache[key]

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
    foreground = inputs.cached_for_source(_foreground)
    source = inputs.cached_for_source(_source_light, config.are_shadows_refined)
    lights = _lights(source, inputs)
    if inputs.camera_and_skies is not None:
        lights = replace(lights, log_sky_ratio=_log_sky_ratio(inputs.camera_and_skies))
    # Pixels that are mostly sky have no surface; the surface of enclosed pixels is not usable.
    is_surface = inputs.buffers.has_surface & (inputs.sky_matte < 0.5)
    is_surface &= ~_is_enclosed(foreground, inputs.source, is_surface, config)
    ratio = np.exp(
        log_light_change(
            lights, inputs.buffers, is_surface, config.darkest_fraction, inputs.width_px
        )
    )
    foreground = denoised_where_amplified(foreground, ratio.max(axis=-1))
    diffuse, reflected = exchanged_reflections(
        foreground, source, lights, is_surface, inputs.width_px
    )
    relit = _relit_surface(diffuse, ratio, inputs, lights.target, is_surface, config) + reflected
    return composite(relit, inputs.target_sky, inputs.sky_matte)


def refined_visibility(inputs: RelightInputs, sun: Sun) -> Float32[np.ndarray, "h w"]:
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


def _foreground(inputs: RelightInputs) -> Float32[np.ndarray, "h w 3"]:
    return foreground_radiance(inputs.radiance, inputs.sky_matte)


def _source_light(inputs: RelightInputs, is_refined: bool) -> SourceLight:
    """Source light, with the shadow edges of the image if it is refined."""
    light, sun, sunlight, weight = inputs.source, inputs.source_sun, None, None
    if is_refined and sun is not None and sun.direction_world[2] > 0:
        visibility = refined_visibility(inputs, sun)
        sunlight = unoccluded_sun(inputs.buffers, inputs.source, sun)
        light = with_sun_visibility(inputs.source, sunlight, visibility)
        weight = np.zeros_like(visibility)
        if inputs.found_visibility is not None:
            # Away from shadow borders, details of the estimate from pictures are mostly noise.
            weight = border_fraction(visibility, inputs.width_px)
            weight *= np.isfinite(inputs.found_visibility)
    return source_light(light, sunlight, weight, inputs.sky_matte < 0.5, inputs.width_px)


def _lights(source: SourceLight, inputs: RelightInputs) -> Lights:
    """Source and target light; a target sun in the same place has the source's shadow edges."""
    lights = Lights(source.light, inputs.target, source.sunlight, source.picture_weight)
    sun, other = inputs.source_sun, inputs.target_sun
    if source.picture_weight is None or sun is None or other is None:
        return lights
    # Equal suns have equal shadow edges; the errors of distant suns are independent.
    angle = angle_between_deg(sun.direction_world, other.direction_world)
    fraction = np.float32(max(0.0, 1.0 - angle / _SAME_SUN_DEG))
    if fraction == 0:
        return lights
    change = source.light.sun_visibility - inputs.source.sun_visibility
    moved = np.clip(inputs.target.sun_visibility + fraction * change, 0.0, 1.0)
    sunlight = unoccluded_sun(inputs.buffers, inputs.target, other)
    target = with_sun_visibility(inputs.target, sunlight, moved.astype(np.float32))
    weight = (1 - fraction) * source.picture_weight
    return replace(lights, target=target, picture_weight=weight)


def _log_sky_ratio(camera_and_skies: CameraAndSkies) -> Float32[np.ndarray, "3"]:
    """Log of the target sky's mean radiance over the source's (`Lights.log_sky_ratio`)."""
    source, target = (
        np.log(np.maximum(sky.mean_radiance, _TINY))
        for sky in (camera_and_skies.source_sky, camera_and_skies.target_sky)
    )
    return (target - source).astype(np.float32)


def _is_enclosed(
    foreground: Float32[np.ndarray, "h w 3"],
    source: ShadowBuffers,
    is_surface: Bool[np.ndarray, "h w"],
    config: RatioConfig,
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of pixels that are dark in the rendering but not in the picture, dilated.

    There the camera looks through a hole of the mesh into a closed volume, whose surfaces are not
    usable. The rim of the hole is not usable either, because light is smoothed across it.
    """
    from scipy.ndimage import binary_dilation

    least = np.float32(config.darkest_fraction) * median_light(source.shaded, is_surface)
    is_dark = (source.shaded <= 0.25 * least).all(axis=-1)
    is_bright = (foreground > least).any(axis=-1)
    return np.asarray(
        binary_dilation(is_surface & is_dark & is_bright, iterations=_ENCLOSED_RIM_PX)
    )


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
    relative_variance = np.float32(config.base_colour_deviation) ** 2 + _other_surface(
        foreground, inputs, is_surface, config
    )
    variance_model = np.square(by_model) * relative_variance + np.float32(_TINY)
    of_ratio, of_model = (v.sum(axis=-1, keepdims=True) for v in (variance_ratio, variance_model))
    weight = np.where(is_surface[..., None], of_model / (of_model + of_ratio), 1.0)
    mixed = weight * by_ratio + (1 - weight) * by_model
    floor = np.float32(config.darkest_fraction) * median_light(target.shaded, is_surface) + _TINY
    correction = np.log(np.maximum(mixed, 0) + floor) - np.log(np.maximum(by_ratio, 0) + floor)
    is_informative = is_surface & ~inputs.is_clipped
    smooth = median_smoothed(
        correction.astype(np.float32), _CORRECTION_DETAIL, inputs.width_px, is_informative
    )
    detailed = (np.maximum(by_ratio, 0) + floor) * np.exp(smooth) - floor
    return np.where(is_informative[..., None], np.maximum(detailed, 0), mixed).astype(np.float32)


def _other_surface(
    foreground: Float32[np.ndarray, "h w 3"],
    inputs: RelightInputs,
    is_surface: Bool[np.ndarray, "h w"],
    config: RatioConfig,
) -> Float32[np.ndarray, "h w 1"]:
    """Return the squared log difference between the picture and the range of radiance that the
    model allows under the source sky; undefined without a surface.

    It is the sum of the squared difference in colour and that in brightness beyond full sun or full
    shadow. It detects wrong outlines of meshes: the green of a crown must not appear on the wall
    beside it.
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
        is_surface,
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
