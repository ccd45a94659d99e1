"""From linear radiance to what a camera's file shows: glare, exposure, white balance, sRGB."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32

from lightsim.core.colour import luminance, srgb_from_linear
from lightsim_lab.training import grids

_GLARE_REACH_DEG = 40.0


# How a camera's pictures vary; none was measured.

# Mean of the visible pixels that auto-exposure aims at.
_LEVEL = (0.08, 0.3)
# Standard deviation of the exposure around it, in stops.
_JITTER_EV = 0.5
# Standard deviation of the log of red and blue against green.
_BALANCE = 0.06
# Largest standard deviation of noise in sRGB.
_NOISE = 0.01
# Standard deviation of the log of the exponent on sRGB: cameras bend the curve.
_CONTRAST = 0.08


def exposure(
    linear: Float32[np.ndarray, "h w 3"],
    visible: Bool[np.ndarray, "h w"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "3"]:
    """RGB factor to units of the clipping value, from what the cameras saw.

    Half of the time auto-exposure goes by the median, else by the mean of clipped luminance.
    """
    aim = float(rng.uniform(*_LEVEL)) * 2.0 ** float(rng.normal(0, _JITTER_EV))
    seen = luminance(linear[visible]) if visible.any() else luminance(linear).ravel()
    middle = max(float(np.median(seen)), 1e-6)
    factor = aim / middle
    if rng.random() < 0.5:
        for _ in range(4):
            factor *= aim / max(float(np.minimum(seen * factor, 1.0).mean()), 1e-6)
            aim = min(aim, 0.7)
    gains = np.exp(rng.normal(0.0, _BALANCE, 3))
    gains[1] = 1.0
    return factor * gains


def pictures(
    linear: Float32[np.ndarray, "h w 3"],
    front: Float32[np.ndarray, "a b 3"],
    rng: np.random.Generator,
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "a b 3"]]:
    """sRGB of a panorama and of one camera's picture, in units of the clipping value."""
    bend = float(np.exp(rng.normal(0.0, _CONTRAST)))
    strength = _NOISE * float(rng.random())
    if rng.random() < 0.3:
        linear = _blurred(linear)
    return _shown(linear, bend, strength, rng), _shown(front, bend, strength, rng)


def _shown(
    linear: Float32[np.ndarray, "h w 3"], bend: float, noise: float, rng: np.random.Generator
) -> Float32[np.ndarray, "h w 3"]:
    code = srgb_from_linear(linear) ** np.float32(bend)
    code = code + rng.standard_normal(code.shape, dtype=np.float32) * np.float32(noise)
    return np.round(np.clip(code, 0, 1) * 255).astype(np.float32) / np.float32(255)


def _blurred(linear: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """A small blur along azimuth, as of misaligned overlaps, after clipping."""
    clipped = np.minimum(linear, 1.0)
    beside = np.roll(clipped, 1, axis=1) + np.roll(clipped, -1, axis=1)
    return (0.5 * clipped + 0.25 * beside).astype(np.float32)


def add_glare(
    linear: Float32[np.ndarray, "h w 3"],
    towards_sun: Float[np.ndarray, "3"],
    sun_irradiance: Float[np.ndarray, "3"],
    rng: np.random.Generator,
) -> Float32[np.ndarray, "h w 3"]:
    """The picture with the sun's disc and the veil that lenses spread around it.

    Veil = k E / angle^2, angle in degrees, with k between the clean lens's and the eye's (Vos
    1984). Call it only where the sun is in view.
    """
    height = linear.shape[0]
    k = float(np.exp(rng.uniform(np.log(0.02), np.log(0.6))))
    cosine = grids.directions(height) @ towards_sun.astype(np.float32)
    angle_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    pixel_deg = 180.0 / height
    veil = k / np.maximum(angle_deg, 0.3 * pixel_deg) ** 2
    veil = np.where(angle_deg < _GLARE_REACH_DEG, veil, 0.0)
    disc = np.where(angle_deg < 0.75 * pixel_deg, 1.0 / np.radians(pixel_deg) ** 2, 0.0)
    return (linear + (veil + disc)[..., None] * sun_irradiance).astype(np.float32)
