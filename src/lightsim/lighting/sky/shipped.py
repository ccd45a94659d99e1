"""The shipped lighting networks at work: what they predict of a panorama, and what they draw."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.checks import check_number
from lightsim.core.colour import linear_from_srgb
from lightsim.core.dome import SkyDome, Sun, irradiance, split_sun
from lightsim.core.solar import direction_enu
from lightsim.core.twin import Panorama, SkyEstimate
from lightsim.errors import InputError
from lightsim.lighting.panorama.complete import completed_ldr, exposed_ldr
from lightsim.lighting.sample import SkyPrediction

if TYPE_CHECKING:
    from lightsim.lighting.sky.estimator import SkyEstimator

INPAINT_WEIGHTS = "inpaint-small"
SKY_WEIGHTS = "sky-small"


def predict_sky(panorama: Panorama) -> SkyPrediction:
    """Sun, peak and latent that the estimator reads off what was seen of a panorama.

    It does not look at what is inpainted. `log_peak` is in the panorama's own unit of radiance.

    Raises:
        InputError: nothing was seen, or the weights are damaged.
    """
    ldr, exposure = exposed_ldr(panorama)
    predicted = _estimator().predict(ldr, panorama.is_seen, averages=True)
    return replace(predicted, log_peak=predicted.log_peak - float(np.log(exposure)))


def decoded_dome(
    panorama: Panorama,
    *,
    sun_direction: Float[np.ndarray, "3"] | None = None,
    sun_factor: float = 1.0,
) -> SkyDome:
    """The dome that the decoder draws of a panorama; on demand with its sun elsewhere, or stronger
    (paper, appendix: the same sky latent with other f_dir and f_int).

    The decoder draws the upper half; the lower one is the completed panorama's.

    Args:
        panorama: stitched or a picture; the dome has its size, unit and frame.
        sun_direction: unit vector towards another sun.
        sun_factor: on the sun's peak.

    Raises:
        InputError: the factor is not positive, the sun is below the horizon, or nothing was seen.
    """
    if not sun_factor > 0 or not np.isfinite(sun_factor):
        raise InputError(
            "the sun's factor must be positive",
            where="--sun-factor",
            got=sun_factor,
            expected="a finite number above 0",
        )
    ldr, exposure = completed_panorama(panorama)
    predicted = _estimator().predict(ldr, panorama.is_seen, averages=True)
    upper = _estimator().decode(
        predicted,
        ldr,
        seen=panorama.is_seen,
        sun_direction=sun_direction,
        log_peak=predicted.log_peak + float(np.log(sun_factor)),
    )
    ground = linear_from_srgb(ldr[len(ldr) // 2 :])
    radiance = (np.concatenate([upper, ground]) / np.float32(exposure)).astype(np.float32)
    direction = predicted.sun_direction if sun_direction is None else sun_direction
    towards = Sun(direction.astype(np.float64), np.zeros(3, dtype=np.float32))
    return SkyDome(radiance, split_sun(SkyDome(radiance, towards))[1])


_LEAST_ELEVATION_DEG = 0.1
"""Night and twilight are not modelled."""
_MAX_SUN_FACTOR = 1e3
"""From a veiled sun to a clear one is a factor of a hundred."""


def edited_sky(
    estimate: SkyEstimate,
    panorama: Panorama,
    sun: str | None,
    sun_factor: float,
    heading_deg: float | None,
) -> SkyEstimate:
    """The estimate of a picture with its sun moved to "AZIMUTH,ELEVATION" or made stronger.

    Args:
        heading_deg: azimuth of world +x; None takes azimuths from there.

    Raises:
        InputError: `sun` is not two numbers, or below the horizon.
    """
    check_number("--sun-factor", sun_factor, 0.0, _MAX_SUN_FACTOR)
    azimuth_deg, elevation_deg = estimate.sun_azimuth_deg, estimate.sun_elevation_deg
    direction = None if estimate.dome.sun is None else estimate.dome.sun.direction_world
    if sun is not None:
        asked_deg, elevation_deg = _two_numbers(sun)
        azimuth_deg = None if heading_deg is None else asked_deg % 360.0
        # Azimuths run clockwise from north, `direction_enu`'s from +y.
        direction = direction_enu(90.0 + asked_deg - (heading_deg or 0.0), elevation_deg)
    dome = decoded_dome(panorama, sun_direction=direction, sun_factor=sun_factor)
    level = irradiance(split_sun(dome)[0], np.array([0.0, 0.0, 1.0]))
    return replace(
        estimate,
        dome=dome,
        sun_azimuth_deg=azimuth_deg,
        sun_elevation_deg=elevation_deg,
        sky_irradiance=level.astype(np.float32),
        notes=("the sun was placed by hand; the decoder drew the sky", *estimate.notes),
    )


def _two_numbers(text: str) -> tuple[float, float]:
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(
            "the sun cannot be read",
            where="--move-sun",
            got=text,
            expected="AZIMUTH,ELEVATION in degrees",
        ) from error
    check_number("--move-sun, azimuth", first, -360.0, 360.0)
    check_number("--move-sun, elevation", second, _LEAST_ELEVATION_DEG, 90.0)
    return first, second


def completed_panorama(panorama: Panorama) -> tuple[Float32[np.ndarray, "h w 3"], float]:
    """The panorama in sRGB, inpainted where nothing was seen, and its exposure (`exposed_ldr`).

    Raises:
        InputError: nothing was seen, or the weights are damaged.
    """
    from lightsim.store.weights import load_weights

    return completed_ldr(panorama, load_weights(INPAINT_WEIGHTS))


@lru_cache(maxsize=1)
def _estimator() -> SkyEstimator:
    from lightsim.lighting.sky.estimator import SkyEstimator

    return SkyEstimator.load(SKY_WEIGHTS)
