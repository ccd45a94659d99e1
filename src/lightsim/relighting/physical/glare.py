"""Veiling glare: sunlight that the lens scatters over the whole picture."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.dome import Sun

# Angle, in radians, within which scattered light is constant: the disc and its aureole. Beyond it,
# scattered light decreases with the square of the angle, in lenses as in eyes (CIE 146:2002;
# Talvala et al. 2007, doi:10.1145/1276377.1276424).
_CORE_RAD = float(np.radians(0.5))


def veiling_glare(
    rays_world: Float[np.ndarray, "h w 3"],
    axis_world: Float[np.ndarray, "3"],
    sun: Sun,
    visible: float,
    fraction: float,
) -> Float32[np.ndarray, "h w 3"]:
    """Radiance that the sun on the lens adds to the picture, in the units of the sun's irradiance.

    Args:
        rays_world: unit directions of the pixels.
        axis_world: the optical axis; a sun behind the lens adds nothing.
        visible: fraction of the solar disc that is visible from the lens.
        fraction: fraction of the light on the lens that it scatters over the half space in front.
    """
    towards = sun.direction_world / np.linalg.norm(sun.direction_world)
    on_lens = max(float(axis_world @ towards), 0.0) * visible * fraction
    if on_lens == 0:
        return np.zeros(rays_world.shape, dtype=np.float32)
    # Angles from chords, because the arc cosine is inaccurate near the sun.
    chord = np.linalg.norm(rays_world - towards, axis=-1)
    angle_rad = 2 * np.arcsin(np.clip(chord / 2, 0.0, 1.0))
    density = 1 / (np.square(angle_rad) + _CORE_RAD**2) / _whole()
    return (on_lens * density[..., None] * sun.irradiance).astype(np.float32)


def _whole() -> float:
    """Integral of the decrease with angle over the half space."""
    angles_rad = (np.arange(20_000) + 0.5) * (np.pi / 2 / 20_000)
    density = np.sin(angles_rad) / (np.square(angles_rad) + _CORE_RAD**2)
    return float(2 * np.pi * density.sum() * (angles_rad[1] - angles_rad[0]))
