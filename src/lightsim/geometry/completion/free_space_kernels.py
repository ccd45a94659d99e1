"""Compiled traversal of a voxel grid by straight rays (Amanatides and Woo 1987).

`no_type_check` excludes compiled code from run-time type checks.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def walk_rays(origin_cells, directions, ends_cells, is_free):
    """Mark the voxels along each ray as free.

    Lengths are in voxels, the grid fills [0, shape). Every voxel that the ray touches between its
    start and `ends_cells` is marked.
    """
    cell, step = np.zeros(3, np.int64), np.zeros(3, np.int64)
    t_next, t_step = np.zeros(3), np.zeros(3)
    for r in range(directions.shape[0]):
        walk = (cell, step, t_next, t_step)
        t, leave = _enter(origin_cells, directions[r], ends_cells[r], is_free.shape, walk)
        while t < leave:
            is_free[cell[0], cell[1], cell[2]] = 1
            k = _nearest(t_next)
            t = t_next[k]
            t_next[k] += t_step[k]
            cell[k] += step[k]
            if cell[k] < 0 or cell[k] >= is_free.shape[k]:
                break


@njit(cache=True, nogil=True)
@no_type_check
def walk_beams(origins_cells, ends_cells, stops, entries, lengths):
    """Count the beams that end in each voxel and those that enter it, and sum their length in it.

    Lengths are in voxels, the grid fills [0, shape).
    """
    cell, step = np.zeros(3, np.int64), np.zeros(3, np.int64)
    t_next, t_step = np.zeros(3), np.zeros(3)
    for r in range(origins_cells.shape[0]):
        way = ends_cells[r] - origins_cells[r]
        whole = math.sqrt((way * way).sum())
        if whole < 1e-9:
            continue
        walk = (cell, step, t_next, t_step)
        t, leave = _enter(origins_cells[r], way / whole, whole, stops.shape, walk)
        while t < leave:
            k = _nearest(t_next)
            entries[cell[0], cell[1], cell[2]] += 1
            lengths[cell[0], cell[1], cell[2]] += min(t_next[k], leave) - t
            if t_next[k] >= leave:
                stops[cell[0], cell[1], cell[2]] += leave >= whole
                break
            t = t_next[k]
            t_next[k] += t_step[k]
            cell[k] += step[k]
            if cell[k] < 0 or cell[k] >= stops.shape[k]:
                break


@njit(cache=True, nogil=True)
@no_type_check
def _enter(origin, direction, end, shape, walk):
    """Return the distances at which a ray enters a grid, and leaves it or ends.

    The second is less than the first for rays that miss the grid. `walk` receives the first voxel,
    the steps to the next voxel along each axis, and the distances of the first step and between
    steps.
    """
    cell, step, t_next, t_step = walk
    enter, leave = 0.0, end
    for k in range(3):
        d = direction[k]
        if abs(d) < 1e-12:
            if origin[k] < 0.0 or origin[k] >= shape[k]:
                leave = -1.0
            continue
        a = (0.0 - origin[k]) / d
        b = (shape[k] - origin[k]) / d
        enter = max(enter, min(a, b))
        leave = min(leave, max(a, b))
    for k in range(3):
        d = direction[k]
        position = origin[k] + d * enter
        cell[k] = min(max(math.floor(position), 0), shape[k] - 1)
        if abs(d) < 1e-12:
            step[k], t_next[k], t_step[k] = 0, math.inf, math.inf
        else:
            step[k] = 1 if d > 0 else -1
            border = cell[k] + 1 if d > 0 else cell[k]
            t_next[k] = (border - origin[k]) / d
            t_step[k] = 1.0 / abs(d)
    return enter, leave


@njit(cache=True, nogil=True)
@no_type_check
def _nearest(t_next):
    """Return the axis along which the next voxel begins first."""
    k = 0
    if t_next[1] < t_next[k]:
        k = 1
    if t_next[2] < t_next[k]:
        k = 2
    return k
