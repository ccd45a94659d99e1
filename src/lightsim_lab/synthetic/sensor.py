"""Camera image signal processor (ISP): gain, noise, clipping, sRGB curve and 8-bit rounding."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, UInt8

from lightsim.core.colour import srgb8_from_linear


def camera_isp(
    radiance: Float32[np.ndarray, "h w 3"],
    gain: Float[np.ndarray, "3"],
    rng: np.random.Generator | None,
) -> UInt8[np.ndarray, "h w 3"]:
    """Convert scene radiance to an 8-bit sRGB image.

    The noise has the variance 5e-5 x signal (photons) + 1e-3^2 (read-out), which is 1.7 % at mid
    grey; chosen, not measured.

    Args:
        gain: RGB gain of the camera.
        rng: random generator of the noise; None: no noise.
    """
    linear = radiance.astype(np.float64) * gain
    if rng is not None:
        # The shot noise of a clipped pixel is that of the full well.
        sigma = np.sqrt(5e-5 * np.clip(linear, 0.0, 1.0) + 1e-3**2)
        linear = linear + rng.standard_normal(linear.shape) * sigma
    return srgb8_from_linear(linear)
