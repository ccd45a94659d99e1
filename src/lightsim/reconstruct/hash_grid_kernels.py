"""Compiled loops of the hash grid: look up, scatter gradients, update touched entries.

Every kernel works on plain arrays, releases the interpreter lock and writes only to the part that
its caller assigns to it, so that threads need no atomics and results do not depend on their number.
Points are taken in tiles: cells and weights of a tile are computed first (the compiler turns that
into vector instructions), then the entries are visited, level by level.

`no_type_check` keeps the tests' run-time type checker out of compiled code.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

BLOCK_ENTRIES = 8
"""Entries that share one mark: with two features just one cache line of gradients."""
_TILE = 256
_PRIME_Y = np.uint32(2654435761)
_PRIME_Z = np.uint32(805459861)
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
@no_type_check
def _locate(points, salt, first, count, scale, mask, entry, weight):
    """Fill `entry` and `weight` [8, tile] with the corners of each point's cell."""
    for p in range(count):
        x = points[first + p, 0] * scale
        y = points[first + p, 1] * scale
        z = points[first + p, 2] * scale
        floor_x, floor_y, floor_z = np.floor(x), np.floor(y), np.floor(z)
        x0 = np.uint32(np.int32(floor_x))
        y0 = np.uint32(np.uint32(np.int32(floor_y)) * _PRIME_Y)
        z0 = np.uint32(np.uint32(np.int32(floor_z)) * _PRIME_Z)
        x1 = np.uint32(x0 + np.uint32(1))
        y1, z1 = np.uint32(y0 + _PRIME_Y), np.uint32(z0 + _PRIME_Z)
        z0, z1 = z0 ^ salt[first + p], z1 ^ salt[first + p]
        u1, v1, w1 = x - floor_x, y - floor_y, z - floor_z
        u0, v0, w0 = _ONE - u1, _ONE - v1, _ONE - w1
        entry[0, p], weight[0, p] = (x0 ^ y0 ^ z0) & mask, u0 * v0 * w0
        entry[1, p], weight[1, p] = (x1 ^ y0 ^ z0) & mask, u1 * v0 * w0
        entry[2, p], weight[2, p] = (x0 ^ y1 ^ z0) & mask, u0 * v1 * w0
        entry[3, p], weight[3, p] = (x1 ^ y1 ^ z0) & mask, u1 * v1 * w0
        entry[4, p], weight[4, p] = (x0 ^ y0 ^ z1) & mask, u0 * v0 * w1
        entry[5, p], weight[5, p] = (x1 ^ y0 ^ z1) & mask, u1 * v0 * w1
        entry[6, p], weight[6, p] = (x0 ^ y1 ^ z1) & mask, u0 * v1 * w1
        entry[7, p], weight[7, p] = (x1 ^ y1 ^ z1) & mask, u1 * v1 * w1


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
@no_type_check
def look_up(points, salt, table, scales, features, first, last, out):
    """Interpolated features of points[first:last], into `out` [n, levels * features].

    `features` is a tuple of that length: its size is known when the loop is compiled.
    """
    levels = scales.shape[0]
    size = table.shape[0] // levels
    mask = np.uint32(size - 1)
    entry = np.empty((8, _TILE), np.uint32)
    weight = np.empty((8, _TILE), np.float32)
    for start in range(first, last, _TILE):
        count = min(_TILE, last - start)
        for level in range(levels):
            _locate(points, salt, start, count, scales[level], mask, entry, weight)
            grid = table[level * size : (level + 1) * size]
            for p in range(count):
                for k in range(len(features)):
                    total = _ZERO
                    for corner in range(8):
                        total += weight[corner, p] * grid[entry[corner, p], k]
                    out[start + p, level * len(features) + k] = total


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
@no_type_check
def scatter(points, salt, scales, features, of_levels, upstream, gradient, is_touched):
    """Add d loss / d table of the levels in `of_levels` to `gradient`; mark the blocks written."""
    levels = scales.shape[0]
    size = gradient.shape[0] // levels
    mask = np.uint32(size - 1)
    entry = np.empty((8, _TILE), np.uint32)
    weight = np.empty((8, _TILE), np.float32)
    for start in range(0, points.shape[0], _TILE):
        count = min(_TILE, points.shape[0] - start)
        for level in of_levels:
            _locate(points, salt, start, count, scales[level], mask, entry, weight)
            grid = gradient[level * size : (level + 1) * size]
            marks = is_touched[level * size // BLOCK_ENTRIES :]
            for p in range(count):
                for corner in range(8):
                    i = entry[corner, p]
                    marks[i // BLOCK_ENTRIES] = 1
                    for k in range(len(features)):
                        share = upstream[start + p, level * len(features) + k]
                        grid[i, k] += weight[corner, p] * share


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
@no_type_check
def point_gradient(  # noqa: PLR0913
    points, salt, table, scales, features, first, last, upstream, out
):
    """d loss / d points[first:last] into `out` [n, 3]: the slope of the interpolation."""
    levels = scales.shape[0]
    size = table.shape[0] // levels
    mask = np.uint32(size - 1)
    entry = np.empty((8, _TILE), np.uint32)
    weight = np.empty((8, _TILE), np.float32)
    for start in range(first, last, _TILE):
        count = min(_TILE, last - start)
        out[start : start + count] = _ZERO
        for level in range(levels):
            scale = scales[level]
            _locate(points, salt, start, count, scale, mask, entry, weight)
            grid = table[level * size : (level + 1) * size]
            for p in range(start, start + count):
                x, y, z = points[p, 0] * scale, points[p, 1] * scale, points[p, 2] * scale
                u1, v1, w1 = x - np.floor(x), y - np.floor(y), z - np.floor(z)
                u0, v0, w0 = _ONE - u1, _ONE - v1, _ONE - w1
                for k in range(len(features)):
                    a, b = grid[entry[0, p - start], k], grid[entry[1, p - start], k]
                    c, d = grid[entry[2, p - start], k], grid[entry[3, p - start], k]
                    e, f = grid[entry[4, p - start], k], grid[entry[5, p - start], k]
                    g, h = grid[entry[6, p - start], k], grid[entry[7, p - start], k]
                    along_x = w0 * (v0 * (b - a) + v1 * (d - c)) + w1 * (
                        v0 * (f - e) + v1 * (h - g)
                    )
                    along_y = w0 * (u0 * (c - a) + u1 * (d - b)) + w1 * (
                        u0 * (g - e) + u1 * (h - f)
                    )
                    along_z = v0 * (u0 * (e - a) + u1 * (f - b)) + v1 * (
                        u0 * (g - c) + u1 * (h - d)
                    )
                    share = scale * upstream[p, level * len(features) + k]
                    out[p, 0] += share * along_x
                    out[p, 1] += share * along_y
                    out[p, 2] += share * along_z


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
@no_type_check
def update_touched(values, gradient, first_moment, second_moment, is_touched, first, last, rates):
    """Adam on every marked block in [first, last); clears its gradient and its mark.

    Arrays are flat, `rates` holds beta1, beta2, step size, sqrt of the second bias correction and
    epsilon. Values whose gradient is exactly zero keep their moments.
    """
    width = values.shape[0] // is_touched.shape[0]
    beta1, beta2, step_size, correction, epsilon = rates
    for block in range(first, last):
        if is_touched[block] == 0:
            continue
        is_touched[block] = 0
        for i in range(block * width, (block + 1) * width):
            slope = gradient[i]
            is_used = slope != _ZERO
            mean, square = first_moment[i], second_moment[i]
            new_mean = beta1 * mean + (_ONE - beta1) * slope
            new_square = beta2 * square + (_ONE - beta2) * slope * slope
            change = step_size * new_mean / (np.sqrt(new_square) * correction + epsilon)
            first_moment[i] = new_mean if is_used else mean
            second_moment[i] = new_square if is_used else square
            values[i] -= change if is_used else _ZERO
            gradient[i] = _ZERO
