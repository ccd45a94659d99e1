"""Evenly distributed directions of the upper hemisphere and averages over them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def fibonacci_hemisphere(count: int) -> Float[np.ndarray, "n 3"]:
    """Return directions of equal solid angle 2 pi / count, z up (Gonzalez 2010,
    doi:10.1007/s11004-009-9257-x)."""
    k = np.arange(count) + 0.5
    z = 1.0 - k / count
    azimuth = k * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def count_for_spacing(spacing_deg: float) -> int:
    """Number of directions of the hemisphere at which neighbours are about this far apart."""
    return max(1, round(2 * np.pi / np.radians(spacing_deg) ** 2))


def log_vmf(cosine: Float[np.ndarray, "*n"], std_deg: float) -> Float[np.ndarray, "*n"]:
    """Log density per sr of a von Mises-Fisher distribution (doi:10.1098/rspa.1953.0064).

    Its two tangential components have the standard deviation `std_deg`.
    """
    kappa = 1.0 / np.radians(std_deg) ** 2
    # log(kappa / (4 pi sinh kappa)) without overflow.
    log_norm = np.log(kappa / (2 * np.pi)) - np.log1p(-np.exp(-2 * kappa))
    return log_norm + kappa * (cosine - 1.0)
