"""Compiled loops of the hash grid: look up, scatter gradients, update touched entries.

Every loop uses flat arrays, releases the interpreter lock and writes only to the range of its
caller, so that threads require no atomics and results do not depend on their number. Points are
processed in tiles: first the cells and weights of a tile, which the compiler vectorises, then the
entries. Almost every access to an entry misses the caches, so entries are prefetched some points
ahead, which saves up to half of the time.

`features` is a tuple of zeros, whose length is a constant of the compiled loop.
`no_type_check` excludes compiled code from the run-time type checks of the tests.
"""

from __future__ import annotations

from typing import Any, no_type_check

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from lightsim.reconstruct.field.hash_grid.spec import PRIMES, SALT_PRIME

# Entries of one mark: with two features, the gradients of one cache line.
BLOCK_ENTRIES = 8
# Factor of the y cell in the hash; overflow of 32 bits is part of it.
PRIME_Y = np.uint32(PRIMES[1])
# Factor of the z cell.
PRIME_Z = np.uint32(PRIMES[2])
PRIME_SALT = np.uint32(SALT_PRIME)
# Points of a tile: its intermediate results fit the first-level cache.
_TILE = 256
# Distance of prefetched entries in points, and of prefetched blocks below: chosen by running time.
_POINTS_AHEAD = 16
# Distance of prefetched blocks of entries.
_BLOCKS_AHEAD = 6
# One and zero in single precision: plain literals would promote sums to double precision.
_ONE = np.float32(1.0)
# See `_ONE`.
_ZERO = np.float32(0.0)
# Fused operations may differ in the last bit from plain torch; divisions by zero are not checked.
_compile: Any = njit(cache=True, nogil=True, fastmath={"contract", "nsz"}, error_model="numpy")


@intrinsic
def _fetch(_context: Any, array: Any, index: Any) -> Any:
    """Prefetch the cache line of array[index]."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        values = context.make_array(signature.args[0])(context, builder, arguments[0])
        byte, word = ir.IntType(8).as_pointer(), ir.IntType(32)
        place = builder.bitcast(builder.gep(values.data, [arguments[1]]), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, word, word, word])
        prefetch = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        # Read access, highest locality, data cache.
        builder.call(prefetch, [place, word(0), word(3), word(1)])
        return context.get_dummy_value()

    return types.void(array, index), generate


@_compile
@no_type_check
def _take(points, salt, start, count, place, bits):
    """Copy a tile of points, coordinate after coordinate, and their salts."""
    for p in range(count):
        place[p] = points[3 * (start + p)]
        place[_TILE + p] = points[3 * (start + p) + 1]
        place[2 * _TILE + p] = points[3 * (start + p) + 2]
        bits[p] = salt[start + p]


@_compile
@no_type_check
def _locate(place, bits, count, scale, mask, entry, weight):
    """Write entry and weight of the corners of the points' cells, a tile per corner, x fastest."""
    for p in range(count):
        x, y, z = place[p] * scale, place[_TILE + p] * scale, place[2 * _TILE + p] * scale
        floor_x, floor_y, floor_z = np.floor(x), np.floor(y), np.floor(z)
        x0 = np.uint32(np.int32(floor_x))
        y0 = np.uint32(np.uint32(np.int32(floor_y)) * PRIME_Y)
        z0 = np.uint32(np.uint32(np.int32(floor_z)) * PRIME_Z)
        x1 = np.uint32(x0 + np.uint32(1))
        y1, z1 = np.uint32(y0 + PRIME_Y), np.uint32(z0 + PRIME_Z)
        z0, z1 = z0 ^ bits[p], z1 ^ bits[p]
        u1, v1, w1 = x - floor_x, y - floor_y, z - floor_z
        u0, v0, w0 = _ONE - u1, _ONE - v1, _ONE - w1
        entry[p], weight[p] = (x0 ^ y0 ^ z0) & mask, u0 * v0 * w0
        entry[_TILE + p], weight[_TILE + p] = (x1 ^ y0 ^ z0) & mask, u1 * v0 * w0
        entry[2 * _TILE + p], weight[2 * _TILE + p] = (x0 ^ y1 ^ z0) & mask, u0 * v1 * w0
        entry[3 * _TILE + p], weight[3 * _TILE + p] = (x1 ^ y1 ^ z0) & mask, u1 * v1 * w0
        entry[4 * _TILE + p], weight[4 * _TILE + p] = (x0 ^ y0 ^ z1) & mask, u0 * v0 * w1
        entry[5 * _TILE + p], weight[5 * _TILE + p] = (x1 ^ y0 ^ z1) & mask, u1 * v0 * w1
        entry[6 * _TILE + p], weight[6 * _TILE + p] = (x0 ^ y1 ^ z1) & mask, u0 * v1 * w1
        entry[7 * _TILE + p], weight[7 * _TILE + p] = (x1 ^ y1 ^ z1) & mask, u1 * v1 * w1


