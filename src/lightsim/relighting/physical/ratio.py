"""Physical relighting: the image divided by its own shading, times that of the target sky.

Every texture and every detail that no mesh holds stays in the picture, because only the light is
exchanged (quotient images, Shashua and Riklin-Raviv 2001, doi:10.1109/34.908964). Where the image
carries no information (clipped, or deep in a shadow that the target lights up), the base colour
of the twin stands in. Paper, Sec. 4: this is what its network is compared to and trained on.
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

_ENCLOSED_RIM_PX = 3
_TINY = 1e-8


# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/relighting.md).

# Of a pixel's radiance, the most that may be reflection.
_MOST_REFLECTED = 0.7
# Relative error of a ratio for every e-fold by which it changes the light. More trust in the base
# colour scores higher on grainy synthetic pictures, but takes details from the picture that no mesh
# and no texture holds.
_SHADING_DEVIATION = 0.35
# Absolute error of the recorded radiance: noise and 8 bits in the dark.
_RADIANCE_DEVIATION = 0.004
# Widths of the medians, as fractions of the picture's, over reflections, and over what the base
# colour corrects.
_REFLECTION_DETAIL, _CORRECTION_DETAIL = 6 / 480, 4 / 480
# Up to this angle between the suns, found shadow edges hold for the target as well.
_SAME_SUN_DEG = 2.0


@dataclass(frozen=True, eq=False)
class Circumstances:
    """Under which a frame was taken and shall be shown; networks look at pictures and skies.

    Args:
        gain: of the camera; times radiance it is the linear picture, 1 its white.
        world_from_camera: where it stands.
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
        source: light of the sky under which the image was taken.
        target: light of the sky wanted.
        target_sky: the target dome along the pixels' rays, sun included.
        source_sun: the sun of the source sky; without it, its shadows are taken as rendered.
        target_sun: the sun of the target sky, if it has one.
        found_visibility: of the source's sun, as all pictures together show it; NaN where they
            show none, and the rendered one holds.
        picture_width_px: of the picture that these arrays are a window of; None: they are all of
            it.
        circumstances: what networks need besides; None: physical relighting alone is asked for.
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
        """Of the whole picture: filters are as wide as a part of it."""
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
    """How shading ratios are made robust."""

    are_shadows_refined: bool = True
    """Move the source's shadow edges to where the image has them."""
    darkest_fraction: float = 0.02
    """Light below this fraction of the frame's median counts as that much, under both skies."""
    base_colour_deviation: float = 0.3
    """Relative error of the twin's base colour times target light."""


def relight_physical(inputs: RelightInputs, config: RatioConfig) -> Float32[np.ndarray, "h w 3"]:
    """Scene radiance of the frame under the target sky, linear, before camera gain.

    With the source sky as the target, the source comes back outside clipped pixels and sky.
    """
    foreground = foreground_radiance(inputs.radiance, inputs.sky_matte)
    lights = Lights(inputs.source, inputs.target)
    if config.are_shadows_refined:
        lights = _refined(inputs)
    if inputs.circumstances is not None:
        lights = replace(lights, around=_change_around(inputs.circumstances))
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


def _refined(inputs: RelightInputs) -> Lights:
    """Source and target light with the shadow edges that the image shows."""
    sun = inputs.source_sun
    if sun is None or sun.direction_world[2] <= 0:
        return Lights(inputs.source, inputs.target)
    rendered = inputs.source.sun_visibility
    believed = with_found_visibility(inputs.source, inputs.buffers, sun, inputs.found_visibility)
    visibility = refine_sun_visibility(
        inputs.radiance,
        inputs.buffers,
        believed,
        sun,
        inputs.sky_matte < 0.5,
        inputs.width_px,
    )
    sunlight = unoccluded_sun(inputs.buffers, inputs.source, sun)
    source = with_sun_visibility(inputs.source, sunlight, visibility)
    told = np.zeros_like(visibility)
    if inputs.found_visibility is not None:
        # Away from borders what pictures tell is grain.
        told = border_fraction(visibility, inputs.width_px)
        told *= np.isfinite(inputs.found_visibility)
    if inputs.target_sun is None:
        return Lights(source, inputs.target, sunlight, told)
    # The same sun has the same shadow edges; two suns apart err independently.
    angle = angle_between_deg(sun.direction_world, inputs.target_sun.direction_world)
    fraction = np.float32(max(0.0, 1.0 - angle / _SAME_SUN_DEG))
    if fraction == 0:
        return Lights(source, inputs.target, sunlight, told)
    moved = np.clip(inputs.target.sun_visibility + fraction * (visibility - rendered), 0.0, 1.0)
    other = unoccluded_sun(inputs.buffers, inputs.target, inputs.target_sun)
    target = with_sun_visibility(inputs.target, other, moved.astype(np.float32))
    return Lights(source, target, sunlight, (1 - fraction) * told)


