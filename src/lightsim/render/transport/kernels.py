"""Inner loops of the light transport matrix, compiled by numba.

`no_type_check` keeps the tests' run-time type checker out of compiled code.
"""

# numba infers the types of its functions' parameters.
# pyright: reportMissingParameterType=false

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit, prange

# Environment cell of a face ray that meets geometry.
BLOCKED = np.uint16(65535)
# Row of a face that is met but not listed in the frame's table.
UNLISTED = np.int32(-2)
# Upper bound of the terminator offset, in metres. Chosen; sensitivity not measured.
MAX_TERMINATOR_OFFSET_M = 0.04
# Steps of the R2 sequence (Roberts 2018), which covers the unit square evenly with any number of
# points.
GOLDEN_2D = (0.7548776662466927, 0.5698402909980532)
# Distance from a surface's plane within which a point counts as on it, at depth 0, in metres.
# Chosen; sensitivity not measured.
SAME_SURFACE_M = 0.02
# Increase of SAME_SURFACE_M per metre of depth, as geometry errors grow. Sensitivity not measured.
SAME_SURFACE_PER_M = 0.004


@njit(cache=True, inline="always", fastmath=True)
@no_type_check
def _cell_of(x, y, z, rows):
    """Return the environment cell of a direction in the equirectangular grid."""
    row = min(int(np.arccos(min(max(z, -1.0), 1.0)) * (rows / np.pi)), rows - 1)
    # Column 0 is at azimuth 180 degrees; the modulo below catches directions on that seam.
    columns = 2 * rows
    column = int((0.5 - np.arctan2(y, x) / (2.0 * np.pi)) * columns)
    return row * columns + column % columns


@njit(cache=True, inline="always", fastmath=True)
@no_type_check
def _cosine_direction(nx, ny, nz, u, v):
    """Return a cosine-distributed direction about a normal (basis: Duff et al. 2017, JCGT 6(1))."""
    sign = 1.0 if nz >= 0.0 else -1.0
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    radius, angle = np.sqrt(u), 2.0 * np.pi * v
    p, q, r = radius * np.cos(angle), radius * np.sin(angle), np.sqrt(max(0.0, 1.0 - u))
    x = p * (1.0 + sign * nx * nx * a) + q * b + r * nx
    y = p * sign * b + q * (sign + ny * ny * a) + r * ny
    z = -p * sign * nx - q * ny + r * nz
    return x, y, z


@njit(cache=True, nogil=True, parallel=True, fastmath=True)
@no_type_check
def hemisphere_rays(normals, shifts, count, rows, directions, cells):
    """Write `count` cosine-stratified directions of each normal, and the environment cell of each.

    All points use one R2 pattern, shifted on the unit torus by an offset of each point (Cranley and
    Patterson 1976, doi:10.1137/0713071), so that neighbours have independent errors.
    """
    for p in prange(normals.shape[0]):
        for k in range(count):
            u = (shifts[p, 0] + (k + 0.5) / count) % 1.0
            v = (shifts[p, 1] + (k + 1) * GOLDEN_2D[1]) % 1.0
            x, y, z = _cosine_direction(normals[p, 0], normals[p, 1], normals[p, 2], u, v)
            directions[p, k, 0], directions[p, k, 1], directions[p, k, 2] = x, y, z
            cells[p, k] = _cell_of(x, y, z, rows)


@njit(cache=True, inline="always")
@no_type_check
def _barycentric(u, v):
    """Map the unit square to two barycentric coordinates of a triangle, with uniform density.

    Heitz 2019, "A low-distortion map between triangle and square".
    """
    if v > u:
        return 0.5 * u, v - 0.5 * u
    return u - 0.5 * v, 0.5 * v


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def face_points(corners, shifts, count, points):
    """Write `count` evenly distributed points of each triangle."""
    for f in prange(corners.shape[0]):
        for k in range(count):
            u = (shifts[f, 0] + (k + 1) * GOLDEN_2D[0]) % 1.0
            v = (shifts[f, 1] + (k + 1) * GOLDEN_2D[1]) % 1.0
            b, c = _barycentric(u, v)
            for i in range(3):
                points[f, k, i] = (
                    (1.0 - b - c) * corners[f, 0, i] + b * corners[f, 1, i] + c * corners[f, 2, i]
                )


