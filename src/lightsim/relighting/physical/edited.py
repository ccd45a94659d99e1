"""Source image of an edited street: I'_src of the paper's augmented reality representation.

Unchanged pixels are the recorded ones. Where the light changed, they are multiplied by its ratio
(quotient images, as in `ratio.py`). Where another surface is visible, the twin is rendered:
previously hidden surfaces with the colours of the real pixels around them, inserted actors with
their own (differential rendering, Debevec 1998, doi:10.1145/280814.280864). Paper, Sec. 4 and A.2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.buffers import BACKGROUND, GBuffers, ShadowBuffers
from lightsim.core.colour import luminance
from lightsim.core.dome import Sun
from lightsim.core.found_visibility import (
    unoccluded_sun,
    with_found_visibility,
    with_sun_visibility,
)
from lightsim.core.outline import grown_outline
from lightsim.relighting.physical.actor_layer import ActorLayer
from lightsim.relighting.physical.blur_noise import CameraBlurNoise
from lightsim.relighting.physical.filters import box_mean, fill_holes, median_smoothed
from lightsim.relighting.physical.ratio import (
    RatioConfig,
    RelightInputs,
    refined_visibility,
    relight_physical,
)

# Chosen by eye on log 002 and the street of seed 0; sensitivity not measured.

# Relative changes of light: below the first the recorded pixel remains, bit for bit; above the
# second the change is applied in full.
_VISIBLE_CHANGE = (0.02, 0.06)
# Minimum radius, as a fraction of the picture's width, of a change of light: smaller changes are
# sampling noise, such as one of 32 rays that hits a distant actor.
_STEADY_WIDTH = 1 / 100
# Factors on the light without the sun between which the rendered twin replaces the picture: under
# vehicles and directly beside them.
_CONTACT_RISE = (1.3, 2.0)
# Width of the windows, as a fraction of the picture's width, over which rendered colours are
# compared with recorded ones.
_MATCH_WIDTH = 12 / 480
# Largest factor between rendered and recorded colours.
_MATCH_LIMIT = 3.0
# The match with recorded colours makes the twin's base colour more accurate than the default.
_MATCHED = RatioConfig(are_shadows_refined=False, base_colour_deviation=0.1)
# Added to radiance and light before logarithms and quotients, in scene units.
_DARKEST = np.float32(1e-3)


@dataclass(frozen=True, eq=False)
class EditInputs:
    """One frame before and after edits, both under the source sky.

    Args:
        recorded: the picture, with geometry and light of the log; `target` is not used.
        buffers: geometry of the edited street.
        light: light of the edited street.
        found_visibility: see `RelightInputs`, for the edited street.
        sky: the source sky along the pixels' rays.
        removed_fraction: fraction of each pixel that shows removed actors.
        new: inserted actors, as the camera's sensor records them.
        sun_past_removed: visible fraction of the sun's disc past removed actors, at most.
        sun_past_new: visible fraction of the sun's disc past inserted actors, at most.
        is_fixed: pixels that never change: those of the ego vehicle.
        focal_px: focal length of the camera.
        blur_noise: sharpness of the camera.
        gain: picture value over radiance.
    """

    recorded: RelightInputs
    buffers: GBuffers
    light: ShadowBuffers
    found_visibility: Float32[np.ndarray, "h w"] | None
    sky: Float32[np.ndarray, "h w 3"]
    removed_fraction: Float32[np.ndarray, "h w"]
    new: ActorLayer
    sun_past_removed: Float32[np.ndarray, "h w"]
    sun_past_new: Float32[np.ndarray, "h w"]
    is_fixed: Bool[np.ndarray, "h w"]
    focal_px: float
    blur_noise: CameraBlurNoise
    gain: Float32[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class EditedImage:
    """Picture that the camera would have recorded in the edited street.

    Args:
        radiance: linear, scene units; where not `is_edited`, that of the recorded picture.
        is_edited: pixels that differ from the recorded picture.
        is_clipped: at least one channel is saturated in the recorded picture, which is still
            visible.
        sky_matte: fraction of sky.
        rendered: fraction of each pixel that is rendered rather than recorded.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    is_edited: Bool[np.ndarray, "h w"]
    is_clipped: Bool[np.ndarray, "h w"]
    sky_matte: Float32[np.ndarray, "h w"]
    rendered: Float32[np.ndarray, "h w"]


