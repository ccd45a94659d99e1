"""Exposure and white balance of each camera, from surfaces that several cameras observe."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int16, Int64

# The values below were chosen by inspection; their sensitivity was not measured.

# Prior standard deviation of the log exposure of one camera relative to the mean of all: cameras of
# one rig have similar exposures.
_EXPOSURE_STD = 0.2
# Prior standard deviation of the log white balance of one channel against the camera's exposure.
_COLOUR_STD = 0.1
# Standard deviation of the log ratio of two cameras at one place: reflections depend on the
# viewpoint, and a mesh that is not exact shifts one image against the other. It is the prior of the
# observed standard deviation.
_PLACE_STD = 0.15
# Weight of this prior, as a number of places.
_PRIOR_PLACES = 4
# Linear pixel values outside this range are ignored: noise below, clipping above.
_USABLE = (0.01, 0.85)
# Huber's threshold on the deviation of one log ratio; larger deviations count linearly.
_HUBER = 0.15


def solve_gains(
    colours: Float32[np.ndarray, "n k 3"],
    weights: Float32[np.ndarray, "n k"],
    cameras: Int16[np.ndarray, "n k"],
    places: Int64[np.ndarray, " n"],
    camera_count: int,
) -> Float32[np.ndarray, "camera_count 3"]:
    """Return RGB gains g with pixel value = g x radiance; geometric mean over the cameras 1.

    Maximum a posteriori estimate with a Gaussian prior of gain 1, for exposure and white balance
    separately. For every pair of cameras the robust mean of the log ratios over n common places is
    one observation. Its variance is the variance between places divided by n. A place is a cell of
    space whose texels have common errors, so their number has no influence.

    Args:
        colours: linear pixel values of each texel's samples.
        weights: weight of each sample; 0 where a slot is empty.
        cameras: index of the camera of each sample.
        places: number of the place of each texel.
    """
    means, is_seen = _camera_means(colours, weights, cameras, camera_count)
    rows, targets, precisions = [], [], []
    for i in range(camera_count):
        for j in range(i + 1, camera_count):
            is_shared = is_seen[i] & is_seen[j]
            if not is_shared.any():
                continue
            ratios = _place_medians(means[i, is_shared] - means[j, is_shared], places[is_shared])
            row = np.zeros(camera_count)
            row[i], row[j] = 1.0, -1.0
            rows.append(row)
            target = _robust_mean(ratios)
            targets.append(target)
            precisions.append(_precision(ratios - target))
    if not rows:
        return np.ones((camera_count, 3), dtype=np.float32)
    # Each row is divided by its standard deviation.
    precision = np.array(precisions)[:, None]
    matrix, observed = np.array(rows) * precision, np.array(targets) * precision
    exposure = observed.mean(axis=1, keepdims=True)
    log_gains = _with_prior(matrix, exposure, _EXPOSURE_STD)
    log_gains = log_gains + _with_prior(matrix, observed - exposure, _COLOUR_STD)
    return np.exp(log_gains - log_gains.mean(axis=0)).astype(np.float32)


def _precision(deviations: Float64[np.ndarray, "p 3"]) -> float:
    """Return the inverse standard deviation of the mean over places, from their deviations."""
    # Deviations above Huber's threshold count as the threshold, as in the mean.
    squares = np.square(np.minimum(np.abs(deviations), _HUBER)).mean(axis=1)
    prior = _PRIOR_PLACES * _PLACE_STD**2
    variance = (prior + squares.sum()) / (_PRIOR_PLACES + len(squares))
    return float(np.sqrt(len(squares) / variance))


def _with_prior(
    matrix: Float64[np.ndarray, "m c"], right: Float64[np.ndarray, "m k"], prior_std: float
) -> Float64[np.ndarray, "c k"]:
    """Return the least-squares solution with a prior of mean 0 on every unknown.

    Args:
        matrix, right: observations, divided by their standard deviations.
    """
    count = matrix.shape[1]
    both = np.concatenate([matrix, np.eye(count) / prior_std])
    padded = np.concatenate([right, np.zeros((count, right.shape[1]))])
    return np.linalg.lstsq(both, padded, rcond=None)[0]


def _place_medians(
    values: Float64[np.ndarray, "n 3"], places: Int64[np.ndarray, " n"]
) -> Float64[np.ndarray, "p 3"]:
    """Return the median of the values of each place, which ignores occluded texels."""
    order = np.argsort(places, kind="stable")
    starts = np.flatnonzero(np.diff(places[order])) + 1
    return np.stack([np.median(own, axis=0) for own in np.split(values[order], starts)])


def _camera_means(
    colours: Float32[np.ndarray, "n k 3"],
    weights: Float32[np.ndarray, "n k"],
    cameras: Int16[np.ndarray, "n k"],
    camera_count: int,
) -> tuple[Float64[np.ndarray, "camera_count n 3"], Bool[np.ndarray, "camera_count n"]]:
    """Return the log of each camera's mean usable pixel value at each texel, and the mask of texels
    that have one."""
    low, high = _USABLE
    is_usable = (colours.min(axis=2) > low) & (colours.max(axis=2) < high) & (weights > 0)
    means = np.zeros((camera_count, len(colours), 3))
    is_seen = np.zeros((camera_count, len(colours)), dtype=bool)
    for camera in range(camera_count):
        fraction = np.where(is_usable & (cameras == camera), weights, 0.0)
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
