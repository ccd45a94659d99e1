"""Near-duplicate skies, which must not be on two sides of a split."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Complex, Float32

from lightsim.core.equirect import solid_angles_sr
from lightsim.errors import InputError
from lightsim_lab.training.hdr_skies import HdrSky, shrunk

# Rows of the upper half in the comparison: cells of 5.6 degrees.
_ROWS = 16
# Limit of the deviation of log radiance from its median: black walls must not dominate.
_RANGE = 3.0
# Limits of distance and correlation. Of the 69 skies of benchmarks/hdri_split.csv, two pairs are
# within both: copies of one sky (0.25, 0.98) and two dusks (0.30, 0.86). Uniform overcast skies
# have small distances but low correlations (0.26, 0.78); clear skies have high correlations from
# their common gradient, but larger distances (0.30, 0.94).
_LARGEST_DISTANCE = 0.3
# See _LARGEST_DISTANCE.
_MIN_CORRELATION = 0.8


@dataclass(frozen=True)
class SkyPair:
    """Two skies, compared at the yaw, mirroring and exposure of their best agreement.

    Args:
        distance: root mean square difference of log radiance over the upper half.
        correlation: correlation of log radiance over the upper half.
    """

    first: HdrSky
    second: HdrSky
    distance: float
    correlation: float

    @property
    def is_near_duplicate(self) -> bool:
        """True if distance and correlation are within the limits of near-duplicates."""
        return self.distance < _LARGEST_DISTANCE and self.correlation > _MIN_CORRELATION


def sky_pairs(skies: Sequence[HdrSky]) -> list[SkyPair]:
    """Return all pairs of skies, the smallest distance first."""
    spectra = [_spectrum(sky.rest) for sky in skies]
    pairs = [
        _pair(skies[i], skies[j], spectra[i], spectra[j])
        for i, j in combinations(range(len(skies)), 2)
    ]
    return sorted(pairs, key=lambda pair: pair.distance)


def check_split(skies: Sequence[HdrSky]) -> None:
    """Raise InputError for the closest pair of near-duplicates on two sides of the split."""
    for pair in sky_pairs(skies):
        first, second = pair.first.entry, pair.second.entry
        if pair.is_near_duplicate and first.split != second.split:
            raise InputError(
                "near-duplicates are on two sides of the split",
                got=f"{first.name} ({first.split}) and {second.name} ({second.split}),"
                f" distance {pair.distance:.2f}, correlation {pair.correlation:.2f}",
                expected=f"a distance above {_LARGEST_DISTANCE} or a correlation below"
                f" {_MIN_CORRELATION}",
                remedy="Give them one group in the split file.",
            )


def _spectrum(panorama: Float32[np.ndarray, "h w 3"]) -> Complex[np.ndarray, "r f 3"]:
    """Return the Fourier transform along azimuth of log radiance without its mean.

    The weights make products of two transforms means over the sky's solid angle.
    """
    small = shrunk(panorama, 2 * _ROWS)[:_ROWS]
    value = np.log(np.maximum(small, 1e-6)).astype(np.float64)
    # Without the median, the comparison is independent of exposure.
    value = np.clip(value - np.median(value), -_RANGE, _RANGE)
    weight = np.broadcast_to(solid_angles_sr(2 * _ROWS)[:_ROWS, :, None], value.shape)
    weight = weight / weight.sum()
    return np.fft.rfft((value - (value * weight).sum()) * np.sqrt(weight), axis=1)


def _pair(
    first: HdrSky,
    second: HdrSky,
    a: Complex[np.ndarray, "r f 3"],
    b: Complex[np.ndarray, "r f 3"],
) -> SkyPair:
    # A yaw is a phase of the transform; a mirrored sky has the complex conjugate.
    largest = max(_products(a, b).max(), _products(a, b.conj()).max())
    powers = [float(_products(x, x)[0]) for x in (a, b)]
    distance = float(np.sqrt(max(sum(powers) - 2 * largest, 0.0)))
    return SkyPair(first, second, distance, float(largest / max(np.sqrt(np.prod(powers)), 1e-12)))


def _products(
    a: Complex[np.ndarray, "r f 3"], b: Complex[np.ndarray, "r f 3"]
) -> Float32[np.ndarray, " w"]:
    """Return the mean product of two skies for every relative yaw."""
    return np.fft.irfft((a * b.conj()).sum(axis=(0, 2)), n=4 * _ROWS).astype(np.float32)
