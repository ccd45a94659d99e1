"""Estimation of the sky from a single equirectangular picture, without a log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from lightsim.core.colour import CLIPPED_CODE, linear_from_srgb8
from lightsim.core.dome import split_sun
from lightsim.core.equirect import pixel_directions
from lightsim.core.resample import resize_area
from lightsim.core.solar import direction_enu
from lightsim.core.twin import Panorama, SkyEstimate
from lightsim.errors import InputError
from lightsim.lighting.panorama.inpaint import check_panorama_size
from lightsim.lighting.sample import SkyPrediction
from lightsim.lighting.sky.clear_sky import level_irradiance
from lightsim.lighting.sky.estimate import SkyConfig, estimate_sky
from lightsim.lighting.sun.cues import NetworkCue, OpenSkyCue, panorama_cues
from lightsim.lighting.sun.direction import SunDirection
from lightsim.lighting.sun.posterior import (
    SunPosterior,
    sun_direction,
    sun_posterior,
)
from lightsim.lighting.target_sky import with_edited_sun

# Rows of a picture, at least: below this, a pixel is larger than the glow of the sun.
_MIN_ROWS = 16


def estimate_from_picture(
    panorama: Panorama,
    sun: SunDirection | None,
    config: SkyConfig,
    prediction: SkyPrediction | None = None,
) -> SkyEstimate:
    """Estimate the HDR dome of a picture from `panorama_from_image`, frame `world` (centre column =
    world +x).

    Scene unit: radiance 1 is the picture's white. Without `sun`, its direction is estimated from
    the picture (`picture_sun`). Shadows are not used: the sun's irradiance is that of clear and
    overcast skies, combined with `prediction`, a network's prediction for the completed picture.
    """
    if sun is None:
        sun = sun_direction(picture_sun(panorama, prediction), None)
    return estimate_sky(panorama, sun, config, prediction=prediction)[0]


def edited_sky(
    estimate: SkyEstimate,
    sun_position: tuple[float, float] | None,
    sun_factor: float,
    heading_deg: float | None,
) -> SkyEstimate:
    """Return the estimate of a picture with its sun edited as in `with_edited_sun`.

    Args:
        sun_position: azimuth from true north and elevation of the moved sun, degrees; None leaves
            it in place.
        sun_factor: factor on the sun's irradiance.
        heading_deg: azimuth of world +x; if None, azimuths are measured from world +x.

    Raises:
        InputError: the estimated sky has no sun.
    """
    direction = None
    if sun_position is not None:
        azimuth_deg, elevation_deg = sun_position
        # Azimuths are clockwise from north; `direction_enu` takes +y as north.
        direction = direction_enu(90.0 + azimuth_deg - (heading_deg or 0.0), elevation_deg)
        known_deg = None if heading_deg is None else azimuth_deg
        estimate = replace(estimate, sun_azimuth_deg=known_deg, sun_elevation_deg=elevation_deg)
    dome = with_edited_sun(estimate.dome, direction, sun_factor)
    level = level_irradiance(split_sun(dome)[0])
    notes = ("the sun was edited by hand", *estimate.notes)
    return replace(estimate, dome=dome, sky_irradiance=level.astype(np.float32), notes=notes)


def picture_sun(panorama: Panorama, prediction: SkyPrediction | None) -> SunPosterior:
    """Posterior of the sun's direction in a picture.

    The network already uses the glow, clipped spots and gradient of the same pixels. With these as
    independent cues, errors were three times as large, because most clipped spots in pictures are
    clouds and walls. The prediction is therefore combined with one cue only: observed, unsaturated
    sky contains no sun.
    """
    if prediction is None:
        return sun_posterior(panorama_cues(panorama), panorama)
    cues = [OpenSkyCue(panorama), NetworkCue(prediction, temper=1.0)]
    return sun_posterior(cues, panorama, takes_mode=True)


def panorama_from_image(
    srgb8: UInt8[np.ndarray, "h w 3"],
    is_observed: Bool[np.ndarray, "h w"] | None,
    height_px: int = 512,
) -> Panorama:
    """Convert a picture to a `Panorama` of `height_px` rows.

    Observed pixels above the horizon that are bright and not clearly red or green count as sky.

    Raises:
        InputError: the picture is not 2:1, too small, or shows no sky.
    """
    height, width = srgb8.shape[:2]
    check_panorama_size(height, width)
    if height < _MIN_ROWS:
        raise InputError(
            "the panorama is too small for an estimate of its sky",
            got=f"{width}x{height} px",
            expected=f"at least {_MIN_ROWS} rows",
        )
    seen = np.ones((height, width), bool) if is_observed is None else is_observed
    weight = seen.astype(np.float32)[..., None]
    linear = linear_from_srgb8(srgb8) * weight
    clipped = np.any(srgb8 >= CLIPPED_CODE, axis=-1, keepdims=True) * weight
    coverage = resize_area(weight, height_px, 2 * height_px)
    fraction = np.maximum(coverage, 1e-6)
    radiance = resize_area(linear, height_px, 2 * height_px) / fraction
    is_seen = coverage[..., 0] > 0.5
    # A reduced pixel is clipped if most of its observed area is.
    is_clipped = is_seen & (
        (resize_area(clipped, height_px, 2 * height_px) / fraction)[..., 0] > 0.5
    )
    if not is_seen[: height_px // 2].any():
        raise InputError(
            "the picture has no observed pixel above the horizon",
            expected="pixels of alpha above 0 in the upper half",
            remedy="Alpha 0 means not observed: check the picture's alpha, and that row 0 is up.",
        )
    is_sky = _sky_like(radiance, is_seen)
    if not is_sky.any():
        raise InputError(
            "no pixel above the horizon looks like sky",
            expected="bright pixels that are not clearly red or green",
            remedy="Check that row 0 is up, that the picture is not black, and that its alpha does"
            " not exclude the sky.",
        )
    radiance[~is_seen] = 0.0
    return Panorama(radiance.astype(np.float32), is_seen, is_sky, is_clipped)


def _sky_like(
    radiance: Float[np.ndarray, "h w 3"], is_seen: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Observed pixels above the horizon with a blue value above a third of the 90th percentile
    there, and not clearly red or green."""
    is_up = is_seen & (pixel_directions(len(radiance))[..., 2] > 0)
    blue = radiance[..., 2]
    bright = float(np.percentile(blue[is_up], 90))
    is_neutral = blue >= 0.75 * radiance[..., :2].max(axis=-1)
    is_saturated = radiance.min(axis=-1) > 0.9
    return is_up & (blue > bright / 3) & (is_neutral | is_saturated)
