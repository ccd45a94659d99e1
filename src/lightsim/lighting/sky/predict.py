"""Application of the lighting networks: predictions for a panorama, and decoded domes."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.colour import linear_from_srgb
from lightsim.core.dome import SkyDome, Sun, resized, split_sun
from lightsim.core.twin import Panorama, SkyEstimate
from lightsim.lighting.panorama.complete import completed_ldr, exposed_ldr
from lightsim.lighting.sample import SkyPrediction
from lightsim.lighting.sky.clear_sky import level_irradiance
from lightsim.lighting.sun.direction import SunDirection
from lightsim.lighting.weights import LightingWeights, tensors_of

if TYPE_CHECKING:
    from lightsim.lighting.sky.estimator import SkyEstimator

SHIPPED = LightingWeights()
"""The weights of the package."""


def predict_sky(panorama: Panorama, weights: LightingWeights = SHIPPED) -> SkyPrediction:
    """Predict sun, peak and latent of a panorama.

    This package's network uses the observed pixels alone, the published one the completed panorama.
    `log_peak` is in the panorama's own unit of radiance.

    Raises:
        InputError: no pixel was observed, or the weights are damaged.
    """
    estimator = _estimator(weights.sky)
    if estimator.is_published:
        ldr, exposure = completed_panorama(panorama, weights)
        predicted = estimator.predict(ldr)
    else:
        ldr, exposure = exposed_ldr(panorama)
        predicted = estimator.predict(ldr, panorama.is_seen)
    return replace(predicted, log_peak=predicted.log_peak - float(np.log(exposure)))


def decoded_dome(
    panorama: Panorama,
    weights: LightingWeights = SHIPPED,
    *,
    sun_direction: Float[np.ndarray, "3"] | None = None,
) -> SkyDome:
    """Decode the dome of a panorama, with a moved sun if requested.

    The decoder returns the upper half; the lower half is that of the completed panorama.
    `lighting.target_sky.with_edited_sun` moves the sun of any HDR dome.

    Args:
        panorama: stitched or from a picture; the dome has its size, unit and frame.
        sun_direction: unit vector towards another sun.

    Raises:
        InputError: the sun is below the horizon, or no pixel was observed.
    """
    ldr, exposure = completed_panorama(panorama, weights)
    estimator = _estimator(weights.sky)
    seen = None if estimator.is_published else panorama.is_seen
    predicted = estimator.predict(ldr, seen)
    upper = estimator.decode(predicted, ldr, seen=seen, sun_direction=sun_direction)
    ground = linear_from_srgb(ldr[len(ldr) // 2 :])
    radiance = (np.concatenate([upper, ground]) / np.float32(exposure)).astype(np.float32)
    direction = predicted.sun_direction if sun_direction is None else sun_direction
    towards = Sun(direction.astype(np.float64), np.zeros(3, dtype=np.float32))
    return SkyDome(radiance, split_sun(SkyDome(radiance, towards))[1])


def decoded_sky(
    panorama: Panorama,
    sun: SunDirection,
    prediction: SkyPrediction,
    height_px: int,
    weights: LightingWeights = SHIPPED,
) -> SkyEstimate:
    """Estimate the source sky by the paper's method (Sec. 3.2).

    The decoder combines the latent and the peak that the encoders predict from the completed
    panorama with the estimated sun direction (from GPS if the log has it). Shadows and light
    balance are not used.

    Args:
        prediction: `predict_sky` of the panorama, for its uncertainty.

    Raises:
        InputError: no pixel was observed.
    """
    dome = resized(decoded_dome(panorama, weights, sun_direction=sun.direction_world), height_px)
    level = level_irradiance(split_sun(dome)[0])
    note = (
        f"the dome is decoded by the network ({Path(weights.sky).name}) from its latent and peak"
        " and the estimated sun direction; the sun's strength was not checked against shadows"
    )
    return SkyEstimate(
        dome,
        sun.azimuth_deg,
        sun.elevation_deg,
        sun.origin,
        sun.uncertainty_deg,
        prediction.log_peak_std,
        level.astype(np.float32),
        prediction.log_peak_std,  # The network predicts no separate error of the sky.
        (*sun.notes, note),
    )


def completed_panorama(
    panorama: Panorama, weights: LightingWeights = SHIPPED
) -> tuple[Float32[np.ndarray, "h w 3"], float]:
    """Return the panorama in sRGB, inpainted where it was not observed, and its exposure
    (`exposed_ldr`).

    Raises:
        InputError: no pixel was observed, or the weights are damaged.
    """
    return completed_ldr(panorama, tensors_of(weights.inpaint))


def is_published(weights: LightingWeights) -> bool:
    """Return True if the sky network has the published form."""
    return _estimator(weights.sky).is_published


@lru_cache(maxsize=2)
def _estimator(sky: str | Path) -> SkyEstimator:
    from lightsim.lighting.sky.estimator import SkyEstimator

    return SkyEstimator.load(sky)
