"""Compiled traversal of the prisms behind a wall by viewing rays.

`no_type_check` excludes compiled code from run-time type checks.
"""

from __future__ import annotations

import math
from typing import no_type_check

from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def raise_to_filled(eye, points, column, filled, low_m, sizes_m, reach_m, out):
    """Raise `out` to the greatest probability of surface that each ray meets behind its point.

    `column` [x, y] is the column of the wall whose prism covers a cell of the plan, -1 for none;
    `filled` [column, level] is the probability that the prism reaches that level. `low_m` is the
    lowest corner of plan and levels. `sizes_m` are the edge of a plan cell and the height of a
    level; `reach_m` are the first and last distance behind the point.
    """
    plan_m, level_m = sizes_m
    step_m = plan_m / 2
    eye_x, eye_y, eye_z = eye[0] - low_m[0], eye[1] - low_m[1], eye[2] - low_m[2]
    for r in range(points.shape[0]):
        x, y, z = points[r, 0] - eye[0], points[r, 1] - eye[1], points[r, 2] - eye[2]
        distance = math.hypot(x, y)
        first, last = distance + reach_m[0], distance + reach_m[1]
        enters, leaves = first, last
        for across, start, count in ((x, eye_x, column.shape[0]), (y, eye_y, column.shape[1])):
            if across != 0.0:
                at_low = -start / across * distance
                at_high = (count * plan_m - start) / across * distance
                enters = max(enters, min(at_low, at_high))
                leaves = min(leaves, max(at_low, at_high))
        # Whole steps from `first`, so that the sampled places do not depend on the plan's size.
        t = first + math.floor((enters - first) / step_m) * step_m
        while t < last and t < leaves + step_m:
            part = t / distance
            t += step_m
            i = math.floor((eye_x + part * x) / plan_m)
            j = math.floor((eye_y + part * y) / plan_m)
            if i < 0 or j < 0 or i >= column.shape[0] or j >= column.shape[1]:
                continue
            level = math.floor((eye_z + part * z) / level_m)
            if column[i, j] >= 0 and level < filled.shape[1]:
                out[r] = max(out[r], filled[column[i, j], max(level, 0)])
