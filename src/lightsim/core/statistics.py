"""Robust statistics."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, Shaped


def weighted_median(
    values: Float64[np.ndarray, "p k"], weight: Shaped[np.ndarray, " p"]
) -> Float[np.ndarray, " k"]:
    """Return the weighted median of each column; the least value if no weight is above 0."""
    # Each column is sorted; the first value at which half of the weight is reached is its median.
    order = np.argsort(values, axis=0)
    reached = np.cumsum(weight[order], axis=0)
    row = np.minimum((reached < 0.5 * weight.sum()).sum(axis=0), len(values) - 1)
    return np.take_along_axis(np.take_along_axis(values, order, 0), row[None], 0)[0]


def charbonnier_roots(residual: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Return square roots of Charbonnier's loss, with the sign of the residual.

    Least squares of them minimise that loss, with any method.
    """
    return np.sign(residual) * np.sqrt(2 * (np.sqrt(1 + residual**2) - 1))