@njit(cache=True, nogil=True)
@no_type_check
def mean_texels(image, corner_uv, shifts, count, out):
    """Write the mean colour of each triangle of a texture, serially as in `face_normals`."""
    height, width = image.shape[0], image.shape[1]
    for f in range(corner_uv.shape[0]):
        total = np.zeros(3)
        for k in range(count):
            u = (shifts[f, 0] + (k + 1) * GOLDEN_2D[0]) % 1.0
            v = (shifts[f, 1] + (k + 1) * GOLDEN_2D[1]) % 1.0
            b, c = _barycentric(u, v)
            a = 1.0 - b - c
            x = a * corner_uv[f, 0, 0] + b * corner_uv[f, 1, 0] + c * corner_uv[f, 2, 0]
            y = a * corner_uv[f, 0, 1] + b * corner_uv[f, 1, 1] + c * corner_uv[f, 2, 1]
            i = min(max(int(y), 0), height - 1)
            j = min(max(int(x), 0), width - 1)
            for m in range(3):
                total[m] += image[i, j, m]
        for m in range(3):
            out[f, m] = total[m] / count


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def face_light(cells, sky, out):
    """Write the mean sky radiance over the rays of each face; blocked rays count as 0."""
    count = cells.shape[1]
    for f in prange(cells.shape[0]):
        r = g = b = 0.0
        for k in range(count):
            c = cells[f, k]
            if c != BLOCKED:
                r += sky[c, 0]
                g += sky[c, 1]
                b += sky[c, 2]
        out[f, 0], out[f, 1], out[f, 2] = r / count, g / count, b / count


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def face_bounce(next_rows, radiosity, out):
    """Write the mean radiance of the faces that the rays of each face meet."""
    count = next_rows.shape[1]
    for f in prange(next_rows.shape[0]):
        r = g = b = 0.0
        for k in range(count):
            n = next_rows[f, k]
            if n >= 0:
                r += radiosity[n, 0]
                g += radiosity[n, 1]
                b += radiosity[n, 2]
        out[f, 0], out[f, 1], out[f, 2] = r / count, g / count, b / count


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def fill_unlisted(next_rows):
    """Replace UNLISTED rows of a face's rays by the rows of the face's other rays, in turn.

    The row becomes -1 if no ray of the face meets a listed face.
    """
    count = next_rows.shape[1]
    for f in prange(next_rows.shape[0]):
        last = np.int32(-1)
        for k in range(count):
            if next_rows[f, k] >= 0:
                last = next_rows[f, k]
        for k in range(count):
            if next_rows[f, k] == UNLISTED:
                next_rows[f, k] = last
            elif next_rows[f, k] >= 0:
                last = next_rows[f, k]


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def point_light(cells, face_rows, sky, radiosity, out):
    """Write mean radiance over rays: columns 0-2 open sky, 3-5 light of hit faces, 6-8 all sky."""
    count = cells.shape[1]
    for p in prange(cells.shape[0]):
        total = np.zeros(9)
        for k in range(count):
            c, f = cells[p, k], face_rows[p, k]
            for i in range(3):
                total[6 + i] += sky[c, i]
                if f < 0:
                    total[i] += sky[c, i]
                else:
                    total[3 + i] += radiosity[f, i]
        for i in range(9):
            out[p, i] = total[i] / count


@njit(cache=True, inline="always")
@no_type_check
def _same_surface_weight(position, normal, other_position, other_normal, tolerance):
    """Return the weight, in [0, 1], of two points lying on one smooth surface; 1 if coplanar."""
    gap = 0.0
    cosine = 0.0
    for i in range(3):
        gap += (other_position[i] - position[i]) * normal[i]
        cosine += normal[i] * other_normal[i]
    if cosine <= 0.0:
        return 0.0
    # The eighth power halves the weight at 23 degrees between the normals.
    return cosine**8 * np.exp(-((gap / tolerance) ** 2))


