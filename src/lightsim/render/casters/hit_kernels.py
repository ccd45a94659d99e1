"""Conversion of Embree's arrays to ray hits, compiled by numba.

`no_type_check` keeps the tests' run-time type checker out of compiled code.
"""

# numba infers the types of its functions' parameters.
# pyright: reportMissingParameterType=false

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from lightsim.core.casting import MISS


@njit(cache=True, nogil=True)
@no_type_check
def write_hits(found, mesh_by_geometry, distance_m, mesh_index, face_index, barycentric):
    """Write the hits of Embree's arrays `found` (primID, geomID, tfar, u, v).

    One pass over the rays: with a pass of numpy for each array, rays that meet nothing took ten
    times as long as their tracing.
    """
    face, geometry, distance, us, vs = found
    zero, one = np.float32(0.0), np.float32(1.0)
    for r in range(len(face)):
        face_index[r] = face[r]
        if face[r] == MISS:
            mesh_index[r], distance_m[r] = MISS, np.inf
            barycentric[r] = zero
            continue
        mesh_index[r], distance_m[r] = mesh_by_geometry[geometry[r]], distance[r]
        # Rounding can move hits at an edge slightly outside of their face.
        u, v = min(max(us[r], zero), one), min(max(vs[r], zero), one)
        barycentric[r, 0], barycentric[r, 1], barycentric[r, 2] = max(one - u - v, zero), u, v
