"""From radiance to the picture a camera stores: gain, noise, clipping, sRGB curve, 8 bit."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, UInt8

from lightsim.core.colour import srgb8_from_linear

_SHOT = 5e-5
_READ = 1e-3


def camera_isp(
    radiance: Float32[np.ndarray, "h w 3"],
    gain: Float[np.ndarray, "3"],
    rng: np.random.Generator | None,
) -> UInt8[np.ndarray, "h w 3"]:
    """The 8-bit sRGB picture; without `rng` the noise-free one.

    Noise has a variance of 5e-5 x signal (photons) + 1e-3^2 (read-out): 1.7 % at mid grey.
    """
    linear = radiance.astype(np.float64) * gain
    if rng is not None:
        sigma = np.sqrt(_SHOT * np.clip(linear, 0.0, 1.0) + _READ**2)
        linear = linear + rng.standard_normal(linear.shape) * sigma
    return srgb8_from_linear(linear)
