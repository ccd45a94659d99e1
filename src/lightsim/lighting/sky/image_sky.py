"""The sky of a single equirectangular picture, without a log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from lightsim.core.colour import CLIPPED_CODE, linear_from_srgb8
from lightsim.core.dome import irradiance, split_sun
from lightsim.core.equirect import pixel_directions
from lightsim.core.resample import resize_area
from lightsim.core.solar import direction_enu
from lightsim.core.twin import Panorama, SkyEstimate
from lightsim.errors import InputError
from lightsim.lighting.sample import SkyPrediction
from lightsim.lighting.sky.estimate import SkyConfig, estimate_sky
from lightsim.lighting.sun.cues import NetworkCue, OpenSkyCue, panorama_cues
from lightsim.lighting.sun.direction import SunDirection
from lightsim.lighting.sun.posterior import (
    SunPosterior,
    sun_direction,
    sun_posterior,
)
from lightsim.lighting.target_sky import with_edited_sun

_LEAST_ROWS = 16
"""Below this, a pixel is larger than the glow of a sun."""


def estimate_from_panorama(
    srgb8: UInt8[np.ndarray, "h w 3"],
    is_observed: Bool[np.ndarray, "h w"] | None,
    sun: SunDirection | None,
    config: SkyConfig,
    prediction: SkyPrediction | None = None,
) -> SkyEstimate:
    """The HDR dome of a picture in frame `world` (centre column = world +x).

    Scene unit: radiance 1 is the picture's white. What is observed above the horizon,
    bright and not clearly red or green counts as sky. Without `sun`, the picture gives a
    posterior of its direction (`picture_sun`). No shadows are read here: the sun's strength is
    that of clear and overcast skies, and of `prediction`, what a network reads off the completed
    picture.

    Raises:
        InputError: the picture is not 2:1, too small, or shows no sky.
    """
    return estimate_from_picture(panorama_from_image(srgb8, is_observed), sun, config, prediction)


def estimate_from_picture(
    panorama: Panorama,
    sun: SunDirection | None,
    config: SkyConfig,
    prediction: SkyPrediction | None = None,
) -> SkyEstimate:
    """As `estimate_from_panorama`, of what `panorama_from_image` made of the picture."""
    if sun is None:
        sun = sun_direction(picture_sun(panorama, prediction), None)
    return estimate_sky(panorama, sun, config, prediction=prediction)[0]


def edited_sky(
    estimate: SkyEstimate,
    sun_position: tuple[float, float] | None,
    sun_factor: float,
    heading_deg: float | None,
) -> SkyEstimate:
    """The estimate of a picture with its sun edited as in `with_edited_sun`.

    Args:
        sun_position: azimuth from true north and elevation of the moved sun, degrees; None leaves
            it in place.
        sun_factor: factor on the sun's irradiance.
        heading_deg: azimuth of world +x; None takes azimuths from there.

    Raises:
        InputError: the estimated sky has no sun.
    """
    direction = None
    if sun_position is not None:
        azimuth_deg, elevation_deg = sun_position
        # Azimuths run clockwise from north, `direction_enu`'s from +y.
        direction = direction_enu(90.0 + azimuth_deg - (heading_deg or 0.0), elevation_deg)
        known_deg = None if heading_deg is None else azimuth_deg
        estimate = replace(estimate, sun_azimuth_deg=known_deg, sun_elevation_deg=elevation_deg)
    dome = with_edited_sun(estimate.dome, direction, sun_factor)
    level = irradiance(split_sun(dome)[0], np.array([0.0, 0.0, 1.0]))
    notes = ("the sun was edited by hand", *estimate.notes)
    return replace(estimate, dome=dome, sky_irradiance=level.astype(np.float32), notes=notes)


def picture_sun(panorama: Panorama, prediction: SkyPrediction | None) -> SunPosterior:
    """Where the sun of a picture is.

    A network has read glow, clipped spots and gradient off the same pixels; counting them again
    as independent cues made its errors three times as large, because most clipped spots of
    pictures are clouds and walls. So what it says stands, but for sky that was seen without a sun.
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
    """A picture as a `Panorama` of `height_px` rows.

    Raises:
        InputError: as `estimate_from_panorama`.
    """
    height, width = srgb8.shape[:2]
    if width != 2 * height:
        raise InputError(
            "a panorama must be twice as wide as high",
            got=f"{width}x{height} px",
            remedy="Crop or pad it to an equirectangular image.",
        )
    if height < _LEAST_ROWS:
        raise InputError(
            "the panorama is too small to show a sky",
            got=f"{width}x{height} px",
            expected=f"at least {_LEAST_ROWS} rows",
        )
    seen = np.ones((height, width), bool) if is_observed is None else is_observed
    weight = seen.astype(np.float32)[..., None]
    linear = linear_from_srgb8(srgb8) * weight
    clipped = np.any(srgb8 >= CLIPPED_CODE, axis=-1, keepdims=True) * weight
    coverage = resize_area(weight, height_px, 2 * height_px)
    fraction = np.maximum(coverage, 1e-6)
    radiance = resize_area(linear, height_px, 2 * height_px) / fraction
    is_seen = coverage[..., 0] > 0.5
    is_clipped = is_seen & (
        (resize_area(clipped, height_px, 2 * height_px) / fraction)[..., 0] > 0.5
    )
    if not is_seen[: height_px // 2].any():
        raise InputError(
            "nothing was observed above the horizon",
            remedy="Alpha 0 means not observed: check the picture's alpha, and that row 0 is up.",
        )
    is_sky = _sky_like(radiance, is_seen)
    if not is_sky.any():
        raise InputError(
            "nothing that looks like sky was observed above the horizon",
            remedy="Check that row 0 is up, that it is not black, and that its alpha keeps sky.",
        )
    radiance[~is_seen] = 0.0
    return Panorama(radiance.astype(np.float32), is_seen, is_sky, is_clipped)


def _sky_like(
    radiance: Float[np.ndarray, "h w 3"], is_seen: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Seen above the horizon, brighter in blue than a third of the 90th percentile there, and not
    clearly red or green."""
    is_up = is_seen & (pixel_directions(len(radiance))[..., 2] > 0)
    blue = radiance[..., 2]
    bright = float(np.percentile(blue[is_up], 90))
    is_neutral = blue >= 0.75 * radiance[..., :2].max(axis=-1)
    is_saturated = radiance.min(axis=-1) > 0.9
    return is_up & (blue > bright / 3) & (is_neutral | is_saturated)