@njit(cache=True, nogil=True)
@no_type_check
def _neighbours(index, block, grid, offset, surface, traced, rows, weights):
    """Write rows and weights (sum 1) of the traced points that light one pixel, and return their
    number.

    `grid` is (step, radius), `offset` the pixel within its block, `surface` its position, normal
    and depth. The ring outside the radius is searched for the most likely point only.
    """
    step, radius = grid
    tolerance = SAME_SURFACE_PER_M * surface[6] + SAME_SURFACE_M
    wide = radius + 1
    found, best_row, best, total = 0, -1, -1.0, 0.0
    for m in range((2 * wide + 1) ** 2):
        di, dj = m // (2 * wide + 1) - wide, m % (2 * wide + 1) - wide
        i, j = block[0] + di, block[1] + dj
        if i < 0 or j < 0 or i >= index.shape[0] or j >= index.shape[1] or index[i, j] < 0:
            continue
        k = index[i, j]
        dr = di + 0.5 - (offset[0] + 0.5) / step
        dc = dj + 0.5 - (offset[1] + 0.5) / step
        # Gaussian with a standard deviation of one block.
        near = np.exp(-0.5 * (dr * dr + dc * dc))
        likeness = _same_surface_weight(
            surface[:3], surface[3:6], traced[k, :3], traced[k, 3:], tolerance
        )
        if (likeness + 1e-9) * near > best:
            best, best_row = (likeness + 1e-9) * near, k
        if max(abs(di), abs(dj)) <= radius and likeness > 1e-3:
            weights[found], rows[found] = likeness * near, k
            total += likeness * near
            found += 1
    if found == 0 and best_row >= 0:
        weights[0], rows[0], total, found = 1.0, best_row, 1.0, 1

    weights[:found] /= total if total > 0.0 else 1.0
    return found


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def joint_weights(traced_pixels, pixel, positions, normals, depths, out_rows, out_weights, count):
    """Write the weights of joint bilateral upsampling from the traced pixels to any points.

    Kopf et al. 2007, doi:10.1145/1276377.1276497. `index[i, j]` is the row of the traced point of
    block (i, j), or -1. `traced` has position and normal of the traced points. Weights fall with
    the distance in the image, and with the distance from the point's tangent plane relative to its
    depth. If no neighbour is on the same surface, a wider search takes the most likely one, since
    thin objects must not become black.
    """
    index, traced, step, radius, width = traced_pixels
    size = (2 * radius + 1) ** 2
    for p in prange(len(pixel)):
        weights = np.zeros(size)
        rows = np.zeros(size, dtype=np.int64)
        surface = np.zeros(7)
        row, column = pixel[p] // width, pixel[p] % width
        surface[:3] = positions[p]
        surface[3:6] = normals[p]
        surface[6] = depths[p]
        block, offset = (row // step, column // step), (row % step, column % step)
        found = _neighbours(index, block, (step, radius), offset, surface, traced, rows, weights)
        count[p] = found
        for m in range(found):
            out_rows[p, m], out_weights[p, m] = rows[m], weights[m]


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def weighted_rows(rows, weights, count, values, place, out):
    """Add weighted sums of rows of `values` to the rows `place` of `out`."""
    for p in prange(len(rows)):
        for m in range(count[p]):
            for c in range(values.shape[1]):
                out[place[p], c] += weights[p, m] * values[rows[p, m], c]


@njit(cache=True, nogil=True)
@no_type_check
def add_to_pixels(pixel, fraction, values, out):
    """Add the values of samples, times the weight of a sample in its pixel."""
    for p in range(len(pixel)):
        for c in range(values.shape[1]):
            out[pixel[p], c] += fraction[pixel[p]] * values[p, c]


@njit(cache=True, nogil=True)
@no_type_check
def mark_rows(numbers, is_met):
    """Mark the numbers that occur; negative ones are ignored."""
    for i in range(numbers.shape[0]):
        for k in range(numbers.shape[1]):
            if numbers[i, k] >= 0:
                is_met[numbers[i, k]] = True


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def renumber(numbers, new):
    """Replace numbers by new ones, in place; negative ones stay."""
    for i in prange(numbers.shape[0]):
        for k in range(numbers.shape[1]):
            if numbers[i, k] >= 0:
                numbers[i, k] = new[numbers[i, k]]


@njit(cache=True, nogil=True)
@no_type_check
def face_normals(vertices, faces, out):
    """Write the normals of faces, not of unit length.

    Serial: meshes are many and small, and starting threads for each would cost more than the work.
    """
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        out[f, 0] = (b[1] - a[1]) * (c[2] - a[2]) - (b[2] - a[2]) * (c[1] - a[1])
        out[f, 1] = (b[2] - a[2]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[2] - a[2])
        out[f, 2] = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def sides_of_hits(first_face, normals, mesh_index, face_index, directions, out):
    """Write 2 x (running number of the face) + (1 if its clockwise side is met); -1 for misses."""
    for r in prange(len(mesh_index)):
        out[r] = -1
        if face_index[r] >= 0:
            f = first_face[mesh_index[r]] + face_index[r]
            n, d = normals[f], directions[r]
            is_back = n[0] * d[0] + n[1] * d[1] + n[2] * d[2] > 0.0
            out[r] = 2 * f + (1 if is_back else 0)


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def shading_normals(mesh, smooth, face_index, barycentric, directions, out, offsets):
    """Write unit normals interpolated between vertices, on the side that rays meet, and offsets.

    The face's own normal is used if the interpolated one is (nearly) perpendicular to it or absent.
    `mesh` is (vertices, faces). `offsets` receives the terminator offset: from the flat face to the
    curved surface with these smooth normals (Hanika 2021, Ray Tracing Gems II, ch. 4), at most
    MAX_TERMINATOR_OFFSET_M. It avoids self-shadowing of faces that turn away from the sun while
    their smooth normals do not.
    """
    vertices, faces = mesh
    for r in prange(len(face_index)):
        corner = faces[face_index[r]]
        a, b, c = vertices[corner[0]], vertices[corner[1]], vertices[corner[2]]
        n = np.zeros(3)
        flat = np.zeros(3)
        for m in range(3):
            p, q = (m + 1) % 3, (m + 2) % 3
            flat[m] = np.float64(b[p] - a[p]) * (c[q] - a[q]) - np.float64(b[q] - a[q]) * (
                c[p] - a[p]
            )
            for v in range(3):
                n[m] += barycentric[r, v] * smooth[corner[v], m]
        flat /= max(np.sqrt((flat * flat).sum()), 1e-30)
        n /= max(np.sqrt((n * n).sum()), 1e-30)
        agreement = (n * flat).sum()
        side = 1.0
        # Within 6 degrees of perpendicular, the side of the smooth normal is uncertain.
        if abs(agreement) < 0.1:
            n[:] = flat
        elif agreement < 0:
            n[:] = -n
            side = -1.0
        # Normals face the ray, so both sides of open meshes can be lit.
        away = flat[0] * directions[r, 0] + flat[1] * directions[r, 1] + flat[2] * directions[r, 2]
        if away > 0:
            n[:] = -n
            side = -side
        terminator_offset = np.zeros(3)
        for v in range(3):
            below = 0.0
            for m in range(3):
                gap = (
                    barycentric[r, 0] * np.float64(a[m] - vertices[corner[v], m])
                    + barycentric[r, 1] * np.float64(b[m] - vertices[corner[v], m])
                    + barycentric[r, 2] * np.float64(c[m] - vertices[corner[v], m])
                )
                below += gap * side * smooth[corner[v], m]
            for m in range(3):
                terminator_offset[m] -= (
                    barycentric[r, v] * min(0.0, below) * side * smooth[corner[v], m]
                )
        length = np.sqrt((terminator_offset * terminator_offset).sum())
        shrink = min(1.0, MAX_TERMINATOR_OFFSET_M / max(length, 1e-30))
        for m in range(3):
            out[r, m] = n[m]
            offsets[r, m] = shrink * terminator_offset[m]
