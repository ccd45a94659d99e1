"""Application of the shipped lighting networks: predictions for a panorama and decoded domes."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
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

if TYPE_CHECKING:
    from lightsim.lighting.sky.estimator import SkyEstimator

INPAINT_WEIGHTS = "inpaint-small"
SKY_WEIGHTS = "sky-small"


def predict_sky(panorama: Panorama) -> SkyPrediction:
    """Predict sun, peak and latent from the observed pixels of a panorama.

    Inpainted pixels are not used. `log_peak` is in the panorama's own unit of radiance.

    Raises:
        InputError: no pixel was observed, or the weights are damaged.
    """
    ldr, exposure = exposed_ldr(panorama)
    predicted = _estimator().predict(ldr, panorama.is_seen)
    return replace(predicted, log_peak=predicted.log_peak - float(np.log(exposure)))


def decoded_dome(
    panorama: Panorama, *, sun_direction: Float[np.ndarray, "3"] | None = None
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
    ldr, exposure = completed_panorama(panorama)
    predicted = _estimator().predict(ldr, panorama.is_seen)
    upper = _estimator().decode(predicted, ldr, seen=panorama.is_seen, sun_direction=sun_direction)
    ground = linear_from_srgb(ldr[len(ldr) // 2 :])
    radiance = (np.concatenate([upper, ground]) / np.float32(exposure)).astype(np.float32)
    direction = predicted.sun_direction if sun_direction is None else sun_direction
    towards = Sun(direction.astype(np.float64), np.zeros(3, dtype=np.float32))
    return SkyDome(radiance, split_sun(SkyDome(radiance, towards))[1])


def decoded_sky(
    panorama: Panorama, sun: SunDirection, prediction: SkyPrediction, height_px: int
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
    dome = resized(decoded_dome(panorama, sun_direction=sun.direction_world), height_px)
    level = level_irradiance(split_sun(dome)[0])
    note = (
        f"the dome is decoded by the network ({SKY_WEIGHTS}) from its latent and peak and the"
        " estimated sun direction; the sun's strength was not checked against shadows"
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


def completed_panorama(panorama: Panorama) -> tuple[Float32[np.ndarray, "h w 3"], float]:
    """Return the panorama in sRGB, inpainted where it was not observed, and its exposure
    (`exposed_ldr`).

    Raises:
        InputError: no pixel was observed, or the weights are damaged.
    """
    from lightsim.store.weights import load_weights

    return completed_ldr(panorama, load_weights(INPAINT_WEIGHTS))


@lru_cache(maxsize=1)
def _estimator() -> SkyEstimator:
    from lightsim.lighting.sky.estimator import SkyEstimator

    return SkyEstimator.load(SKY_WEIGHTS)
