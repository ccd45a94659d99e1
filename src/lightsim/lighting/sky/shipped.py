"""The shipped lighting networks at work: what they say of a panorama, and the domes they draw."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from lightsim.core.colour import linear_from_srgb
from lightsim.core.dome import SkyDome, Sun, split_sun
from lightsim.core.twin import Panorama
from lightsim.errors import InputError
from lightsim.lighting.sample import SkyPrediction

if TYPE_CHECKING:
    from lightsim.lighting.sky.estimator import SkyEstimator

INPAINT_WEIGHTS = "inpaint-small"
SKY_WEIGHTS = "sky-small"


def predict_sky(panorama: Panorama) -> SkyPrediction:
    """Sun, peak and latent that the networks read off a panorama, completed by inpainting.

    `log_peak` is in the panorama's own unit of radiance.

    Raises:
        InputError: nothing was seen, or the weights are damaged.
    """
    ldr, exposure = _completed(panorama)
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

    `lighting.target_sky.with_edited_sun` does the same on any HDR dome.

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
    ldr, exposure = _completed(panorama)
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


def _completed(panorama: Panorama) -> tuple[np.ndarray, float]:
    from lightsim.lighting.panorama.complete import completed_ldr
    from lightsim.store.weights import load_weights

    return completed_ldr(panorama, load_weights(INPAINT_WEIGHTS))


@lru_cache(maxsize=1)
def _estimator() -> SkyEstimator:
    from lightsim.lighting.sky.estimator import SkyEstimator

    return SkyEstimator.load(SKY_WEIGHTS)
