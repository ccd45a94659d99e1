"""Trivial relighting of single images, the lower bound of every comparison.

Functions take and return sRGB images in [0, 1]. Oracles read the true target image, which no method
may: they are an upper bound of global colour changes.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32

from lightsim_lab.metrics.folders import Baseline

# LMS cone responses from device-independent RGB (Reinhard et al. 2001, eq. 3 and 4).
_LMS_FROM_RGB = np.array(
    [[0.3811, 0.5783, 0.0402], [0.1967, 0.7244, 0.0782], [0.0241, 0.1288, 0.8444]]
)
# Rotation of log10 LMS that decorrelates natural images (eq. 6).
_LAB_FROM_LOG_LMS = np.diag([3**-0.5, 6**-0.5, 2**-0.5]) @ np.array(
    [[1.0, 1.0, 1.0], [1.0, 1.0, -2.0], [1.0, -1.0, 0.0]]
)


def copy_source(
    source_srgb: Float32[np.ndarray, "h w 3"],
    target_srgb: Float32[np.ndarray, "h w 3"],
    is_valid: Bool[np.ndarray, "h w"] | None = None,
) -> Float32[np.ndarray, "h w 3"]:
    """Return the source image unchanged."""
    return source_srgb


def oracle_affine(
    source_srgb: Float32[np.ndarray, "h w 3"],
    target_srgb: Float32[np.ndarray, "h w 3"],
    is_valid: Bool[np.ndarray, "h w"] | None = None,
) -> Float32[np.ndarray, "h w 3"]:
    """Oracle: apply the gain and offset per channel that fit the true target by least squares.

    The fit uses the valid pixels of this image. No other affine change per channel has a smaller
    squared error there before clipping, and clipping reduces it further.
    """
    predicted = np.empty_like(source_srgb)
    for channel in range(3):
        x = _valid(source_srgb[..., channel], is_valid).astype(np.float64)
        y = _valid(target_srgb[..., channel], is_valid).astype(np.float64)
        variance = float(x.var())
        gain = float(((x - x.mean()) * (y - y.mean())).mean()) / variance if variance > 0 else 0.0
        offset = float(y.mean()) - gain * float(x.mean())
        predicted[..., channel] = gain * source_srgb[..., channel] + offset
    return np.clip(predicted, 0.0, 1.0)


def oracle_reinhard(
    source_srgb: Float32[np.ndarray, "h w 3"],
    target_srgb: Float32[np.ndarray, "h w 3"],
    is_valid: Bool[np.ndarray, "h w"] | None = None,
) -> Float32[np.ndarray, "h w 3"]:
    """Oracle: apply mean and standard deviation of the true target in l-alpha-beta.

    Reinhard et al., Color Transfer between Images, 2001, doi:10.1109/38.946629.
    """
    source, target = lab_from_rgb(source_srgb), lab_from_rgb(target_srgb)
    from_mean, from_std = _mean_std(source, is_valid)
    to_mean, to_std = _mean_std(target, is_valid)
    moved = (source - from_mean) * (to_std / np.where(from_std > 0, from_std, 1.0)) + to_mean
    return np.clip(rgb_from_lab(moved), 0.0, 1.0).astype(np.float32)


def lab_from_rgb(rgb: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Return decorrelated l-alpha-beta values; channels below 1/255 are raised to 1/255."""
    # The smallest 8-bit value above 0 keeps the logarithm finite.
    lms = np.maximum(rgb.astype(np.float64), 1.0 / 255.0) @ _LMS_FROM_RGB.T
    return np.log10(lms) @ _LAB_FROM_LOG_LMS.T


def rgb_from_lab(lab: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Inverse of `lab_from_rgb` for channels of at least 1/255."""
    lms = 10.0 ** (lab @ np.linalg.inv(_LAB_FROM_LOG_LMS).T)
    return lms @ np.linalg.inv(_LMS_FROM_RGB).T


BASELINES: dict[str, Baseline] = {
    "copy": copy_source,
    "affine (oracle)": oracle_affine,
    "Reinhard (oracle)": oracle_reinhard,
}


def _valid(
    values: Float[np.ndarray, "h w"], is_valid: Bool[np.ndarray, "h w"] | None
) -> Float[np.ndarray, " n"]:
    return values.reshape(-1) if is_valid is None else values[is_valid]


def _mean_std(
    lab: Float[np.ndarray, "h w 3"], is_valid: Bool[np.ndarray, "h w"] | None
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    pixels = lab.reshape(-1, 3) if is_valid is None else lab[is_valid]
    return pixels.mean(axis=0), pixels.std(axis=0)
