"""Compiled loops of colouring: the best samples of each vertex, and their robust mean.

`no_type_check` keeps the tests' run-time type checker out of compiled code.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def insert_samples(vertex, colour, weight, camera, colours, weights, cameras):
    """Keep, for each vertex, the samples of greatest weight."""
    count = weights.shape[1]
    for s in range(vertex.shape[0]):
        v = vertex[s]
        worst = 0
        for k in range(1, count):
            if weights[v, k] < weights[v, worst]:
                worst = k
        if weight[s] <= weights[v, worst]:
            continue
        weights[v, worst] = weight[s]
        cameras[v, worst] = camera
        for c in range(3):
            colours[v, worst, c] = colour[s, c]


@njit(cache=True, nogil=True)
@no_type_check
def weighted_median(values, weights):
    """The value at which half of the weight is reached; 0 without weight."""
    half = 0.5 * weights.sum()
    below = 0.0
    for k in np.argsort(values):
        below += weights[k]
        if weights[k] > 0.0 and below >= half:
            return values[k]
    return 0.0


@njit(cache=True, nogil=True)
@no_type_check
def robust_means(colours, weights, cameras, inverse_gains, outlier_ratio, means, total):
    """Weighted mean of the samples near the weighted median brightness.

    Transparent or mirroring things and slips of the visibility test differ from the median;
    they are left out. `total` receives the weight that entered.
    """
    count = weights.shape[1]
    radiance = np.zeros((count, 3))
    limit = math.log(outlier_ratio)
    for v in range(weights.shape[0]):
        if weights[v].sum() <= 0.0:
            continue
        for k in range(count):
            radiance[k] = colours[v, k] * inverse_gains[cameras[v, k]]
        brightness = radiance.sum(axis=1)
        median = weighted_median(brightness, weights[v])
        for k in range(count):
            ratio = abs(math.log((brightness[k] + 1e-3) / (median + 1e-3)))
            if weights[v, k] > 0.0 and ratio <= limit:
                total[v] += weights[v, k]
                means[v] += weights[v, k] * radiance[k]
        means[v] /= total[v]
