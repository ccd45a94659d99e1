"""A square of triangles, for tests of colour."""

from __future__ import annotations

import numpy as np

from lightsim.core.mesh import TriMesh
from lightsim.geometry.surface import make_mesh


def plane_mesh(side_m: float, step_m: float, z: float = 0.0) -> TriMesh:
    n = round(side_m / step_m) + 1
    x, y = np.meshgrid(*[np.linspace(-side_m / 2, side_m / 2, n)] * 2, indexing="ij")
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = (
        index[:-1, :-1].ravel(),
        index[1:, :-1].ravel(),
        index[1:, 1:].ravel(),
        index[:-1, 1:].ravel(),
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    points = np.stack([x.ravel(), y.ravel(), np.full(n * n, z)], axis=1)
    return make_mesh("world", points, faces)
