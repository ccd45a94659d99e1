"""Compiled search for rectangles of evidence.

`no_type_check` keeps the tests' run-time type checker out of compiled code.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit, prange


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _sum(table, i, j, width, height):
    """Of a rectangle, from a summed-area table (Crow 1984, doi:10.1145/800031.808600)."""
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


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _step(total, known, inner, outer, least_known):
    """Mean of one rectangle less that of another; -1e9 where too little of either is known."""
    inside = _sum(known, inner[0], inner[1], inner[2], inner[3])
    beyond = _sum(known, outer[0], outer[1], outer[2], outer[3])
    least = least_known * inner[2] * inner[3]
    if inside <= least or beyond <= least:
        return -1e9
    mean = _sum(total, inner[0], inner[1], inner[2], inner[3]) / inside
    return mean - _sum(total, outer[0], outer[1], outer[2], outer[3]) / beyond


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _least_step(total, known, box, strip, least_known):
    """The smallest step from inside a rectangle to beyond its sides, of which each counts as two
    halves: a slanting band crosses every side somewhere."""
    i, j, w, h = box
    least = 1e9
    for half in range(2):
        v, b = half * (h // 2), h // 2 + half * (h % 2)
        inner, outer = (i, j + v, strip, b), (i - strip, j + v, strip, b)
        least = min(least, _step(total, known, inner, outer, least_known))
        inner, outer = (i + w - strip, j + v, strip, b), (i + w, j + v, strip, b)
        least = min(least, _step(total, known, inner, outer, least_known))
        u, a = half * (w // 2), w // 2 + half * (w % 2)
        inner, outer = (i + u, j, a, strip), (i + u, j - strip, a, strip)
        least = min(least, _step(total, known, inner, outer, least_known))
        inner, outer = (i + u, j + h - strip, a, strip), (i + u, j + h, a, strip)
        least = min(least, _step(total, known, inner, outer, least_known))
    return least


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def best_rectangles(evidence, is_known, is_free, sizes, limits):
    """The rectangle that starts at each cell and sums up most evidence, and its width and height.

    Args:
        evidence: [s, z], with a margin of `strip` cells that no rectangle enters; 0 where unknown.
        is_free: cells that a rectangle may cover.
        sizes: least and greatest width and height.
        limits: evidence that counts as none; the least step across each side as a fraction of the
            mean evidence; cells on both sides of an edge that are compared, and the part of them
            that must be known.

    Returns:
        Sums of evidence above none, 0 where no rectangle is good; sizes.
    """
    between, least_step, strip, least_known = limits
    total, known = _summed_area(evidence), _summed_area(is_known.astype(np.float64))
    taken = _summed_area((~is_free).astype(np.float64))
    ns, nz = evidence.shape
    score = np.zeros((ns, nz))
    size = np.zeros((ns, nz, 2), dtype=np.int64)
    for i in prange(strip, ns - strip):
        for j in range(strip, nz - strip):
            if not is_free[i, j]:
                continue
            for w in range(sizes[0], min(sizes[1], ns - strip - i) + 1):
                for h in range(sizes[2], min(sizes[3], nz - strip - j) + 1):
                    own = _sum(total, i, j, w, h) - between * _sum(known, i, j, w, h)
                    if own <= score[i, j] or _sum(taken, i, j, w, h) > 0:
                        continue
                    mean = _sum(total, i, j, w, h) / _sum(known, i, j, w, h)
                    step = _least_step(total, known, (i, j, w, h), strip, least_known)
                    if step > least_step * mean:
                        score[i, j] = own
                        size[i, j, 0], size[i, j, 1] = w, h
    return score, size