def _change_around(circumstances: Circumstances) -> Float32[np.ndarray, "3"]:
    """`Lights.around` of these skies."""
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
    """Pixels where no light arrives in the rendering and the picture shows some: the camera looks
    through a hole of the mesh into what is closed all around. Their mesh tells nothing, nor does
    the rim of the hole, where light is smoothed."""
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
    """The picture without what its surfaces reflect of the source, and what they reflect of the
    target. Where the model reflects more than the picture can hold, part of it is believed, and the
    same part of the target's."""
    source = lights.source
    before, after = (
        median_smoothed(light.reflected, _REFLECTION_DETAIL, width_px)
        for light in (source, lights.target)
    )
    if lights.told is not None:
        # A post's shadow on a road that mirrors the sun is as thin as pictures show it.
        open_sun, visibility = source.reflected_sun, source.sun_visibility[..., None]
        rest = np.maximum(source.reflected - visibility * open_sun, 0.0)
        rest, open_sun = (
            median_smoothed(part, _REFLECTION_DETAIL, width_px) for part in (rest, open_sun)
        )
        before = before + lights.told[..., None] * (rest + visibility * open_sun - before)
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
    """Ratio and base colour combined by the inverse of their variances, the same for all channels,
    or hues would shift. Where the picture tells anything, what the base colour changes is smooth:
    details come from the picture."""
    by_ratio = foreground * ratio
    by_model = inputs.buffers.base_colour * target.shaded
    change = np.abs(np.log(np.maximum(ratio, np.float32(1e-8))))
    variance_ratio = np.square(by_ratio * change * np.float32(_SHADING_DEVIATION))
    variance_ratio += np.square(np.maximum(ratio - 1, 0) * np.float32(_RADIANCE_DEVIATION))
    variance_ratio += np.square(np.where(inputs.is_clipped[..., None], by_ratio, 0.0))
    doubt = np.float32(config.base_colour_deviation) ** 2 + _other_surface(
        foreground, inputs, config
    )
    variance_model = np.square(by_model) * doubt + np.float32(1e-8)
    of_ratio, of_model = (v.sum(axis=-1, keepdims=True) for v in (variance_ratio, variance_model))
    weight = np.where(is_surface[..., None], of_model / (of_model + of_ratio), 1.0)
    mixed = weight * by_ratio + (1 - weight) * by_model
    floor = np.float32(config.darkest_fraction) * median_light(target.shaded, is_surface) + 1e-8
    correction = np.log(np.maximum(mixed, 0) + floor) - np.log(np.maximum(by_ratio, 0) + floor)
    smooth = median_smoothed(correction.astype(np.float32), _CORRECTION_DETAIL, inputs.width_px)
    detailed = (np.maximum(by_ratio, 0) + floor) * np.exp(smooth) - floor
    is_told = is_surface & ~inputs.is_clipped
    return np.where(is_told[..., None], np.maximum(detailed, 0), mixed).astype(np.float32)


def _other_surface(
    foreground: Float32[np.ndarray, "h w 3"], inputs: RelightInputs, config: RatioConfig
) -> Float32[np.ndarray, "h w 1"]:
    """Square of how far, in logs, the picture is from what the model can show under the source: in
    colour, and in brightness beyond all of the sun or none of it. Meshes end elsewhere than what
    they stand for: a crown's green must not lie on the wall beside it."""
    light = inputs.source
    floor = np.float32(config.darkest_fraction) * median_light(
        light.shaded, inputs.buffers.has_surface
    ) + np.float32(1e-8)
    modelled = np.log(inputs.buffers.base_colour * light.shaded + floor)
    apart = median_smoothed(
        (np.log(np.maximum(foreground, 0) + floor) - modelled).astype(np.float32),
        _CORRECTION_DETAIL,
        inputs.width_px,
    )
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
