"""Sliding medians, compiled by numba.

`no_type_check` keeps the tests' run-time type checker out of compiled code.
"""

# numba infers the types of its functions' parameters.
# pyright: reportMissingParameterType=false

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

# Log2 of the number of ranks that are also counted as a block, so that empty ranges are skipped. 64
# ranks were faster than 32 and 128 on 480 x 270 pixels (no script repeats this).
_BLOCK_BITS = 6


@njit(cache=True, inline="always")
@no_type_check
def _walked(fine, coarse, median, below, wanted):
    """Move from one rank, with `below` values below it, to the rank with `wanted` values below
    it."""
    block = 1 << _BLOCK_BITS
    while below > wanted:
        if median % block == 0 and below - coarse[(median >> _BLOCK_BITS) - 1] > wanted:
            below -= coarse[(median >> _BLOCK_BITS) - 1]
            median -= block
        else:
            median -= 1
            below -= fine[median]
    while below + fine[median] <= wanted:
        if median % block == 0 and below + coarse[median >> _BLOCK_BITS] <= wanted:
            below += coarse[median >> _BLOCK_BITS]
            median += block
        else:
            below += fine[median]
            median += 1
    return median, below


@njit(cache=True)
@no_type_check
def rank_medians(ranks, size, values, out):
    """Medians over squares of `size` (odd) pixels that slide along the rows, by a histogram of
    ranks (Huang et al. 1979, doi:10.1109/TASSP.1979.1163188; ranks: Weiss 2006,
    doi:10.1145/1141911.1141918).

    `ranks` is the image, `size - 1` pixels larger than `out`, as indices into `values`, which
    ascend.
    """
    fine = np.zeros(len(values), dtype=np.int32)
    coarse = np.zeros((len(values) >> _BLOCK_BITS) + 1, dtype=np.int32)
    wanted = size * size // 2
    for i in range(out.shape[0]):
        median, below = 0, 0
        for r in range(i, i + size):
            for c in range(size):
                fine[ranks[r, c]] += 1
                coarse[ranks[r, c] >> _BLOCK_BITS] += 1
        for j in range(out.shape[1]):
            median, below = _walked(fine, coarse, median, below, wanted)
            out[i, j] = values[median]
            if j + 1 == out.shape[1]:
                break
            for r in range(i, i + size):
                gone, new = ranks[r, j], ranks[r, j + size]
                fine[gone] -= 1
                coarse[gone >> _BLOCK_BITS] -= 1
                below -= gone < median
                fine[new] += 1
                coarse[new >> _BLOCK_BITS] += 1
                below += new < median
        # Removing the last window is faster than clearing all ranks.
        for r in range(i, i + size):
            for c in range(out.shape[1] - 1, out.shape[1] - 1 + size):
                fine[ranks[r, c]] -= 1
                coarse[ranks[r, c] >> _BLOCK_BITS] -= 1
