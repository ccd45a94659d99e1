"""Compiled loops of mesh simplification: quadrics, edge costs and one round of collapses.

`no_type_check` keeps the tests' run-time type checker out of compiled code.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit, prange

# Kind of a vertex on a border, or on a line between materials or provenances; 0: inside a surface.
_BORDER = 1
# Kind of a vertex at an edge of more than two faces; it does not move.
_FIXED = 2
# Added to the number of faces at an edge whose faces differ in material or provenance.
_MIXED = 100
# Most neighbours of a vertex; one with more does not move.
_MAX_NEIGHBOURS = 64
# Weight of the planes across borders relative to the planes of faces; sensitivity not measured.
_BORDER_WEIGHT = 4.0
# Least cosine between the normals of a face before and after a collapse: 60 degrees.
_MIN_COSINE = 0.5
# Least ratio of a face's area to the square of its longest edge; 0.43 for an equilateral triangle.
_MIN_QUALITY = 0.03


@njit(cache=True, nogil=True)
@no_type_check
def faces_by_vertex(faces, count):
    """Return the start of each vertex's list of faces (n + 1,), and the concatenated lists."""
    start = np.zeros(count + 1, np.int64)
    for f in range(faces.shape[0]):
        for k in range(3):
            start[faces[f, k] + 1] += 1
    for v in range(count):
        start[v + 1] += start[v]
    place = start[:-1].copy()
    members = np.empty(start[-1], np.int64)
    for f in range(faces.shape[0]):
        for k in range(3):
            v = faces[f, k]
            members[place[v]] = f
            place[v] += 1
    return start, members


@njit(cache=True, nogil=True)
@no_type_check
def _neighbours(v, faces, start, members, found, uses, groups, group):
    """Write the neighbours of a vertex to `found` and the number of faces at each edge to `uses`.

    Returns the number of neighbours, -1 if `found` is too short. `uses` is above `_MIXED` for edges
    between faces of different groups.
    """
    n = 0
    for s in range(start[v], start[v + 1]):
        f = members[s]
        if faces[f, 0] < 0:
            continue
        for k in range(3):
            w = faces[f, k]
            if w == v:
                continue
            at = -1
            for q in range(n):
                if found[q] == w:
                    at = q
            if at < 0:
                if n == found.shape[0]:
                    return -1
                at = n
                found[at], uses[at], group[at] = w, 0, groups[f]
                n += 1
            uses[at] += 1
            if group[at] != groups[f]:
                uses[at] += _MIXED
    return n


@njit(cache=True, nogil=True)
@no_type_check
def list_edges(faces, groups, start, members):
    """Return every edge once (first < second), the number of its faces (above `_MIXED` between
    groups), and the kind of each vertex."""
    count = start.shape[0] - 1
    edges = np.empty((members.shape[0], 2), np.int64)
    edge_uses = np.empty(members.shape[0], np.int64)
    kind = np.zeros(count, np.int8)
    found, uses = np.empty(_MAX_NEIGHBOURS, np.int64), np.empty(_MAX_NEIGHBOURS, np.int64)
    group = np.empty(_MAX_NEIGHBOURS, np.int64)
    n = 0
    for v in range(count):
        k = _neighbours(v, faces, start, members, found, uses, groups, group)
        if k < 0:
            kind[v] = _FIXED
            continue
        for q in range(k):
            if uses[q] > 2 and uses[q] < _MIXED:
                kind[v] = _FIXED
            elif uses[q] != 2:
                kind[v] = max(kind[v], _BORDER)
            if v < found[q]:
                edges[n, 0], edges[n, 1], edge_uses[n] = v, found[q], uses[q]
                n += 1
    return edges[:n].copy(), edge_uses[:n].copy(), kind


@njit(cache=True, nogil=True)
@no_type_check
def _add_plane(quadric, nx, ny, nz, d, weight):
    quadric[0] += weight * nx * nx
    quadric[1] += weight * nx * ny
    quadric[2] += weight * nx * nz
    quadric[3] += weight * ny * ny
    quadric[4] += weight * ny * nz
    quadric[5] += weight * nz * nz
    quadric[6] += weight * nx * d
    quadric[7] += weight * ny * d
    quadric[8] += weight * nz * d
    quadric[9] += weight * d * d


