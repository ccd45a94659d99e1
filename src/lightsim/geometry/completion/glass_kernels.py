"""Compiled search for the rectangles with the greatest sums of log-odds.

`no_type_check` excludes compiled code from run-time type checks.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit, prange


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _sum(table, i, j, width, height):
    """Return a rectangle's sum from a summed-area table (Crow 1984, doi:10.1145/800031.808600)."""
    total = table[i + width, j + height] - table[i, j + height]
    return total - table[i + width, j] + table[i, j]


@njit(cache=True, nogil=True)
@no_type_check
def _summed_area(values):
    table = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    for i in range(values.shape[0]):
        row = 0.0
        for j in range(values.shape[1]):
            row += values[i, j]
            table[i + 1, j + 1] = table[i, j + 1] + row
    return table


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def best_rectangles(log_odds, is_free, sizes):
    """Find the rectangle with the greatest sum of log-odds among those that start at each cell.

    Args:
        log_odds: log-odds [s, z], 0 where unknown.
        is_free: cells that a rectangle may cover.
        sizes: least and greatest width, then least and greatest height, in cells.

    Returns:
        Sum of each rectangle, 0 where none is positive; its width and height.
    """
    total, taken = _summed_area(log_odds), _summed_area((~is_free).astype(np.float64))
    ns, nz = log_odds.shape
    score = np.zeros((ns, nz))
    size = np.zeros((ns, nz, 2), dtype=np.int64)
    for i in prange(ns):
        for j in range(nz):
            if not is_free[i, j]:
                continue
            for w in range(sizes[0], min(sizes[1], ns - i) + 1):
                for h in range(sizes[2], min(sizes[3], nz - j) + 1):
                    own = _sum(total, i, j, w, h)
                    if own > score[i, j] and _sum(taken, i, j, w, h) == 0:
                        score[i, j] = own
                        size[i, j, 0], size[i, j, 1] = w, h
    return score, size