@_compile
@no_type_check
def _fetch_ahead(values, first_value, features, entry, count, p):
    """Prefetch the entries of a later point of the tile."""
    later = min(p + _POINTS_AHEAD, count - 1)
    for corner in range(8):
        i = np.uint64(entry[corner * _TILE + later]) * np.uint64(len(features))
        _fetch(values, first_value + i)


@_compile
@no_type_check
def look_up(points, salt, table, scales, features, first, last, out):
    """Write the features of points first to last into `out` [n * levels * features]."""
    levels, width = len(scales), np.uint64(len(features))
    size = len(table) // (levels * len(features))
    place, bits = np.empty(3 * _TILE, np.float32), np.empty(_TILE, np.uint32)
    entry, weight = np.empty(8 * _TILE, np.uint32), np.empty(8 * _TILE, np.float32)
    for start in range(first, last, _TILE):
        count = min(_TILE, last - start)
        _take(points, salt, start, count, place, bits)
        for level in range(levels):
            _locate(place, bits, count, scales[level], np.uint32(size - 1), entry, weight)
            first_value = np.uint64(level * size) * width
            for p in range(count):
                _fetch_ahead(table, first_value, features, entry, count, p)
                row = out[((start + p) * levels + level) * len(features) :]
                # Two features at a time: the compiler holds both sums in one register.
                for k in range(0, len(features) - 1, 2):
                    even, odd = _ZERO, _ZERO
                    for corner in range(8):
                        i = first_value + np.uint64(entry[corner * _TILE + p]) * width
                        even += weight[corner * _TILE + p] * table[i + np.uint64(k)]
                        odd += weight[corner * _TILE + p] * table[i + np.uint64(k + 1)]
                    row[k], row[k + 1] = even, odd
                if len(features) % 2 == 1:
                    even = _ZERO
                    for corner in range(8):
                        i = first_value + np.uint64(entry[corner * _TILE + p]) * width
                        even += weight[corner * _TILE + p] * table[i + width - np.uint64(1)]
                    row[len(features) - 1] = even


