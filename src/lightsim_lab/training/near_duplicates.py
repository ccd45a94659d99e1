"""Pairs of skies that are nearly one picture: they must not lie on two sides of a split."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Complex, Float32

from lightsim.core.equirect import solid_angles_sr
from lightsim.errors import InputError
from lightsim_lab.training.hdr_skies import HdrSky, shrunk

_ROWS = 16
"""Of the upper half that is compared: cells of 5.6 degrees."""
_RANGE = 3.0
"""Log radiance farther from the median is cut: a black wall is no evidence of a sky."""
_LARGEST_DISTANCE = 0.3
_LEAST_CORRELATION = 0.8
"""Of the 69 skies of benchmarks/hdri_split.csv two pairs are closer in both: copies of one sky
(0.25, .98) and two dusks (0.30, .86). Even overcast skies come as close, but nothing in them agrees
(0.26, .78); clear skies agree in their one gradient, but at another slope (0.30, .94)."""


@dataclass(frozen=True)
class SkyPair:
    """Two skies at the yaw, mirroring and exposure at which they agree best.

    Args:
        first: of them.
        second: of them.
        distance: root mean square of the difference of log radiance over the upper half.
        correlation: of log radiance over the upper half.
    """

    first: HdrSky
    second: HdrSky
    distance: float
    correlation: float

    @property
    def is_near_duplicate(self) -> bool:
        """Close and alike."""
        return self.distance < _LARGEST_DISTANCE and self.correlation > _LEAST_CORRELATION


def sky_pairs(skies: Sequence[HdrSky]) -> list[SkyPair]:
    """Every pair, the closest first."""
    spectra = [_spectrum(sky.rest) for sky in skies]
    pairs = [
        _pair(skies[i], skies[j], spectra[i], spectra[j])
        for i, j in combinations(range(len(skies)), 2)
    ]
    return sorted(pairs, key=lambda pair: pair.distance)


def check_split(skies: Sequence[HdrSky]) -> None:
    """Refuse skies whose near-duplicates lie on another side.

    Raises:
        InputError: names the closest such pair.
    """
    for pair in sky_pairs(skies):
        first, second = pair.first.entry, pair.second.entry
        if pair.is_near_duplicate and first.split != second.split:
            raise InputError(
                "near-duplicates lie on two sides of the split",
                got=f"{first.name} ({first.split}) and {second.name} ({second.split}),"
                f" distance {pair.distance:.2f}, correlation {pair.correlation:.2f}",
                expected=f"a distance above {_LARGEST_DISTANCE} or a correlation below"
                f" {_LEAST_CORRELATION}",
                remedy="Give them one group in the split file.",
            )


def _spectrum(panorama: Float32[np.ndarray, "h w 3"]) -> Complex[np.ndarray, "r f 3"]:
    """Of log radiance without its mean, weighted so that products are means over the sky."""
    small = shrunk(panorama, 2 * _ROWS)[:_ROWS]
    value = np.log(np.maximum(small, 1e-6)).astype(np.float64)
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
    # A shift in yaw is a phase, a mirrored sky has the conjugate spectrum.
    shared = max(_products(a, b).max(), _products(a, b.conj()).max())
    powers = [float(_products(x, x)[0]) for x in (a, b)]
    distance = float(np.sqrt(max(sum(powers) - 2 * shared, 0.0)))
    return SkyPair(first, second, distance, float(shared / max(np.sqrt(np.prod(powers)), 1e-12)))


def _products(
    a: Complex[np.ndarray, "r f 3"], b: Complex[np.ndarray, "r f 3"]
) -> Float32[np.ndarray, " w"]:
    """Mean product of two skies by the yaw between them."""
    return np.fft.irfft((a * b.conj()).sum(axis=(0, 2)), n=4 * _ROWS).astype(np.float32)
