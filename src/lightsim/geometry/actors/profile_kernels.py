"""Compiled distance to a vehicle's side profile, the inner loop of the fit of its body.

`no_type_check` keeps the tests' run-time type checker out of compiled code.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def polygon_distance(x, z, corners):
    """Return signed distances (n,) of points x (n,), z (n,) to a closed polygon (k, 2).

    Distances are negative inside.
    """
    count = corners.shape[0]
    distance = np.empty(x.shape[0])
    for i in range(x.shape[0]):
        nearest, is_inside = np.inf, False
        for k in range(count):
            ax, az = corners[k, 0], corners[k, 1]
            ex = corners[(k + 1) % count, 0] - ax
            ez = corners[(k + 1) % count, 1] - az
            px, pz = x[i] - ax, z[i] - az
            along = (px * ex + pz * ez) / (ex * ex + ez * ez)
            along = min(max(along, 0.0), 1.0)
            nearest = min(nearest, (px - along * ex) ** 2 + (pz - along * ez) ** 2)
            # Even-odd rule: each edge crossed by the ray towards +x changes the side.
            if (az > z[i]) != (az + ez > z[i]) and px < ex * pz / ez:
                is_inside = not is_inside
        distance[i] = -math.sqrt(nearest) if is_inside else math.sqrt(nearest)
    return distance
