"""Compiled walk of viewing rays through a voxel grid.

`no_type_check` keeps the tests' run-time type checker out of compiled code.
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

    Lengths are in voxels, the grid fills [0, shape). Every voxel that the ray touches between
    its start and `ends_cells` is visited (Amanatides & Woo 1987).
    """
    shape = is_free.shape
    cell = np.zeros(3, np.int64)
    step = np.zeros(3, np.int64)
    t_next = np.zeros(3)
    t_step = np.zeros(3)
    for r in range(directions.shape[0]):
        enter, leave = 0.0, ends_cells[r]
        for k in range(3):
            d = directions[r, k]
            if abs(d) < 1e-12:
                if origin_cells[k] < 0.0 or origin_cells[k] >= shape[k]:
                    leave = -1.0
                continue
            a = (0.0 - origin_cells[k]) / d
            b = (shape[k] - origin_cells[k]) / d
            enter = max(enter, min(a, b))
            leave = min(leave, max(a, b))
        if leave <= enter:
            continue
        for k in range(3):
            d = directions[r, k]
            position = origin_cells[k] + d * enter
            cell[k] = min(max(math.floor(position), 0), shape[k] - 1)
            if abs(d) < 1e-12:
                step[k], t_next[k], t_step[k] = 0, math.inf, math.inf
            else:
                step[k] = 1 if d > 0 else -1
                border = cell[k] + 1 if d > 0 else cell[k]
                t_next[k] = (border - origin_cells[k]) / d
                t_step[k] = 1.0 / abs(d)
        t = enter
        while t < leave:
            is_free[cell[0], cell[1], cell[2]] = 1
            k = 0
            if t_next[1] < t_next[k]:
                k = 1
            if t_next[2] < t_next[k]:
                k = 2
            t = t_next[k]
            t_next[k] += t_step[k]
            cell[k] += step[k]
            if cell[k] < 0 or cell[k] >= shape[k]:
                break
