"""Comparison of cells of a shift map, compiled by numba."""

# numba infers the types of its functions' parameters.
# pyright: reportMissingParameterType=false

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True)
@no_type_check
def ring_differences(colour, is_known, ring, shifts, limit):
    """Compare cells with those a number of columns away, up to a constant colour difference.

    Args:
        colour: (rows, columns, 3), log.
        is_known: (rows, columns).
        ring: (cells, 2), rows and columns of known cells.
        shifts: numbers of columns.
        limit: greatest difference that one cell contributes.

    Returns:
        For each shift the mean absolute colour difference, inf without a known cell, and the
        fraction of cells whose shifted cell is known.
    """
    gaps, fractions = np.full(len(shifts), np.inf), np.zeros(len(shifts))
    difference = np.empty((len(ring), 3))
    for k in range(len(shifts)):
        count = 0
        mean = np.zeros(3)
        for i in range(len(ring)):
            row, column = ring[i]
            there = column + shifts[k]
            if 0 <= there < colour.shape[1] and is_known[row, there]:
                for c in range(3):
                    difference[count, c] = colour[row, column, c] - colour[row, there, c]
                    mean[c] += difference[count, c]
                count += 1
        if count == 0:
            continue
        mean /= count
        total = 0.0
        for i in range(count):
            apart = 0.0
            for c in range(3):
                apart += abs(difference[i, c] - mean[c]) / 3.0
            total += min(apart, limit)
        gaps[k], fractions[k] = total / count, count / len(ring)
    return gaps, fractions
