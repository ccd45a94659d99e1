"""Compiled look-up in stacked signed-distance grids, and boxes and occupied space along rays.

A stack is a tuple of plain arrays, see `tsdf_prior.TsdfPrior.stack`. `no_type_check` excludes
compiled code from the run-time type checks of the tests.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit, prange


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _block_at(stack, g, i, j, k):
    """Return the row of the block that contains sample (i, j, k) of grid g, or -1."""
    table, start, low, shape = stack[0], stack[1], stack[2], stack[3]
    bi, bj, bk = (i >> 3) - low[g, 0], (j >> 3) - low[g, 1], (k >> 3) - low[g, 2]
    if bi < 0 or bj < 0 or bk < 0 or bi >= shape[g, 0] or bj >= shape[g, 1] or bk >= shape[g, 2]:
        return -1
    return table[start[g] + (bi * shape[g, 1] + bj) * shape[g, 2] + bk]


@njit(cache=True, nogil=True)
@no_type_check
def _interpolated(stack, g, x, y, z):
    """Interpolate (distance, weight) trilinearly over the known corners.

    The weight is 0 if the known corners have less than half of the total interpolation weight.
    """
    geometry, sdf, weight = stack[4], stack[5], stack[6]
    voxel = geometry[g, 3]
    fx = (x - geometry[g, 0]) / voxel
    fy = (y - geometry[g, 1]) / voxel
    fz = (z - geometry[g, 2]) / voxel
    i, j, k = math.floor(fx), math.floor(fy), math.floor(fz)
    fx, fy, fz = fx - i, fy - j, fz - k
    value, evidence, total = 0.0, 0.0, 0.0
    for corner in range(8):
        di, dj, dk = corner >> 2, (corner >> 1) & 1, corner & 1
        fraction = (fx if di else 1.0 - fx) * (fy if dj else 1.0 - fy) * (fz if dk else 1.0 - fz)
        block = _block_at(stack, g, i + di, j + dj, k + dk)
        if block < 0:
            continue
        at = (((i + di) & 7) * 8 + ((j + dj) & 7)) * 8 + ((k + dk) & 7)
        w = weight[block, at]
        if w > 0.0:
            value += fraction * sdf[block, at]
            evidence += fraction * w
            total += fraction
    if total < 0.5:
        return 0.0, 0.0
    return value / total, evidence


@njit(cache=True, nogil=True)
@no_type_check
def _finest(stack, first, last, x, y, z):
    """Return (distance, weight, truncation) of the finest known grid of [first, last) at a point.

    The weight is 0 if no grid is known there.
    """
    for g in range(first, last):
        value, weight = _interpolated(stack, g, x, y, z)
        if weight > 0.0:
            return value, weight, stack[4][g, 4]
    return 0.0, 0.0, 0.0


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def look_up(stack, points, first, last, found):
    """Write distance, weight and truncation of points; [first, last) are the grids of each."""
    for p in prange(points.shape[0]):
        value, weight, truncation = _finest(
            stack, first[p], last[p], points[p, 0], points[p, 1], points[p, 2]
        )
        found[p, 0], found[p, 1], found[p, 2] = value, weight, truncation


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def enter_boxes(origins, directions, world_to_box, half, index, entry, leave):
    """Find the first boxes along each ray: index (or -1), and distances of entry and exit.

    `world_to_box` [b, 3, 4]; boxes [-half, half]. The number of columns of `index` limits the
    number of boxes, which are in the order of entry.
    """
    slots = index.shape[1]
    for r in prange(origins.shape[0]):
        for s in range(slots):
            index[r, s] = -1
            entry[r, s] = np.inf
            leave[r, s] = np.inf
        for b in range(half.shape[0]):
            # Slab test: the ray is inside between the last entry and the first exit of three axes.
            near, far = 0.0, np.inf
            for a in range(3):
                m = world_to_box[b, a]
                o = m[0] * origins[r, 0] + m[1] * origins[r, 1] + m[2] * origins[r, 2] + m[3]
                d = m[0] * directions[r, 0] + m[1] * directions[r, 1] + m[2] * directions[r, 2]
                if abs(d) < 1e-9:
                    if abs(o) > half[b, a]:
                        far = -1.0
                    continue
                t0, t1 = (-half[b, a] - o) / d, (half[b, a] - o) / d
                near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
            if far <= near:
                continue
            # Insertion into the sorted slots.
            at = slots
            while at > 0 and near < entry[r, at - 1]:
                at -= 1
            if at == slots:
                continue
            for s in range(slots - 1, at, -1):
                index[r, s], entry[r, s], leave[r, s] = (
                    index[r, s - 1],
                    entry[r, s - 1],
                    leave[r, s - 1],
                )
            index[r, at], entry[r, at], leave[r, at] = b, near, far


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def march(grid, origins, directions, boxes, found):
    """Find the intervals of rays in occupied voxels, outside boxes, by steps to the grid's end.

    `grid` is (occupied [x, y, z], lowest corner, voxel, step); `boxes` [n, s, 2] and `found`
    [n, k, 2] hold distances of entry and exit.
    """
    occupied, low, voxel, step = grid
    nx, ny, nz = occupied.shape
    for r in prange(origins.shape[0]):
        count, is_open, t = 0, False, 0.0
        while count < found.shape[1]:
            middle = t + 0.5 * step
            i = math.floor((origins[r, 0] + middle * directions[r, 0] - low[0]) / voxel)
            j = math.floor((origins[r, 1] + middle * directions[r, 1] - low[1]) / voxel)
            k = math.floor((origins[r, 2] + middle * directions[r, 2] - low[2]) / voxel)
            is_within = 0 <= i < nx and 0 <= j < ny and 0 <= k < nz
            is_here = is_within and occupied[i, j, k]
            for s in range(boxes.shape[1]):
                is_here &= not boxes[r, s, 0] <= middle < boxes[r, s, 1]
            if is_here and not is_open:
                found[r, count, 0] = t
                is_open = True
            elif is_open and not is_here:
                found[r, count, 1] = t
                count += 1
                is_open = False
            if not is_within:
                break
            t += step