def edited_image(inputs: EditInputs) -> EditedImage:
    """Return the frame with its edits, under the sky under which it was recorded."""
    recorded = inputs.recorded
    before, after = _light_before_and_after(inputs)
    hidden = np.maximum(_grown_outline(inputs), _contact(before, after, inputs))
    match = _colour_match(inputs, before, hidden)
    change = _change(before, after, recorded, hidden)
    relit = _with_light_exchanged(inputs, before, after, match)
    picture = recorded.radiance
    background = picture + change[..., None] * (relit - picture)
    background += hidden[..., None] * (match * _twin_radiance(inputs, after) - background)
    radiance = inputs.new.over(background, inputs.blur_noise, inputs.gain)
    new = np.where(inputs.is_fixed, 0.0, inputs.new.coverage).astype(np.float32)
    is_new = (radiance != background).any(axis=-1)
    is_edited = ((change > 0) | (hidden > 0) | (new > 0) | is_new) & ~inputs.is_fixed
    # Fraction of each pixel that remains recorded, below both kinds of edits.
    kept = (1 - hidden) * (1 - new)
    sky = recorded.sky_matte * kept + (1 - new) * hidden * ~inputs.buffers.has_surface
    return EditedImage(
        np.where(is_edited[..., None], radiance, picture).astype(np.float32),
        is_edited,
        recorded.is_clipped & (kept > 0.5),
        np.where(is_edited, sky, recorded.sky_matte).astype(np.float32),
        (1 - kept).astype(np.float32),
    )


def _light_before_and_after(inputs: EditInputs) -> tuple[ShadowBuffers, ShadowBuffers]:
    """Light of both streets, with the shadow edges of the picture.

    Inside the shadow of a removed actor the picture contains no evidence of the new light.
    Elsewhere its shadows remain, and shadows of inserted actors reduce its sun visibility.
    """
    recorded, sun = inputs.recorded, inputs.recorded.source_sun
    if sun is None or sun.direction_world[2] <= 0:
        return recorded.source, inputs.light
    shown = refined_visibility(recorded, sun)
    after = with_found_visibility(inputs.light, inputs.buffers, sun, inputs.found_visibility)
    # Behind a removed actor is another surface, on which the picture shows no shadows.
    is_shown = (inputs.sun_past_removed == 1) & (inputs.removed_fraction == 0)
    visibility = np.where(is_shown, shown * inputs.sun_past_new, after.sun_visibility)
    return (
        _with_visibility(recorded.source, recorded.buffers, sun, shown),
        _with_visibility(inputs.light, inputs.buffers, sun, visibility.astype(np.float32)),
    )


def _with_visibility(
    light: ShadowBuffers, buffers: GBuffers, sun: Sun, visibility: Float32[np.ndarray, "h w"]
) -> ShadowBuffers:
    return with_sun_visibility(light, unoccluded_sun(buffers, light, sun), visibility)


def _grown_outline(inputs: EditInputs) -> Float32[np.ndarray, "h w"]:
    """Return the fraction of each pixel that removed actors occluded, with a dilated outline that
    excludes actors in front of them."""
    buffers, is_inside = inputs.recorded.buffers, inputs.removed_fraction > 0.5
    hidden = inputs.removed_fraction
    if is_inside.any():
        farthest_m = buffers.depth_z_m[is_inside].max()
        is_in_front = (buffers.actor_index >= 0) & (buffers.depth_z_m < farthest_m)
        hidden = grown_outline(is_inside, buffers.depth_z_m, inputs.focal_px)
        hidden = np.where(is_in_front & ~is_inside, inputs.removed_fraction, hidden)
    return np.where(inputs.is_fixed, 0.0, hidden).astype(np.float32)


