"""Compiled loops of the fusion: triangles into range images, range images into blocks.

`no_type_check` keeps the tests' run-time type checker out of compiled code.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit, prange

NOTHING = -2
"""label of a pixel without any evidence."""
FREE_ONLY = -1
"""label of a pixel that proves free space up to its distance and no surface."""
_EPSILON = 1e-9


@njit(cache=True, nogil=True)
@no_type_check
def rasterise_triangles(  # noqa: PLR0913 - compiled code takes plain arrays
    corners_px, directions, distances, normals, faces, labels, face_info, pixel, image, label_image
):
    """Draw triangles of a sweep into a range image, the nearest surface winning.

    `corners_px` holds (row, column) of each return. `pixel` = (first elevation, first azimuth,
    elevation step, azimuth step) in radians. `face_info` holds each face's nearest distance and
    whether it is ground. `image` [h, w, 5] receives distance, normal and the ground flag. A face
    with label FREE_ONLY draws its nearest distance alone, and only where nothing was.
    """
    height, width = label_image.shape
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        r0, c0 = corners_px[a, 0], corners_px[a, 1]
        r1, c1 = corners_px[b, 0], corners_px[b, 1]
        r2, c2 = corners_px[c, 0], corners_px[c, 1]
        area = (r1 - r0) * (c2 - c0) - (r2 - r0) * (c1 - c0)
        if abs(area) < _EPSILON:
            continue
        pa, pb, pc = (
            directions[a] * distances[a],
            directions[b] * distances[b],
            directions[c] * distances[c],
        )
        plane = np.cross(pb - pa, pc - pa)
        offset = plane[0] * pa[0] + plane[1] * pa[1] + plane[2] * pa[2]
        first_row = max(0, math.ceil(min(r0, r1, r2)))
        last_row = min(height - 1, math.floor(max(r0, r1, r2)))
        first_column = math.ceil(min(c0, c1, c2))
        last_column = math.floor(max(c0, c1, c2))
        for row in range(first_row, last_row + 1):
            elevation = pixel[0] + row * pixel[2]
            for unwrapped in range(first_column, last_column + 1):
                w1 = ((row - r0) * (c2 - c0) - (r2 - r0) * (unwrapped - c0)) / area
                w2 = ((r1 - r0) * (unwrapped - c0) - (row - r0) * (c1 - c0)) / area
                w0 = 1.0 - w1 - w2
                if w0 < -1e-6 or w1 < -1e-6 or w2 < -1e-6:
                    continue
                column = unwrapped % width
                old = label_image[row, column]
                if labels[f] == FREE_ONLY:
                    if old == NOTHING or (
                        old == FREE_ONLY and face_info[f, 0] < image[row, column, 0]
                    ):
                        image[row, column, 0] = face_info[f, 0]
                        label_image[row, column] = FREE_ONLY
                    continue
                azimuth = pixel[1] + unwrapped * pixel[3]
                dx = math.cos(elevation) * math.cos(azimuth)
                dy = math.cos(elevation) * math.sin(azimuth)
                dz = math.sin(elevation)
                slope = plane[0] * dx + plane[1] * dy + plane[2] * dz
                distance = distances[a] * w0 + distances[b] * w1 + distances[c] * w2
                if abs(slope) > _EPSILON and 0.5 * distance < offset / slope < 2.0 * distance:
                    distance = offset / slope
                if old >= 0 and image[row, column, 0] <= distance:
                    continue
                image[row, column, 0] = distance
                image[row, column, 4] = face_info[f, 1]
                for k in range(3):
                    image[row, column, 1 + k] = (
                        w0 * normals[a, k] + w1 * normals[b, k] + w2 * normals[c, k]
                    )
                label_image[row, column] = labels[f]


@njit(cache=True, parallel=True, nogil=True)
@no_type_check
def integrate_view(  # noqa: PLR0913 - compiled code takes plain arrays
    block_coords, sdf, weight, grid, rotation, shift, pixel, image, label_image, target
):
    """Fuse one range image into the blocks of a grid: weighted running mean of the distances.

    `grid` = (origin x, y, z, voxel, truncation, largest distance). `rotation`, `shift` map grid
    coordinates to world axes relative to the view's origin. Pixels whose label is not `target`
    only prove free space in front of them. Behind a surface the evidence fades, across the
    surface for the ground (seen at grazing angles) and along the ray for anything else, lest
    silhouettes grow tails.
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
            label = label_image[row, column]
            if label == NOTHING:
                continue
            measured = image[row, column, 0]
            if label != target:
                if distance > measured - truncation:
                    continue
                signed, confidence = truncation, 0.3 / (1.0 + (measured / 30.0) ** 2)
            else:
                elevation = pixel[0] + row * pixel[2]
                azimuth = pixel[1] + column * pixel[3]
                dx = math.cos(elevation) * math.cos(azimuth)
                dy = math.cos(elevation) * math.sin(azimuth)
                dz = math.sin(elevation)
                nx, ny, nz = (
                    image[row, column, 1],
                    image[row, column, 2],
                    image[row, column, 3],
                )
                signed = (
                    (px - measured * dx) * nx
                    + (py - measured * dy) * ny
                    + (pz - measured * dz) * nz
                )
                if signed < -truncation:
                    continue
                cosine = max(0.05, -(dx * nx + dy * ny + dz * nz))
                if image[row, column, 4] > 0.0:
                    depth = -signed / truncation
                    cosine = math.sqrt(cosine)
                else:
                    depth = 0.5 * (distance - measured) / truncation
                if depth > 1.0:
                    continue
                confidence = cosine / (1.0 + (measured / 30.0) ** 2)
                confidence *= min(1.0, max(0.1, 1.0 - depth))
                signed = min(signed, truncation)
            total = weight[b, i, j, k] + confidence
            sdf[b, i, j, k] += (signed - sdf[b, i, j, k]) * confidence / total
            weight[b, i, j, k] = total


@njit(cache=True, nogil=True)
@no_type_check
def mark_blocks(points, origin, block_m, reach_m, radius_band, path, table):
    """Set `table` true for each block within `reach_m` of a point (per axis) whose horizontal
    distance from `path` lies in `radius_band`."""
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
    """One round: each corner receives the sum of its faces' corner normals."""
    for f in range(faces.shape[0]):
        if not is_surface[f]:
            continue
        for k in range(3):
            total = normals[faces[f, 0], k] + normals[faces[f, 1], k] + normals[faces[f, 2], k]
            for corner in range(3):
                smoothed[faces[f, corner], k] += total
