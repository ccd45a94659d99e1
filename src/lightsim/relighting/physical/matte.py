"""Sky behind a soft matte: removal of the old sky from mixed pixels, and compositing of the new
one."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from lightsim.relighting.physical.filters import fill_holes

# Distance of a matte to 0 or 1 within which a pixel counts as unmixed.
_PURE = np.float32(0.02)
# Foreground fraction, at least, by which a mixed pixel is divided: smaller ones amplify noise.
_MIN_FOREGROUND = np.float32(0.15)


def foreground_radiance(
    radiance: Float32[np.ndarray, "h w 3"], sky_matte: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """Image without the light of the sky in mixed pixels (leaves, wires, edges).

    A mixed pixel is C = (1 - a) F + a S (Porter and Duff 1984, doi:10.1145/800031.808606). S is
    taken from pure sky nearby and F is solved for. The smaller the foreground fraction, the more F
    is replaced by that of its surroundings. Pixels without sky are unchanged.
    """
    is_mixed = sky_matte > _PURE
    if not is_mixed.any():
        return radiance
    is_sky = sky_matte >= 1 - _PURE
    surroundings = fill_holes(radiance, ~is_mixed) if not is_mixed.all() else radiance * 0
    sky = fill_holes(radiance, is_sky) if is_sky.any() else radiance
    alpha = sky_matte[..., None]
    fraction = np.maximum(1 - alpha, _MIN_FOREGROUND)
    unmixed = np.clip((radiance - alpha * sky) / fraction, 0.0, np.maximum(radiance, surroundings))
    mixed = (1 - alpha) * unmixed + alpha * surroundings
    return np.where(is_mixed[..., None], mixed, radiance).astype(np.float32)


def composite(
    foreground: Float32[np.ndarray, "h w 3"],
    sky: Float32[np.ndarray, "h w 3"],
    sky_matte: Float32[np.ndarray, "h w"],
) -> Float32[np.ndarray, "h w 3"]:
    """Composite the foreground over a sky. A nearly opaque matte blocks the sun behind it."""
    alpha = np.where(sky_matte > _PURE, sky_matte, 0.0)[..., None]
    return ((1 - alpha) * foreground + alpha * sky).astype(np.float32)
