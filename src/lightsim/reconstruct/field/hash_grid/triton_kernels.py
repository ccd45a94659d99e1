"""Hash grid on CUDA, in Triton. Import this file only on a machine with a CUDA device.

Gradients of the table are atomic sums, whose order, and hence last bits, varies.
`no_type_check` excludes compiled code from the run-time type checks of the tests.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, no_type_check

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from lightsim.errors import need
from lightsim.reconstruct.field.hash_grid.sparse_gradient import SparseGradient
from lightsim.reconstruct.field.hash_grid.spec import PRIMES, SALT_PRIME

if TYPE_CHECKING:
    from lightsim.reconstruct.field.hash_grid.spec import HashGridSpec

triton: Any = need("triton", extra="cuda")
tl: Any = need("triton.language", extra="cuda")

# Factor of the y cell in the hash, see `spec`.
_PRIME_Y = tl.constexpr(PRIMES[1])
# Factor of the z cell in the hash.
_PRIME_Z = tl.constexpr(PRIMES[2])
_PRIME_SALT = tl.constexpr(SALT_PRIME)
# Number of points that one Triton program processes. Sensitivity of the running time not measured,
# as of `_VALUES`.
_POINTS = 256
# Number of values that one Triton program of the optimiser processes.
_VALUES = 1024


def look_up(
    points: Float32[Tensor, "n 3"],
    table: Float32[Tensor, "e f"],
    salt: Int64[Tensor, "n"] | None,
    spec: HashGridSpec,
) -> Float32[Tensor, "n d"]:
    """Return the features of points; see `grid.hash_encode`."""
    out = points.new_empty((len(points), spec.output_dim))
    if len(points):
        with torch.cuda.device_of(points):
            blocks = (triton.cdiv(len(points), _POINTS), spec.levels)
            _look_up[blocks](*_inputs(points, salt, spec), table, out, **_sizes(spec))
    return out


def scatter(
    points: Float32[Tensor, "n 3"],
    salt: Int64[Tensor, "n"] | None,
    spec: HashGridSpec,
    upstream: Float32[Tensor, "n d"],
    sparse: SparseGradient,
) -> None:
    """Add d loss / d table to `sparse.values`, without marks: a GPU clears whole tables fast."""
    if len(points):
        with torch.cuda.device_of(points):
            blocks = (triton.cdiv(len(points), _POINTS), spec.levels)
            inputs = _inputs(points, salt, spec)
            _scatter[blocks](*inputs, upstream, sparse.values, **_sizes(spec))


def point_gradient(
    points: Float32[Tensor, "n 3"],
    table: Float32[Tensor, "e f"],
    salt: Int64[Tensor, "n"] | None,
    spec: HashGridSpec,
    upstream: Float32[Tensor, "n d"],
) -> Float32[Tensor, "n 3"]:
    """Return d loss / d points, given `upstream` = d loss / d features."""
    out = torch.empty_like(points)
    if len(points):
        with torch.cuda.device_of(points):
            blocks = (triton.cdiv(len(points), _POINTS),)
            inputs = _inputs(points, salt, spec)
            _point_gradient[blocks](*inputs, table, upstream, out, **_sizes(spec))
    return out


def update(
    values: Float32[Tensor, "e f"],
    gradient: Float32[Tensor, "e f"],
    moments: tuple[Float32[Tensor, "e f"], Float32[Tensor, "e f"]],
    rates: tuple[float, float, float, float, float],
) -> None:
    """Apply Adam to values with a gradient, and clear it. `rates` as in `update_touched`."""
    with torch.cuda.device_of(values):
        blocks = (triton.cdiv(values.numel(), _VALUES),)
        _update[blocks](values, gradient, *moments, *rates, values.numel(), BLOCK=_VALUES)


def _inputs(points: Tensor, salt: Tensor | None, spec: HashGridSpec) -> tuple[Any, ...]:
    scales = torch.from_numpy(spec.cells_per_m()).to(points.device)
    bits = points.new_zeros(len(points), dtype=torch.int64) if salt is None else salt.contiguous()
    return points, bits, scales, len(points)


def _sizes(spec: HashGridSpec) -> dict[str, int]:
    return {
        "SIZE": 2**spec.log2_entries,
        "LEVELS": spec.levels,
        "FEATURES": spec.features,
        "PADDED": triton.next_power_of_2(spec.features),
        "BLOCK": _POINTS,
    }


@triton.jit
@no_type_check
def _cell(points, salt, p, is_in, scale):
    """Return the hash factors of the lower corner, and the position inside the cell."""
    x = tl.load(points + 3 * p, mask=is_in, other=0.0) * scale
    y = tl.load(points + 3 * p + 1, mask=is_in, other=0.0) * scale
    z = tl.load(points + 3 * p + 2, mask=is_in, other=0.0) * scale
    low_x, low_y, low_z = tl.floor(x), tl.floor(y), tl.floor(z)
    bits = tl.load(salt + p, mask=is_in, other=0).to(tl.uint32) * _PRIME_SALT
    hash_x = low_x.to(tl.int32).to(tl.uint32)
    hash_y = low_y.to(tl.int32).to(tl.uint32) * _PRIME_Y
    hash_z = low_z.to(tl.int32).to(tl.uint32) * _PRIME_Z
    return hash_x, hash_y, hash_z, bits, x - low_x, y - low_y, z - low_z


@triton.jit
@no_type_check
def _entry(hash_x, hash_y, hash_z, bits, CORNER: tl.constexpr, SIZE: tl.constexpr):
    """Return the entry of a corner in its level; bits 0, 1, 2 of CORNER are x, y, z."""
    if CORNER & 1:
        hash_x += 1
    if CORNER & 2:
        hash_y += _PRIME_Y
    if CORNER & 4:
        hash_z += _PRIME_Z
    return ((hash_x ^ hash_y ^ hash_z ^ bits) & (SIZE - 1)).to(tl.int64)


@triton.jit
@no_type_check
def _side(inside, IS_UPPER: tl.constexpr):
    """Return the weight of the lower or upper corner along one axis."""
    return inside if IS_UPPER else 1.0 - inside


@triton.jit
@no_type_check
def _look_up(  # noqa: PLR0913 - compiled code takes plain arrays
    points,
    salt,
    scales,
    count,
    table,
    out,
    SIZE: tl.constexpr,
    LEVELS: tl.constexpr,
    FEATURES: tl.constexpr,
    PADDED: tl.constexpr,
    BLOCK: tl.constexpr,
):
    level = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    k = tl.arange(0, PADDED)[None, :]
    is_in = p < count
    is_feature = is_in[:, None] & (k < FEATURES)
    x, y, z, bits, u, v, w = _cell(points, salt, p, is_in, tl.load(scales + level))
    total = tl.zeros((BLOCK, PADDED), tl.float32)
    for corner in tl.static_range(8):
        entry = level * SIZE + _entry(x, y, z, bits, corner, SIZE)
        weight = _side(u, corner & 1) * _side(v, corner & 2) * _side(w, corner & 4)
        value = tl.load(table + entry[:, None] * FEATURES + k, mask=is_feature, other=0.0)
        total += weight[:, None] * value
    where = (p[:, None] * LEVELS + level) * FEATURES + k
    tl.store(out + where, total, mask=is_feature)


@triton.jit
@no_type_check
def _scatter(  # noqa: PLR0913 - compiled code takes plain arrays
    points,
    salt,
    scales,
    count,
    upstream,
    gradient,
    SIZE: tl.constexpr,
    LEVELS: tl.constexpr,
    FEATURES: tl.constexpr,
    PADDED: tl.constexpr,
    BLOCK: tl.constexpr,
):
    level = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    k = tl.arange(0, PADDED)[None, :]
    is_in = p < count
    is_feature = is_in[:, None] & (k < FEATURES)
    x, y, z, bits, u, v, w = _cell(points, salt, p, is_in, tl.load(scales + level))
    where = (p[:, None] * LEVELS + level) * FEATURES + k
    fraction = tl.load(upstream + where, mask=is_feature, other=0.0)
    for corner in tl.static_range(8):
        entry = level * SIZE + _entry(x, y, z, bits, corner, SIZE)
        weight = _side(u, corner & 1) * _side(v, corner & 2) * _side(w, corner & 4)
        target = gradient + entry[:, None] * FEATURES + k
        tl.atomic_add(target, weight[:, None] * fraction, mask=is_feature, sem="relaxed")


@triton.jit
@no_type_check
def _point_gradient(  # noqa: PLR0913 - compiled code takes plain arrays
    points,
    salt,
    scales,
    count,
    table,
    upstream,
    out,
    SIZE: tl.constexpr,
    LEVELS: tl.constexpr,
    FEATURES: tl.constexpr,
    PADDED: tl.constexpr,
    BLOCK: tl.constexpr,
):
    p = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    k = tl.arange(0, PADDED)[None, :]
    is_in = p < count
    is_feature = is_in[:, None] & (k < FEATURES)
    along_x = tl.zeros((BLOCK,), tl.float32)
    along_y = tl.zeros((BLOCK,), tl.float32)
    along_z = tl.zeros((BLOCK,), tl.float32)
    for level in range(LEVELS):
        scale = tl.load(scales + level)
        x, y, z, bits, u, v, w = _cell(points, salt, p, is_in, scale)
        where = (p[:, None] * LEVELS + level) * FEATURES + k
        fraction = tl.load(upstream + where, mask=is_feature, other=0.0) * scale
        first_entry = tl.cast(level, tl.int64) * SIZE
        for corner in tl.static_range(8):
            entry = first_entry + _entry(x, y, z, bits, corner, SIZE)
            value = tl.load(table + entry[:, None] * FEATURES + k, mask=is_feature, other=0.0)
            pull = tl.sum(fraction * value, axis=1)
            a, b, c = _side(u, corner & 1), _side(v, corner & 2), _side(w, corner & 4)
            along_x += pull * b * c * (1.0 if corner & 1 else -1.0)
            along_y += pull * a * c * (1.0 if corner & 2 else -1.0)
            along_z += pull * a * b * (1.0 if corner & 4 else -1.0)
    tl.store(out + 3 * p, along_x, mask=is_in)
    tl.store(out + 3 * p + 1, along_y, mask=is_in)
    tl.store(out + 3 * p + 2, along_z, mask=is_in)


@triton.jit
@no_type_check
def _update(  # noqa: PLR0913 - compiled code takes plain arrays
    values,
    gradient,
    first_moment,
    second_moment,
    beta1,
    beta2,
    step_size,
    correction,
    epsilon,
    count,
    BLOCK: tl.constexpr,
):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    slope = tl.load(gradient + i, mask=i < count, other=0.0)
    is_used = slope != 0.0
    mean = tl.load(first_moment + i, mask=is_used, other=0.0)
    square = tl.load(second_moment + i, mask=is_used, other=0.0)
    mean = beta1 * mean + (1.0 - beta1) * slope
    square = beta2 * square + (1.0 - beta2) * slope * slope
    value = tl.load(values + i, mask=is_used, other=0.0)
    change = step_size * mean / (tl.sqrt(square) * correction + epsilon)
    tl.store(values + i, value - change, mask=is_used)
    tl.store(first_moment + i, mean, mask=is_used)
    tl.store(second_moment + i, square, mask=is_used)
    tl.store(gradient + i, tl.zeros_like(slope), mask=is_used)