@_compile
@no_type_check
def scatter(points, salt, scales, features, level, upstream, gradient, is_touched):
    """Add d loss / d entries of one level to `gradient`, and mark the written blocks."""
    levels, width = len(scales), np.uint64(len(features))
    size = len(gradient) // (levels * len(features))
    place, bits = np.empty(3 * _TILE, np.float32), np.empty(_TILE, np.uint32)
    entry, weight = np.empty(8 * _TILE, np.uint32), np.empty(8 * _TILE, np.float32)
    first_entry = np.uint64(level * size)
    for start in range(0, len(salt), _TILE):
        count = min(_TILE, len(salt) - start)
        _take(points, salt, start, count, place, bits)
        _locate(place, bits, count, scales[level], np.uint32(size - 1), entry, weight)
        for p in range(count):
            _fetch_ahead(gradient, first_entry * width, features, entry, count, p)
            row = upstream[((start + p) * levels + level) * len(features) :]
            for corner in range(8):
                i = first_entry + np.uint64(entry[corner * _TILE + p])
                is_touched[i // np.uint64(BLOCK_ENTRIES)] = 1
                for k in range(len(features)):
                    gradient[i * width + np.uint64(k)] += weight[corner * _TILE + p] * row[k]


@_compile
@no_type_check
def _add_slopes(x, y, z, pull, slopes):
    """Add the gradient of the trilinear mean of `pull`, the corner values of a unit cell."""
    u1, v1, w1 = x - np.floor(x), y - np.floor(y), z - np.floor(z)
    u0, v0, w0 = _ONE - u1, _ONE - v1, _ONE - w1
    a, b, c, d = pull[0], pull[1], pull[2], pull[3]
    e, f, g, h = pull[4], pull[5], pull[6], pull[7]
    slopes[0] += w0 * (v0 * (b - a) + v1 * (d - c)) + w1 * (v0 * (f - e) + v1 * (h - g))
    slopes[1] += w0 * (u0 * (c - a) + u1 * (d - b)) + w1 * (u0 * (g - e) + u1 * (h - f))
    slopes[2] += v0 * (u0 * (e - a) + u1 * (f - b)) + v1 * (u0 * (g - c) + u1 * (h - d))


@_compile
@no_type_check
def point_gradient(  # noqa: PLR0913 - compiled code takes plain arrays
    points, salt, table, scales, features, first, last, upstream, out
):
    """Write d loss / d points first to last into `out` [n * 3]."""
    levels, width = len(scales), np.uint64(len(features))
    size = len(table) // (levels * len(features))
    place, bits = np.empty(3 * _TILE, np.float32), np.empty(_TILE, np.uint32)
    entry, weight = np.empty(8 * _TILE, np.uint32), np.empty(8 * _TILE, np.float32)
    pull = np.empty(8, np.float32)
    for start in range(first, last, _TILE):
        count = min(_TILE, last - start)
        _take(points, salt, start, count, place, bits)
        out[3 * start : 3 * (start + count)] = _ZERO
        for level in range(levels):
            scale = scales[level]
            _locate(place, bits, count, scale, np.uint32(size - 1), entry, weight)
            first_value = np.uint64(level * size) * width
            for p in range(count):
                _fetch_ahead(table, first_value, features, entry, count, p)
                row = upstream[((start + p) * levels + level) * len(features) :]
                for corner in range(8):
                    i = first_value + np.uint64(entry[corner * _TILE + p]) * width
                    pull[corner] = _ZERO
                    for k in range(len(features)):
                        pull[corner] += scale * row[k] * table[i + np.uint64(k)]
                slopes = out[3 * (start + p) :]
                x, y, z = place[p], place[_TILE + p], place[2 * _TILE + p]
                _add_slopes(x * scale, y * scale, z * scale, pull, slopes)


@_compile
@no_type_check
def update_touched(  # noqa: PLR0913 - compiled code takes plain arrays
    values, gradient, first_moment, second_moment, is_touched, features, first, last, rates
):
    """Apply Adam to every marked block from first to last; clear its gradient and mark.

    `rates` holds beta1, beta2, step size, 1 / sqrt of the second bias correction and epsilon.
    Moments of values with a gradient of exactly zero are unchanged.
    """
    beta1, beta2, step_size, correction, epsilon = rates
    starts = np.empty(last - first + 1, np.uint64)
    count = 0
    # Without a branch: an unmarked block's start is overwritten by the next.
    for block in range(first, last):
        starts[count] = np.uint64(block) * np.uint64(BLOCK_ENTRIES * len(features))
        count += is_touched[block]
        is_touched[block] = 0
    for j in range(count):
        start, later = starts[j], starts[min(j + _BLOCKS_AHEAD, count - 1)]
        _fetch(values, later)
        _fetch(gradient, later)
        _fetch(first_moment, later)
        _fetch(second_moment, later)
        for k in range(BLOCK_ENTRIES * len(features)):
            i = start + np.uint64(k)
            slope, mean, square = gradient[i], first_moment[i], second_moment[i]
            is_used = slope != _ZERO
            new_mean = beta1 * mean + (_ONE - beta1) * slope
            new_square = beta2 * square + (_ONE - beta2) * slope * slope
            change = step_size * new_mean / (np.sqrt(new_square) * correction + epsilon)
            first_moment[i] = new_mean if is_used else mean
            second_moment[i] = new_square if is_used else square
            values[i] -= change if is_used else _ZERO
            gradient[i] = _ZERO
