"""Simulation of camera images from linear radiance: glare, exposure, white balance, noise, sRGB."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from lightsim.core.colour import luminance, srgb_from_linear
from lightsim_lab.training import grids

# Angle from the sun beyond which glare is neglected: its radiance, which falls with the square of
# the angle, is then below 1/1000 of that at 1 degree. Sensitivity not measured.
_GLARE_REACH_DEG = 40.0


@dataclass(frozen=True)
class _Variation:
    """Variation of the simulated cameras; chosen, not measured."""

    level: tuple[float, float] = (0.08, 0.3)
    """Range of the target value of auto-exposure, in units of the clipping value."""
    jitter_ev: float = 0.5
    """Standard deviation of the exposure about this target, in stops."""
    balance: float = 0.06
    """Standard deviation of the log gains of red and blue relative to green."""
    noise: float = 0.01
    """Largest standard deviation of the sRGB noise."""
    contrast: float = 0.08
    """Standard deviation of the log exponent on sRGB; real camera responses deviate from sRGB."""


_VARIATION = _Variation()


def exposure(
    linear: Float32[np.ndarray, "h w 3"],
    visible: Bool[np.ndarray, "h w"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "3"]:
    """Return the RGB factor from radiance to units of the clipping value (auto-exposure).

    Half of the exposures set the median of the visible luminance to the target value, the others
    the mean of the clipped luminance.
    """
    aim = float(rng.uniform(*_VARIATION.level))
    aim *= 2.0 ** float(rng.normal(0, _VARIATION.jitter_ev))
    seen = luminance(linear[visible]) if visible.any() else luminance(linear).ravel()
    middle = max(float(np.median(seen)), 1e-6)
    factor = aim / middle
    if rng.random() < 0.5:
        # Clipping makes the mean a nonlinear function of the factor: fixed-point iteration.
        for _ in range(4):
            factor *= aim / max(float(np.minimum(seen * factor, 1.0).mean()), 1e-6)
            aim = min(aim, 0.7)
    gains = np.exp(rng.normal(0.0, _VARIATION.balance, 3))
    # White balance acts relative to green, which carries most of the luminance.
    gains[1] = 1.0
    return factor * gains


def pictures(
    linear: Float32[np.ndarray, "h w 3"],
    front: Float32[np.ndarray, "a b 3"],
    rng: np.random.Generator,
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "a b 3"]]:
    """Convert a panorama and one camera image, in units of the clipping value, to sRGB."""
    # Both images have the same camera response and noise level, like images of one camera.
    bend = float(np.exp(rng.normal(0.0, _VARIATION.contrast)))
    strength = _VARIATION.noise * float(rng.random())
    if rng.random() < 0.3:
        linear = _blurred(linear)
    return _shown(linear, bend, strength, rng), _shown(front, bend, strength, rng)


def _shown(
    linear: Float32[np.ndarray, "h w 3"], bend: float, noise: float, rng: np.random.Generator
) -> Float32[np.ndarray, "h w 3"]:
    code = srgb_from_linear(linear) ** np.float32(bend)
    code = code + rng.standard_normal(code.shape, dtype=np.float32) * np.float32(noise)
    # The networks' input has 8-bit values, like camera images.
    return np.round(np.clip(code, 0, 1) * 255).astype(np.float32) / np.float32(255)


def _blurred(linear: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Blur clipped radiance by one pixel along azimuth, as misaligned camera overlaps do."""
    clipped = np.minimum(linear, 1.0)
    beside = np.roll(clipped, 1, axis=1) + np.roll(clipped, -1, axis=1)
    return (0.5 * clipped + 0.25 * beside).astype(np.float32)


def add_glare(
    linear: Float32[np.ndarray, "h w 3"],
    towards_sun: Float[np.ndarray, "3"],
    sun_irradiance: Float[np.ndarray, "3"],
    rng: np.random.Generator,
) -> Float32[np.ndarray, "h w 3"]:
    """Add the sun's disc and lens glare to a panorama in which the sun is visible.

    The veiling radiance is k E / angle^2, with the sun's irradiance E, the angle from the sun in
    degrees, and k between that of a clean lens and that of the eye (Vos 1984).
    """
    height = linear.shape[0]
    k = float(np.exp(rng.uniform(np.log(0.02), np.log(0.6))))
    cosine = grids.directions(height) @ towards_sun.astype(np.float32)
    angle_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    pixel_deg = 180.0 / height
    veil = k / np.maximum(angle_deg, 0.3 * pixel_deg) ** 2
    veil = np.where(angle_deg < _GLARE_REACH_DEG, veil, 0.0)
    # The sun is smaller than a pixel: its irradiance is distributed over about one pixel's area.
    disc = np.where(angle_deg < 0.75 * pixel_deg, 1.0 / np.radians(pixel_deg) ** 2, 0.0)
    return (linear + (veil + disc)[..., None] * sun_irradiance).astype(np.float32)
