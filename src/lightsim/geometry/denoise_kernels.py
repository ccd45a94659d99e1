"""Compiled loops of mesh denoising: bilateral filtering of normals and the fit of vertices to them.

`no_type_check` keeps the tests' run-time type checker out of compiled code.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit, prange

# Most neighbours of a face: a marching-cubes mesh has 12 on average.
_MAX_NEAR = 24


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def neighbour_faces(faces, start, members):
    """Return up to 24 faces that have a vertex in common with each face, padded with -1, and their
    number."""
    near = np.full((faces.shape[0], _MAX_NEAR), -1, np.int32)
    count = np.zeros(faces.shape[0], np.int32)
    for f in prange(faces.shape[0]):
        n = 0
        for k in range(3):
            v = faces[f, k]
            for s in range(start[v], start[v + 1]):
                g = members[s]
                is_new = g != f and n < _MAX_NEAR
                for q in range(n):
                    is_new = is_new and near[f, q] != g
                if is_new:
                    near[f, n] = g
                    n += 1
        count[f] = n
    return near, count


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def filter_normals(points, faces, near, count, rounds, deviation):
    """Return unit normals of faces after a bilateral filter (Zheng et al. 2011,
    doi:10.1109/TVCG.2010.264); `deviation` is the Gaussian's width in normal differences."""
    m = faces.shape[0]
    normals = np.zeros((m, 3))
    centres = np.zeros((m, 3))
    area = np.zeros(m)
    for f in prange(m):
        a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
        n = np.cross(b - a, c - a)
        length = math.sqrt((n * n).sum())
        area[f] = 0.5 * length
        centres[f] = (a + b + c) / 3.0
        if length > 0.0:
            normals[f] = n / length
    # Spatial variance: about the square of an edge.
    reach = 2.0 * area.mean()
    for _ in range(rounds):
        new = np.empty_like(normals)
        for f in prange(m):
            for k in range(3):
                new[f, k] = area[f] * normals[f, k]
            for q in range(count[f]):
                g = near[f, q]
                far, other = 0.0, 0.0
                for k in range(3):
                    far += (centres[f, k] - centres[g, k]) ** 2
                    other += (normals[f, k] - normals[g, k]) ** 2
                weight = math.exp(-0.5 * far / reach - 0.5 * other / (deviation * deviation))
                for k in range(3):
                    new[f, k] += area[g] * weight * normals[g, k]
            length = math.sqrt((new[f] ** 2).sum())
            new[f] = new[f] / length if length > 0.0 else normals[f]
        normals = new
    return normals


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def fit_vertices(points, faces, start, members, normals, rounds):
    """Return vertices, moved iteratively until each face is perpendicular to its normal
    (Sun et al. 2007, doi:10.1109/TVCG.2007.1065)."""
    moved = points.copy()
    for _ in range(rounds):
        new = moved.copy()
        for v in prange(points.shape[0]):
            n = start[v + 1] - start[v]
            if n == 0:
                continue
            x, y, z = 0.0, 0.0, 0.0
            for s in range(start[v], start[v + 1]):
                f = members[s]
                along = 0.0
                for k in range(3):
                    centre = (
                        moved[faces[f, 0], k] + moved[faces[f, 1], k] + moved[faces[f, 2], k]
                    ) / 3.0
                    along += normals[f, k] * (centre - moved[v, k])
                x += normals[f, 0] * along
                y += normals[f, 1] * along
                z += normals[f, 2] * along
            new[v, 0] += x / n
            new[v, 1] += y / n
            new[v, 2] += z / n
        moved = new
    return moved
