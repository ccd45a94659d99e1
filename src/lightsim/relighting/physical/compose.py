"""Conversion of scene radiance to the picture that a camera records."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, UInt8

from lightsim.core.colour import srgb8_from_linear
from lightsim.errors import InputError


def camera_image(
    radiance: Float32[np.ndarray, "h w 3"],
    gain: Float32[np.ndarray, "3"],
    exposure_ev: float,
) -> UInt8[np.ndarray, "h w 3"]:
    """Return 8-bit sRGB of scene radiance times the camera's gain and 2^EV, clipped at white.

    Raises:
        InputError: a gain is not positive, or the radiance is not finite.
    """
    if not np.isfinite(gain).all() or (gain <= 0).any():
        raise InputError(
            "a camera gain is out of range",
            got=gain.tolist(),
            expected="three finite numbers above 0",
        )
    is_finite = np.isfinite(radiance).all(axis=2)
    if not is_finite.all():
        raise InputError(
            "the relit radiance is not finite",
            got=f"{int((~is_finite).sum())} infinite or undefined pixels",
            expected="none",
        )
    return srgb8_from_linear(radiance * gain * np.float32(2.0**exposure_ev))