@njit(cache=True, nogil=True)
@no_type_check
def vertex_quadrics(points, faces, groups, start, members):
    """Return area-weighted plane quadrics (n, 10) and the total weight of each vertex (Garland &
    Heckbert 1997, doi:10.1145/258734.258849).

    Planes through borders, perpendicular to the faces, penalise motion across the border.
    """
    quadrics = np.zeros((points.shape[0], 10))
    weight = np.zeros(points.shape[0])
    found, uses = np.empty(_MAX_NEIGHBOURS, np.int64), np.empty(_MAX_NEIGHBOURS, np.int64)
    group = np.empty(_MAX_NEIGHBOURS, np.int64)
    for f in range(faces.shape[0]):
        a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
        n = np.cross(b - a, c - a)
        length = math.sqrt((n * n).sum())
        if length < 1e-12:
            continue
        n /= length
        d = -(n * a).sum()
        for k in range(3):
            _add_plane(quadrics[faces[f, k]], n[0], n[1], n[2], d, length / 6.0)
            weight[faces[f, k]] += length / 6.0
        for k in range(3):
            v, w = faces[f, k], faces[f, (k + 1) % 3]
            size = _neighbours(v, faces, start, members, found, uses, groups, group)
            is_border = False
            for q in range(size):
                is_border = is_border or (found[q] == w and uses[q] != 2)
            if not is_border:
                continue
            along = points[w] - points[v]
            across = np.cross(along, n)
            size_m = math.sqrt((across * across).sum())
            if size_m < 1e-12:
                continue
            across /= size_m
            e = -(across * points[v]).sum()
            for u in (v, w):
                border = _BORDER_WEIGHT * size_m * size_m
                _add_plane(quadrics[u], across[0], across[1], across[2], e, border)
    return quadrics, weight


@njit(cache=True, nogil=True)
@no_type_check
def _error(q, p):
    x, y, z = p[0], p[1], p[2]
    total = q[0] * x * x + q[3] * y * y + q[5] * z * z + q[9]
    total += 2 * (q[1] * x * y + q[2] * x * z + q[4] * y * z)
    return total + 2 * (q[6] * x + q[7] * y + q[8] * z)


@njit(cache=True, nogil=True)
@no_type_check
def _best_place(quadrics, points, v, w, q, out):
    """Write the point of least error to `out` and the sum of the two quadrics to `q`.

    The point is regularised towards the middle of the edge, which is the solution on planes and
    along straight lines, where the error does not determine it.
    """
    for k in range(10):
        q[k] = quadrics[v, k] + quadrics[w, k]
    x = 0.5 * (points[v, 0] + points[w, 0])
    y = 0.5 * (points[v, 1] + points[w, 1])
    z = 0.5 * (points[v, 2] + points[w, 2])
    eps = 1e-3 * (q[0] + q[3] + q[5]) + 1e-12
    m00, m11, m22 = q[0] + eps, q[3] + eps, q[5] + eps
    m01, m02, m12 = q[1], q[2], q[4]
    r0, r1, r2 = eps * x - q[6], eps * y - q[7], eps * z - q[8]
    c00, c01, c02 = m11 * m22 - m12 * m12, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
    det = m00 * c00 + m01 * c01 + m02 * c02
    c11, c12, c22 = m00 * m22 - m02 * m02, m01 * m02 - m00 * m12, m00 * m11 - m01 * m01
    out[0] = (c00 * r0 + c01 * r1 + c02 * r2) / det
    out[1] = (c01 * r0 + c11 * r1 + c12 * r2) / det
    out[2] = (c02 * r0 + c12 * r1 + c22 * r2) / det
    far = (out[0] - x) ** 2 + (out[1] - y) ** 2 + (out[2] - z) ** 2
    if not far < _square(points, v, w):
        out[0], out[1], out[2] = x, y, z


