"""Compiled loops of baking: texels of faces, their samples in an image, and their robust mean.

`no_type_check` excludes compiled code from the run-time type checks of the tests.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit, prange

# Steps of the 8-bit weight code per factor of 2: at most 9 % apart.
_CODES_PER_OCTAVE = 8.0
# Code of weight 1, mid range: codes cover weights from 2^-16 to 2^16.
_ZERO_CODE = 128.0
# Least depth of a sampled point, in metres: projection is unstable at the camera.
_NEAR_M = 0.1


@njit(cache=True, nogil=True, inline="always")
@no_type_check
def row_length(n, j):
    """Return the number of texels of row j of a patch of resolution n."""
    return n + 1 if j == 0 else n + 2 - j


@njit(cache=True, nogil=True)
@no_type_check
def corner_weights(n, corner, i, j, weights):
    """Write the barycentric coordinates of texel (i, j) to `weights`."""
    if n == 0:
        weights[:] = 1.0 / 3.0
        return
    weights[corner] = 1.0 - (i + j) / n
    weights[(corner + 1) % 3] = i / n
    weights[(corner + 2) % 3] = j / n


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def fill_texels(patch, origin, turned, width, pixel, face, barycentric):
    """Write pixel, face and barycentric coordinates of every texel.

    `patch` holds the resolution, right corner and first texel of each face.
    """
    resolution, corner, first = patch
    for f in prange(resolution.shape[0]):
        n, t = resolution[f], first[f]
        step = -1 if turned[f] else 1
        for j in range(n + 1):
            for i in range(row_length(n, j)):
                column, row = origin[f, 0] + step * i, origin[f, 1] + step * j
                pixel[t] = np.int64(row) * width + column
                face[t] = f
                corner_weights(n, corner[f], i, j, barycentric[t])
                t += 1


@njit(cache=True, nogil=True)
@no_type_check
def touching_faces(faces, hit_faces, vertex_count):
    """Return the mask of faces with a vertex of any hit face (index -1: no hit)."""
    is_hit = np.zeros(vertex_count, dtype=np.bool_)
    for k in range(hit_faces.shape[0]):
        if hit_faces[k] >= 0:
            for c in range(3):
                is_hit[faces[hit_faces[k], c]] = True
    is_near = np.zeros(faces.shape[0], dtype=np.bool_)
    for f in range(faces.shape[0]):
        is_near[f] = is_hit[faces[f, 0]] or is_hit[faces[f, 1]] or is_hit[faces[f, 2]]
    return is_near


@njit(cache=True, nogil=True)
@no_type_check
def weight_code(weight):
    """Return the logarithmic one-byte code of a weight; 0 is no weight."""
    if weight <= 0.0:
        return 0
    code = _ZERO_CODE + _CODES_PER_OCTAVE * math.log2(weight)
    return int(min(max(code, 1.0), 255.0))


@njit(cache=True, nogil=True)
@no_type_check
def code_weight(code):
    """Return the weight of a code (inverse of `weight_code`)."""
    if code == 0:
        return 0.0
    return 2.0 ** ((code - _ZERO_CODE) / _CODES_PER_OCTAVE)


@njit(cache=True, nogil=True)
@no_type_check
def is_visible(inverse_depth, step, u, v, z, tolerance_m):
    """Return True for a point at or in front of the depth image's surface at (u, v).

    The inverse depth of a plane is linear in the image: bilinear interpolation is exact on it, even
    at a grazing angle.
    """
    h, w = inverse_depth.shape
    x = min(max(u / step - 0.5, 0.0), w - 1.001)
    y = min(max(v / step - 0.5, 0.0), h - 1.001)
    j, i = int(x), int(y)
    fx, fy = x - j, y - i
    near = (1 - fy) * ((1 - fx) * inverse_depth[i, j] + fx * inverse_depth[i, j + 1])
    near += fy * ((1 - fx) * inverse_depth[i + 1, j] + fx * inverse_depth[i + 1, j + 1])
    return (z * 0.99 - tolerance_m) * near <= 1.0


@njit(cache=True, nogil=True)
@no_type_check
def read_pixel(image, pixel_weight, u, v, colour):
    """Interpolate 8-bit codes at (u, v) bilinearly; return the least weight of the four pixels."""
    h, w = pixel_weight.shape
    x, y = min(max(u - 0.5, 0.0), w - 1.001), min(max(v - 0.5, 0.0), h - 1.001)
    j, i = int(x), int(y)
    fx, fy = x - j, y - i
    a, b, c, d = (1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx
    for k in range(3):
        colour[k] = a * image[i, j, k] + b * image[i, j + 1, k]
        colour[k] += c * image[i + 1, j, k] + d * image[i + 1, j + 1, k]
    low = min(pixel_weight[i, j], pixel_weight[i, j + 1])
    return min(low, min(pixel_weight[i + 1, j], pixel_weight[i + 1, j + 1]))


@njit(cache=True, nogil=True)
@no_type_check
def keep_sample(colour, code, frame, colours, codes, frames):
    """Replace the stored sample of least weight if the new one has a larger weight."""
    worst = 0
    for k in range(1, codes.shape[0]):
        if codes[k] < codes[worst]:
            worst = k
    if code <= codes[worst]:
        return
    codes[worst] = code
    frames[worst] = frame
    for c in range(3):
        colours[worst, c] = int(colour[c] + 0.5)


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def sample_texels(chosen, patch, faces, uv, depth, weight, view, samples):
    """Sample every texel of the chosen faces in one image.

    Projected corners are interpolated with the depth as weight, which is exact for a pinhole.
    """
    resolution, corner, first = patch
    colours, codes, frames = samples
    image, pixel_weight, inverse_depth, step, tolerance_m, frame = view
    height, width = pixel_weight.shape
    for q in prange(chosen.shape[0]):
        f = chosen[q]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if min(depth[a], depth[b], depth[c]) < _NEAR_M:
            continue
        n, t = resolution[f], first[f]
        fraction, colour = np.empty(3), np.empty(3)
        for j in range(n + 1):
            for i in range(row_length(n, j)):
                corner_weights(n, corner[f], i, j, fraction)
                sharp = fraction[0] * weight[a] + fraction[1] * weight[b] + fraction[2] * weight[c]
                fraction[0] *= depth[a]
                fraction[1] *= depth[b]
                fraction[2] *= depth[c]
                z = fraction[0] + fraction[1] + fraction[2]
                # Before any `continue`: the texel below is t - 1.
                t += 1
                if z < _NEAR_M or sharp <= 0.0:
                    continue
                u = (fraction[0] * uv[a, 0] + fraction[1] * uv[b, 0] + fraction[2] * uv[c, 0]) / z
                v = (fraction[0] * uv[a, 1] + fraction[1] * uv[b, 1] + fraction[2] * uv[c, 1]) / z
                if u < 1.0 or v < 1.0 or u > width - 1.0 or v > height - 1.0:
                    continue
                if not is_visible(inverse_depth, step, u, v, z, tolerance_m):
                    continue
                sharp *= read_pixel(image, pixel_weight, u, v, colour)
                code = weight_code(sharp)
                keep_sample(colour, code, frame, colours[t - 1], codes[t - 1], frames[t - 1])


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def robust_texels(samples, linear, inverse_gains, limit, radiance, is_seen):
    """Weighted mean of the samples near the weighted median brightness, gains divided out.

    Samples of transparent or reflecting surfaces, and errors of the visibility test, are outliers.
    """
    colours, codes, frames = samples
    slots = codes.shape[1]
    for t in prange(codes.shape[0]):
        values, bright, weight = np.empty((slots, 3)), np.empty(slots), np.empty(slots)
        total = 0.0
        for k in range(slots):
            weight[k] = code_weight(codes[t, k])
            total += weight[k]
            bright[k] = 1e-3
            for c in range(3):
                values[k, c] = linear[colours[t, k, c]] * inverse_gains[frames[t, k], c]
                bright[k] += values[k, c]
        if total <= 0.0:
            continue
        is_seen[t] = True
        below, median = 0.0, 0.0
        for k in np.argsort(bright):
            below += weight[k]
            if weight[k] > 0.0 and below >= 0.5 * total:
                median = bright[k]
                break
        total = 0.0
        for k in range(slots):
            if weight[k] > 0.0 and abs(math.log(bright[k] / median)) <= limit:
                total += weight[k]
                for c in range(3):
                    radiance[t, c] += weight[k] * values[k, c]
        for c in range(3):
            radiance[t, c] /= total


@njit(cache=True, nogil=True)
@no_type_check
def vertex_sums(patch, faces, area, radiance, is_seen, sums, total):
    """Sum the observed texels around each vertex, weighted by area and barycentric coordinate."""
    resolution, corner, first = patch
    fraction = np.empty(3)
    for f in range(faces.shape[0]):
        n, t = resolution[f], first[f]
        # Area of one texel.
        unit = area[f] / (first[f + 1] - first[f])
        for j in range(n + 1):
            for i in range(row_length(n, j)):
                if is_seen[t]:
                    corner_weights(n, corner[f], i, j, fraction)
                    for c in range(3):
                        w = unit * max(fraction[c], 0.0)
                        total[faces[f, c]] += w
                        for k in range(3):
                            sums[faces[f, c], k] += w * radiance[t, k]
                t += 1


@njit(cache=True, nogil=True, parallel=True)
@no_type_check
def fill_unseen_texels(patch, faces, colour, radiance, is_seen):
    """Interpolate unobserved texels between the colours of the face's corners."""
    resolution, corner, first = patch
    for f in prange(faces.shape[0]):
        n, t = resolution[f], first[f]
        fraction = np.empty(3)
        for j in range(n + 1):
            for i in range(row_length(n, j)):
                if not is_seen[t]:
                    corner_weights(n, corner[f], i, j, fraction)
                    for k in range(3):
                        value = 0.0
                        for c in range(3):
                            value += fraction[c] * colour[faces[f, c], k]
                        radiance[t, k] = max(value, 0.0)
                t += 1
