"""Medians over squares of pixels and bilinear enlargement, compiled by numba.

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


@njit(cache=True, inline="always")
@no_type_check
def _count(fine, coarse, rank, change):
    """Add `change` to the number of pixels of a rank in the window."""
    fine[rank] += change
    coarse[rank >> _BLOCK_BITS] += change


@njit(cache=True, nogil=True)
@no_type_check
def rank_medians(ranks, size, values, is_wanted, out):
    """Medians over squares of `size` (odd) pixels that slide along the rows, by a histogram of
    ranks (Huang et al. 1979, doi:10.1109/TASSP.1979.1163188; ranks: Weiss 2006,
    doi:10.1145/1141911.1141918).

    `ranks` is the image, `size - 1` pixels larger than `out`, as indices into `values`, which
    ascend. Pixels of `out` that are not wanted are left as they are.
    """
    # Numbers of pixels in a window: 16 bits halve the memory, of which every step reads elsewhere.
    fine = np.zeros(len(values), dtype=np.int16)
    coarse = np.zeros((len(values) >> _BLOCK_BITS) + 1, dtype=np.int16)
    wanted = size * size // 2
    for i in range(out.shape[0]):
        columns = np.flatnonzero(is_wanted[i])
        if len(columns) == 0:
            continue
        median, below = 0, 0
        first, last = columns[0], columns[-1]
        for r in range(i, i + size):
            for c in range(first, first + size):
                _count(fine, coarse, ranks[r, c], 1)
        for j in range(first, last + 1):
            if is_wanted[i, j]:
                median, below = _walked(fine, coarse, median, below, wanted)
                out[i, j] = values[median]
            if j == last:
                break
            for r in range(i, i + size):
                gone, new = ranks[r, j], ranks[r, j + size]
                _count(fine, coarse, gone, -1)
                below -= gone < median
                _count(fine, coarse, new, 1)
                below += new < median
        # Removing the last window is faster than clearing all ranks.
        for r in range(i, i + size):
            for c in range(last, last + size):
                _count(fine, coarse, ranks[r, c], -1)


@njit(cache=True, nogil=True)
@no_type_check
def _order(lower, higher):
    """Exchange values so that those of `lower` are the lesser ones."""
    for j in range(len(lower)):
        a, b = lower[j], higher[j]
        lower[j], higher[j] = min(a, b), max(a, b)


@njit(cache=True, nogil=True)
@no_type_check
def small_medians(image, size, is_wanted, out):
    """Medians over squares of `size` (odd) pixels by forgetful selection (Paeth 1990, Graphics
    Gems, pp. 171-175): the least and the greatest of more than half of the values are not the
    median, and the next value replaces them.

    `image` holds whole numbers, for which the steps are vector instructions along a row, and is
    `size - 1` pixels larger than `out`. The time grows with the fourth power of `size`. Pixels of
    `out` that are not wanted are undefined.
    """
    held = size * size // 2 + 2
    for i in range(out.shape[0]):
        columns = np.flatnonzero(is_wanted[i])
        if len(columns) == 0:
            continue
        first, end = columns[0], columns[-1] + 1
        values = np.empty((held, end - first), dtype=image.dtype)
        for k in range(held):
            values[k] = image[i + k // size, first + k % size : end + k % size]
        for count in range(held, 2, -1):
            for k in range(1, count):
                _order(values[0], values[k])
            for k in range(1, count - 1):
                _order(values[k], values[count - 1])
            k = 2 * held - count
            if k < size * size:
                values[0] = image[i + k // size, first + k % size : end + k % size]
        out[i, first:end] = values[1]


@njit(cache=True, nogil=True)
@no_type_check
def enlarge(image, rows, columns, out):
    """Interpolate linearly along columns of pixels, then along rows.

    `rows` and `columns` have the lower and the upper neighbour of each pixel of `out`, and the
    weight of the upper one.
    """
    line = np.empty((image.shape[1], image.shape[2]), dtype=image.dtype)
    for i in range(out.shape[0]):
        low, high, part = rows[0][i], rows[1][i], rows[2][i]
        for j in range(image.shape[1]):
            for c in range(image.shape[2]):
                line[j, c] = image[low, j, c] + part * (image[high, j, c] - image[low, j, c])
        for j in range(out.shape[1]):
            low, high, part = columns[0][j], columns[1][j], columns[2][j]
            for c in range(image.shape[2]):
                out[i, j, c] = line[low, c] + part * (line[high, c] - line[low, c])