@njit(cache=True, nogil=True)
@no_type_check
def _square(points, v, w):
    """Return the squared distance between two vertices."""
    x, y = points[v, 0] - points[w, 0], points[v, 1] - points[w, 1]
    z = points[v, 2] - points[w, 2]
    return x * x + y * y + z * z


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def edge_costs(points, edges, uses, kind, quadrics, weight, max_error, max_edge):
    """Return the cost of each edge's collapse, inf if it is not allowed, and the resulting point.

    The cost is the RMS distance from the surrounding planes, plus a little for long edges.
    """
    cost = np.full(edges.shape[0], np.inf)
    place = np.empty((edges.shape[0], 3))
    sums = np.empty((edges.shape[0], 10))
    for e in prange(edges.shape[0]):
        v, w = edges[e, 0], edges[e, 1]
        # An interior edge between two border vertices would join two borders.
        is_border_pair = kind[v] == _BORDER and kind[w] == _BORDER
        if kind[v] == _FIXED or kind[w] == _FIXED or (is_border_pair and uses[e] == 2):
            continue
        square = _square(points, v, w)
        if square > min(max_edge[v], max_edge[w]) ** 2:
            continue
        _best_place(quadrics, points, v, w, sums[e], place[e])
        if kind[v] != kind[w]:
            fixed = v if kind[v] == _BORDER else w
            for k in range(3):
                place[e, k] = points[fixed, k]
        error = max(_error(sums[e], place[e]), 0.0)
        rms = math.sqrt(error / max(weight[v] + weight[w], 1e-12))
        if rms <= min(max_error[v], max_error[w]):
            # On planes all errors are 0: short edges first avoid thin triangles.
            cost[e] = rms + 1e-3 * math.sqrt(square)
    return cost, place


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def _cross(ax, ay, az, bx, by, bz, cx, cy, cz):  # noqa: PLR0913 - scalars of one triangle
    """Return twice the area vector of a triangle, as scalars to avoid array allocations."""
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@njit(cache=True, nogil=True)
@no_type_check
def _is_sound(v, other, p, points, faces, start, members, limit):
    """Return True if v may move to p: its faces do not flip or degenerate or exceed `limit`.

    Faces that contain `other` are not tested, since the collapse removes them.
    """
    for s in range(start[v], start[v + 1]):
        f = members[s]
        if faces[f, 0] < 0:
            continue
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        if i == other or j == other or k == other:
            continue
        while i != v:
            i, j, k = j, k, i
        ax, ay, az = points[i, 0], points[i, 1], points[i, 2]
        bx, by, bz = points[j, 0], points[j, 1], points[j, 2]
        cx, cy, cz = points[k, 0], points[k, 1], points[k, 2]
        ox, oy, oz = _cross(ax, ay, az, bx, by, bz, cx, cy, cz)
        nx, ny, nz = _cross(p[0], p[1], p[2], bx, by, bz, cx, cy, cz)
        longest = (bx - p[0]) ** 2 + (by - p[1]) ** 2 + (bz - p[2]) ** 2
        longest = max(longest, (cx - p[0]) ** 2 + (cy - p[1]) ** 2 + (cz - p[2]) ** 2)
        if longest > limit * limit:
            return False
        longest = max(longest, (cx - bx) ** 2 + (cy - by) ** 2 + (cz - bz) ** 2)
        size = math.sqrt(nx * nx + ny * ny + nz * nz)
        before = math.sqrt(ox * ox + oy * oy + oz * oz)
        if size * 0.5 < _MIN_QUALITY * longest:
            return False
        if nx * ox + ny * oy + nz * oz < _MIN_COSINE * size * before:
            return False
    return True


@njit(cache=True, nogil=True)
@no_type_check
def collapse_round(  # noqa: PLR0913 - one compiled loop over flat arrays
    points, faces, groups, start, members, edges, edge_uses, cost, place, order,
    quadrics, weight, max_error, max_edge,
):  # fmt: skip
    """Collapse edges in order of cost and return the number of collapses.

    Each vertex takes part in at most one collapse of a round, because its costs and its list of
    faces are not updated. Removed faces get index -1.
    """
    is_touched = np.zeros(points.shape[0], np.bool_)
    near_v, near_w = np.empty(_MAX_NEIGHBOURS, np.int64), np.empty(_MAX_NEIGHBOURS, np.int64)
    uses, group = np.empty(_MAX_NEIGHBOURS, np.int64), np.empty(_MAX_NEIGHBOURS, np.int64)
    done = 0
    for at in range(order.shape[0]):
        e = order[at]
        v, w = edges[e, 0], edges[e, 1]
        if is_touched[v] or is_touched[w]:
            continue
        n_v = _neighbours(v, faces, start, members, near_v, uses, groups, group)
        n_w = _neighbours(w, faces, start, members, near_w, uses, groups, group)
        common = 0
        for i in range(n_v):
            for j in range(n_w):
                common += near_v[i] == near_w[j]
        # Link condition: the ends have only those neighbours in common that lie on the edge's own
        # faces, so the collapse does not change the topology.
        if n_v < 0 or n_w < 0 or common != edge_uses[e] % _MIXED:
            continue
        limit = min(max_edge[v], max_edge[w])
        if not _is_sound(v, w, place[e], points, faces, start, members, limit):
            continue
        if not _is_sound(w, v, place[e], points, faces, start, members, limit):
            continue
        for s in range(start[w], start[w + 1]):
            f = members[s]
            if faces[f, 0] == v or faces[f, 1] == v or faces[f, 2] == v:
                faces[f, :] = -1
            for k in range(3):
                if faces[f, k] == w:
                    faces[f, k] = v
        points[v] = place[e]
        quadrics[v] += quadrics[w]
        weight[v] += weight[w]
        max_error[v] = min(max_error[v], max_error[w])
        max_edge[v] = limit
        is_touched[v] = is_touched[w] = True
        done += 1
    return done
