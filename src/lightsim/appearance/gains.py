"""Exposure and white balance of each camera, from surfaces that several cameras observe."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int16

# The values below were chosen by inspection; their sensitivity was not measured.

# Linear pixel values outside this range are ignored: noise below, clipping above.
_USABLE = (0.01, 0.85)
# Huber's threshold on the deviation of one log ratio; larger deviations count linearly.
_HUBER = 0.15
# Least number of common texels of a pair of cameras.
_MIN_SHARED = 20


def solve_gains(
    colours: Float32[np.ndarray, "n k 3"],
    weights: Float32[np.ndarray, "n k"],
    cameras: Int16[np.ndarray, "n k"],
    camera_count: int,
    strength: float,
) -> Float32[np.ndarray, "camera_count 3"]:
    """Return RGB gains g with pixel value = g x radiance; geometric mean over the cameras 1.

    For every pair of cameras the robust mean of the log ratios over n common texels is one
    observation of weight n / (n + strength). A weak prior fixes unconnected cameras at 1.

    Args:
        colours: linear pixel values of each texel's samples.
        weights: weight of each sample; 0 where a slot is empty.
        cameras: index of the camera of each sample.
        strength: number of common texels at which an observation has half of its weight.
    """
    means, is_seen = _camera_means(colours, weights, cameras, camera_count)
    rows, targets, trust = [], [], []
    for i in range(camera_count):
        for j in range(i + 1, camera_count):
            is_shared = is_seen[i] & is_seen[j]
            shared = int(is_shared.sum())
            if shared < _MIN_SHARED:
                continue
            row = np.zeros(camera_count)
            row[i], row[j] = 1.0, -1.0
            rows.append(row)
            targets.append(_robust_mean(means[i, is_shared] - means[j, is_shared]))
            trust.append(shared / (shared + strength))
    # A weak prior of gain 1 for each camera; the last row constrains the log gains to sum 0.
    matrix = np.concatenate(
        [np.array(rows).reshape(-1, camera_count) * np.array(trust)[:, None]]
        + [0.01 * np.eye(camera_count), np.ones((1, camera_count))]
    )
    right = np.zeros((len(matrix), 3))
    if rows:
        right[: len(rows)] = np.array(targets) * np.array(trust)[:, None]
    log_gains, *_ = np.linalg.lstsq(matrix, right, rcond=None)
    return np.exp(log_gains - log_gains.mean(axis=0)).astype(np.float32)


def _camera_means(
    colours: Float32[np.ndarray, "n k 3"],
    weights: Float32[np.ndarray, "n k"],
    cameras: Int16[np.ndarray, "n k"],
    camera_count: int,
) -> tuple[Float64[np.ndarray, "camera_count n 3"], Bool[np.ndarray, "camera_count n"]]:
    """Return the log of each camera's mean usable pixel value at each texel, and the mask of texels
    that have one."""
    low, high = _USABLE
    is_fair = (colours.min(axis=2) > low) & (colours.max(axis=2) < high) & (weights > 0)
    means = np.zeros((camera_count, len(colours), 3))
    is_seen = np.zeros((camera_count, len(colours)), dtype=bool)
    for camera in range(camera_count):
        fraction = np.where(is_fair & (cameras == camera), weights, 0.0)
        total = fraction.sum(axis=1)
        is_seen[camera] = total > 0
        mean = (fraction[:, :, None] * colours).sum(axis=1) / np.where(total > 0, total, 1)[:, None]
        means[camera] = np.log(np.where(total[:, None] > 0, mean, 1.0))
    return means, is_seen


def _robust_mean(values: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "3"]:
    """Location of each channel by Huber's estimator (1964, doi:10.1214/aoms/1177703732)."""
    centre = np.median(values, axis=0)
    # Iteratively reweighted mean; ten iterations from the median converge.
    for _ in range(10):
        distance = np.abs(values - centre)
        weight = np.minimum(1.0, _HUBER / np.maximum(distance, 1e-9))
        centre = (weight * values).sum(axis=0) / weight.sum(axis=0)
    return centre.astype(np.float64)