def _contact(
    before: ShadowBuffers, after: ShadowBuffers, inputs: EditInputs
) -> Float32[np.ndarray, "h w"]:
    """Return 1 where a removed actor blocked nearly all skylight, so that the picture is too dark
    to be brightened, else 0."""
    if not (inputs.sun_past_removed < 1).any() and not (inputs.removed_fraction > 0).any():
        return np.zeros_like(inputs.removed_fraction)
    light = [luminance(x.sky + x.bounce) + _DARKEST for x in (before, after)]
    low, high = _CONTACT_RISE
    contact = np.clip((light[1] / light[0] - low) / (high - low), 0.0, 1.0)
    is_kept = inputs.is_fixed | (inputs.recorded.buffers.actor_index != BACKGROUND)
    return np.where(is_kept, 0.0, contact).astype(np.float32)


def _change(
    before: ShadowBuffers,
    after: ShadowBuffers,
    recorded: RelightInputs,
    hidden: Float32[np.ndarray, "h w"],
) -> Float32[np.ndarray, "h w"]:
    """Return the weight of the new light: 0 where the light of a surface is unchanged, 1 where the
    change is visible."""
    ratio = (after.shaded + _DARKEST) / (before.shaded + _DARKEST)
    change = np.abs(np.log(ratio)).max(axis=-1)
    radius = max(1, round(_STEADY_WIDTH * recorded.width_px))
    # Twice the mean, because at the edge of a shadow only half of the surroundings change.
    change = np.minimum(change, 2 * box_mean(change, radius))
    invisible, full = _VISIBLE_CHANGE
    fraction = np.clip((change - invisible) / (full - invisible), 0.0, 1.0)
    is_surface = recorded.buffers.has_surface & (recorded.sky_matte < 0.5)
    return np.where(is_surface & (hidden < 1), fraction, 0.0).astype(np.float32)


def _colour_match(
    inputs: EditInputs, before: ShadowBuffers, hidden: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return the smoothed ratio of recorded to rendered radiance, extrapolated to pixels where an
    actor or its shadow is removed."""
    recorded = inputs.recorded
    rendered = recorded.buffers.base_colour * before.shaded + before.reflected
    is_known = recorded.buffers.has_surface & (recorded.sky_matte < 0.02) & ~recorded.is_clipped
    is_known &= (hidden == 0) & (inputs.sun_past_removed == 1) & ~inputs.is_fixed
    if not is_known.any():
        return np.ones_like(rendered)
    log_match = np.log(recorded.radiance + _DARKEST) - np.log(rendered + _DARKEST)
    limit = np.float32(np.log(_MATCH_LIMIT))
    # Clipped, because a wrong base colour of one surface must not tint its surroundings.
    filled = fill_holes(np.clip(log_match, -limit, limit).astype(np.float32), is_known)
    radius = max(1, round(_MATCH_WIDTH * recorded.width_px / 2))
    smooth = box_mean(median_smoothed(filled, _MATCH_WIDTH, recorded.width_px), radius)
    return np.exp(smooth).astype(np.float32)


def _with_light_exchanged(
    inputs: EditInputs,
    before: ShadowBuffers,
    after: ShadowBuffers,
    match: Float32[np.ndarray, "h w 3"],
) -> Float32[np.ndarray, "h w 3"]:
    """Relight the recorded surfaces with the light of the edited street."""
    recorded = inputs.recorded
    colour = np.clip(recorded.buffers.base_colour * match, 0.0, 1.0)
    exchanged = replace(
        recorded,
        buffers=replace(recorded.buffers, base_colour=colour),
        source=before,
        target=after,
        target_sky=recorded.radiance,
    )
    return relight_physical(exchanged, _MATCHED)


def _twin_radiance(inputs: EditInputs, light: ShadowBuffers) -> Float32[np.ndarray, "h w 3"]:
    """Rendered radiance of the twin, for pixels that the picture does not show."""
    surface = inputs.buffers.base_colour * light.shaded + light.reflected
    return np.where(inputs.buffers.has_surface[..., None], surface, inputs.sky)
