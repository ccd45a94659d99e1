"""Training samples and predictions of the lighting networks: the interface between training data,
networks and the sky estimate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32


@dataclass(frozen=True, eq=False)
class LightingBatch:
    """Panoramas with known skies, for training.

    Directions are in the panorama's own frame (z up; row 0 is the zenith; columns as in
    core/equirect.py). Exposure is random; the value 1 is where pixels clip.

    Args:
        panorama: complete LDR panoramas, sRGB in [0, 1], clipped.
        visibility: true where a simulated camera rig, which has blind spots, observes the panorama.
        front: pictures of one camera of limited field of view, sRGB in [0, 1].
        sky: linear radiance of the upper half, sun included, in units of the clipping value; also
            defined where the scene occludes the sky.
        sky_seen: true where the panorama's upper half shows sky and not scene.
        sun_direction: unit vectors towards the sun; towards the brightest spot where the sun is
            hidden.
        log_peak: natural logarithm of the luminance of the dome's brightest pixel.
        is_sunny: true where no cloud hides the sun, so that it casts shadows.
    """

    panorama: Float32[np.ndarray, "n h w 3"]
    visibility: Bool[np.ndarray, "n h w"]
    front: Float32[np.ndarray, "n fh fw 3"]
    sky: Float32[np.ndarray, "n h/2 w 3"]
    sky_seen: Bool[np.ndarray, "n h/2 w"]
    sun_direction: Float32[np.ndarray, "n 3"]
    log_peak: Float32[np.ndarray, " n"]
    is_sunny: Bool[np.ndarray, " n"]


@runtime_checkable
class LightingData(Protocol):
    """An endless source of batches. Equal seed and index give equal batches."""

    height_px: int

    def batch(self, size: int, seed: int, index: int, *, only_sunny: bool) -> LightingBatch:
        """Return `size` panoramas; with `only_sunny`, with clear suns if the source has any."""
        ...


@dataclass(frozen=True, eq=False)
class PanoramaBatch:
    """Panoramas whose light need not be known; fields as in LightingBatch."""

    panorama: Float32[np.ndarray, "n h w 3"]
    visibility: Bool[np.ndarray, "n h w"]


@runtime_checkable
class PanoramaData(Protocol):
    """An endless source of panoramas and masks. Equal seed and index give equal batches."""

    height_px: int

    def panoramas(self, size: int, seed: int, index: int) -> PanoramaBatch:
        """Return `size` complete panoramas and the masks of what cameras observe of them."""
        ...


@dataclass(frozen=True, eq=False)
class SkyPrediction:
    """Prediction of a sky network for one LDR panorama; frame and units as in LightingBatch.

    Args:
        sun_direction: unit vector.
        concentration: kappa of the von Mises-Fisher density around it (1 / rad^2 when large).
        log_peak: see LightingBatch.
        log_peak_std: one standard deviation of `log_peak`.
        sunny_probability: probability that the sun casts shadows.
        latent: appearance of the sky (paper: z_sky).
    """

    sun_direction: Float32[np.ndarray, "3"]
    concentration: float
    log_peak: float
    log_peak_std: float
    sunny_probability: float
    latent: Float32[np.ndarray, "64"]
