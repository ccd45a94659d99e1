"""Compiled loops of the fusion: triangles into range images, range images into blocks.

`no_type_check` excludes compiled code from the run-time type checks of the tests.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit, prange

# Label of a pixel without evidence.
NOTHING = -2
# Label of a pixel with free space up to its distance and no surface.
FREE_ONLY = -1


@njit(cache=True, nogil=True)
@no_type_check
def _direction(pixel, row, column):
    """Return the unit direction of a pixel's centre."""
    elevation = pixel[0] + row * pixel[2]
    azimuth = pixel[1] + column * pixel[3]
    flat = math.cos(elevation)
    return flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)


@njit(cache=True, nogil=True)
@no_type_check
def _fractions(row, column, a, b, c, area):
    """Return the barycentric coordinates of a pixel in three (row, column) corners."""
    w1 = ((row - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (column - a[1])) / area
    w2 = ((b[0] - a[0]) * (column - a[1]) - (row - a[0]) * (b[1] - a[1])) / area
    return 1.0 - w1 - w2, w1, w2


@njit(cache=True, nogil=True)
@no_type_check
def _draw(  # noqa: PLR0913 - compiled code takes plain arrays
    corners, distances, normals, plane, pixel, label, info, image, label_image
):
    """Draw one triangle into the range image, given the values at its three corners."""
    height, width = label_image.shape
    a, b, c = corners[0], corners[1], corners[2]
    area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if abs(area) < 1e-9:
        return
    first_row = max(0, math.ceil(corners[:, 0].min()))
    last_row = min(height - 1, math.floor(corners[:, 0].max()))
    first_column, last_column = math.ceil(corners[:, 1].min()), math.floor(corners[:, 1].max())
    for row in range(first_row, last_row + 1):
        for unwrapped in range(first_column, last_column + 1):
            w0, w1, w2 = _fractions(row, unwrapped, a, b, c, area)
            if min(w0, w1, w2) < -1e-6:
                continue
            column = unwrapped % width
            pixel_out, old = image[row, column], label_image[row, column]
            if label == FREE_ONLY:
                if old == NOTHING or (old == FREE_ONLY and info[0] < pixel_out[0]):
                    pixel_out[0] = info[0]
                    label_image[row, column] = FREE_ONLY
                continue
            x, y, z = _direction(pixel, row, unwrapped)
            # Distance to the triangle's plane, unless the ray is nearly parallel to it.
            slope = plane[0] * x + plane[1] * y + plane[2] * z
            distance = distances[0] * w0 + distances[1] * w1 + distances[2] * w2
            if abs(slope) > 1e-9 and 0.5 * distance < plane[3] / slope < 2.0 * distance:
                distance = plane[3] / slope
            if old >= 0 and pixel_out[0] <= distance:
                continue
            pixel_out[0], pixel_out[4] = distance, info[1]
            for k in range(3):
                pixel_out[1 + k] = w0 * normals[0, k] + w1 * normals[1, k] + w2 * normals[2, k]
            label_image[row, column] = label


@njit(cache=True, nogil=True)
@no_type_check
def rasterise_triangles(  # noqa: PLR0913 - compiled code takes plain arrays
    corners_px, directions, distances, normals, faces, labels, face_info, pixel, image, label_image
):
    """Draw triangles of a view into a range image; the nearest surface wins.

    `corners_px` holds (row, column) of each return. `pixel` = (first elevation, first azimuth,
    elevation step, azimuth step) in radians. `face_info` holds each face's nearest distance and its
    ground flag. `image` [h, w, 5] receives distance, normal and the ground flag. A face with label
    FREE_ONLY only draws its nearest distance, and only into pixels without a surface.
    """
    plane = np.zeros(4)
    for f in range(faces.shape[0]):
        ends = faces[f]
        at = directions[ends[0]] * distances[ends[0]]
        b = directions[ends[1]] * distances[ends[1]] - at
        c = directions[ends[2]] * distances[ends[2]] - at
        plane[0] = b[1] * c[2] - b[2] * c[1]
        plane[1] = b[2] * c[0] - b[0] * c[2]
        plane[2] = b[0] * c[1] - b[1] * c[0]
        plane[3] = plane[0] * at[0] + plane[1] * at[1] + plane[2] * at[2]
        _draw(
            corners_px[ends],
            distances[ends],
            normals[ends],
            plane,
            pixel,
            labels[f],
            face_info[f],
            image,
            label_image,
        )


@njit(cache=True, nogil=True)
@no_type_check
def _evidence(x, y, z, distance, seen, ray, truncation):
    """Return the signed distance and confidence of a sample at (x, y, z), given its pixel.

    Behind a surface the confidence decreases: with the distance across the surface on the ground,
    which is observed at grazing angles, and also along the ray elsewhere, which prevents false
    surface behind silhouettes.
    """
    measured = seen[0]
    nx, ny, nz = seen[1], seen[2], seen[3]
    signed = (
        (x - measured * ray[0]) * nx + (y - measured * ray[1]) * ny + (z - measured * ray[2]) * nz
    )
    cosine = max(0.05, -(ray[0] * nx + ray[1] * ny + ray[2] * nz))
    if seen[4] > 0.0:
        depth = -signed / truncation
        cosine = math.sqrt(cosine)
    else:
        depth = max(0.5 * (distance - measured), -signed) / truncation
    if depth > 1.0:
        return 0.0, 0.0
    # Beams diverge: returns at 30 m have half of the confidence.
    confidence = cosine / (1.0 + (measured / 30.0) ** 2)
    confidence *= min(1.0, max(0.1, 1.0 - depth))
    return min(signed, truncation), confidence


@njit(cache=True, parallel=True, nogil=True)
@no_type_check
def integrate_view(  # noqa: PLR0913 - compiled code takes plain arrays
    block_coords, sdf, weight, grid, rotation, shift, pixel, image, label_image, target
):
    """Fuse one range image into the blocks of a grid by weighted running means.

    `grid` = (origin x, y, z, voxel, truncation, largest distance). `rotation`, `shift` map grid
    coordinates to world axes relative to the view's origin. Pixels of another label than `target`
    only indicate free space in front of their surface.
    """
    height, width = label_image.shape
    voxel, truncation, furthest = grid[3], grid[4], grid[5]
    for b in prange(block_coords.shape[0]):
        for index in range(512):
            i, j, k = index // 64, (index // 8) % 8, index % 8
            x = grid[0] + voxel * (8 * block_coords[b, 0] + i)
            y = grid[1] + voxel * (8 * block_coords[b, 1] + j)
            z = grid[2] + voxel * (8 * block_coords[b, 2] + k)
            px = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + shift[0]
            py = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + shift[1]
            pz = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + shift[2]
            distance = math.sqrt(px * px + py * py + pz * pz)
            if distance > furthest or distance < 0.3:
                continue
            row = round((math.asin(pz / distance) - pixel[0]) / pixel[2])
            if row < 0 or row >= height:
                continue
            column = round((math.atan2(py, px) - pixel[1]) / pixel[3]) % width
            label, seen = label_image[row, column], image[row, column]
            if label == target:
                ray = _direction(pixel, row, column)
                signed, gained = _evidence(px, py, pz, distance, seen, ray, truncation)
            elif label != NOTHING and distance <= seen[0] - truncation:
                signed, gained = truncation, 0.3 / (1.0 + (seen[0] / 30.0) ** 2)
            else:
                continue
            if gained > 0.0:
                total = weight[b, i, j, k] + gained
                sdf[b, i, j, k] += (signed - sdf[b, i, j, k]) * gained / total
                weight[b, i, j, k] = total


@njit(cache=True, nogil=True)
@no_type_check
def mark_blocks(points, origin, block_m, reach_m, radius_band, path, table):
    """Mark blocks in `table` within `reach_m` (per axis) of the points near the path.

    The horizontal distance of these points from `path` lies in `radius_band`.
    """
    nx, ny, nz = table.shape
    low, high = radius_band[0] ** 2, radius_band[1] ** 2
    for p in range(points.shape[0]):
        best = 1e30
        for q in range(path.shape[0]):
            best = min(best, (points[p, 0] - path[q, 0]) ** 2 + (points[p, 1] - path[q, 1]) ** 2)
        if best < low or best > high:
            continue
        i0 = max(0, math.floor((points[p, 0] - reach_m - origin[0]) / block_m))
        i1 = min(nx - 1, math.floor((points[p, 0] + reach_m - origin[0]) / block_m))
        j0 = max(0, math.floor((points[p, 1] - reach_m - origin[1]) / block_m))
        j1 = min(ny - 1, math.floor((points[p, 1] + reach_m - origin[1]) / block_m))
        k0 = max(0, math.floor((points[p, 2] - reach_m - origin[2]) / block_m))
        k1 = min(nz - 1, math.floor((points[p, 2] + reach_m - origin[2]) / block_m))
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                for k in range(k0, k1 + 1):
                    table[i, j, k] = True


@njit(cache=True, nogil=True)
@no_type_check
def accumulate_vertex_normals(faces, face_normals, is_surface, normals):
    """Add the normals of surface faces to their corners."""
    for f in range(faces.shape[0]):
        if not is_surface[f]:
            continue
        for corner in range(3):
            for k in range(3):
                normals[faces[f, corner], k] += face_normals[f, k]


@njit(cache=True, nogil=True)
@no_type_check
def smooth_vertex_normals(faces, is_surface, normals, smoothed):
    """Sum into each corner the corner normals of its faces (one round of smoothing)."""
    for f in range(faces.shape[0]):
        if not is_surface[f]:
            continue
        for k in range(3):
            total = normals[faces[f, 0], k] + normals[faces[f, 1], k] + normals[faces[f, 2], k]
            for corner in range(3):
                smoothed[faces[f, corner], k] += total
