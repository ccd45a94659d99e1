"""Compiled traversal of the prisms behind a wall by viewing rays.

`no_type_check` excludes compiled code from run-time type checks.
"""

from __future__ import annotations

import math
from typing import no_type_check

from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def most_filled(eye, points, column, filled, base_m, sizes_m, reach_m, out):
    """Compute the greatest probability of surface that each ray meets behind its point, into `out`.

    `column` [x, y] is the column of the wall whose prism covers a cell of the plan, -1 for none;
    `filled` [column, level] is the probability that the prism reaches that level above `base_m`.
    `eye` and `points` are relative to the plan's lowest corner. `sizes_m` are the edge of a plan
    cell and the height of a level; `reach_m` are the first and last distance behind the point.
    """
    plan_m, level_m = sizes_m
    step_m = plan_m / 2
    for r in range(points.shape[0]):
        across = points[r] - eye
        distance = math.hypot(across[0], across[1])
        out[r] = 0.0
        first, last = distance + reach_m[0], distance + reach_m[1]
        enters, leaves = first, last
        for axis in range(2):
            if across[axis] != 0.0:
                at_low = -eye[axis] / across[axis] * distance
                at_high = (column.shape[axis] * plan_m - eye[axis]) / across[axis] * distance
                enters = max(enters, min(at_low, at_high))
                leaves = min(leaves, max(at_low, at_high))
        # Whole steps from `first`, so that the sampled places do not depend on the plan's size.
        t = first + math.floor((enters - first) / step_m) * step_m
        while t < last and t < leaves + step_m:
            place = eye + t / distance * across
            t += step_m
            i, j = math.floor(place[0] / plan_m), math.floor(place[1] / plan_m)
            if i < 0 or j < 0 or i >= column.shape[0] or j >= column.shape[1]:
                continue
            level = math.floor((place[2] - base_m) / level_m)
            if column[i, j] >= 0 and level < filled.shape[1]:
                out[r] = max(out[r], filled[column[i, j], max(level, 0)])
