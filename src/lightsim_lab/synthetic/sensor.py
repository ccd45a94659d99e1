"""Camera image signal processor (ISP): gain, noise, tone curve, sRGB curve and 8-bit rounding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8

from lightsim.core.colour import srgb8_from_linear


@dataclass(frozen=True)
class CameraSensor:
    """Exposure, tone curve and noise of the cameras of a street.

    The default noise is 1.7 % at mid grey; chosen, not measured.

    Args:
        exposure_ev: exposure in stops. The scene unit is the radiance that the cameras map to 1,
            so that a longer exposure multiplies all radiance, that of the true skies included
            (`skies.Sky.exposed`).
        knee: linear value from which highlights are compressed towards 1; 1: they are clipped.
        photon_noise: variance of the photon noise over the signal.
        read_noise: standard deviation of the read-out noise.
    """

    exposure_ev: float = 0.0
    knee: float = 1.0
    photon_noise: float = 5e-5
    read_noise: float = 1e-3


DEFAULT_SENSOR = CameraSensor()


def camera_isp(
    radiance: Float32[np.ndarray, "h w 3"],
    gain: Float[np.ndarray, "3"],
    rng: np.random.Generator | None,
    sensor: CameraSensor = DEFAULT_SENSOR,
) -> UInt8[np.ndarray, "h w 3"]:
    """Convert scene radiance to an 8-bit sRGB image.

    Args:
        gain: RGB gain of the camera.
        rng: random generator of the noise; None: no noise.
        sensor: its tone curve and noise. Its exposure is part of the scene unit already.
    """
    linear = radiance.astype(np.float64) * gain
    if rng is not None:
        # The shot noise of a clipped pixel is that of the full well.
        variance = sensor.photon_noise * np.clip(linear, 0.0, 1.0) + sensor.read_noise**2
        linear = linear + rng.standard_normal(linear.shape) * np.sqrt(variance)
    return srgb8_from_linear(_toned(linear, sensor.knee))


def _toned(linear: Float[np.ndarray, "h w 3"], knee: float) -> Float[np.ndarray, "h w 3"]:
    """Compress values above the knee towards 1, with a continuous slope."""
    if knee >= 1.0:
        return linear
    room = 1.0 - knee
    above = np.maximum(linear - knee, 0.0)
    return np.where(linear > knee, 1.0 - room * np.exp(-above / room), linear)
