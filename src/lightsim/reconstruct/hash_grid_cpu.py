"""The hash grid on the CPU: compiled loops over the memory of torch tensors, on several threads."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float32, Int64, UInt32
from torch import Tensor

from lightsim.reconstruct import hash_grid_kernels as kernels
from lightsim.reconstruct.hash_grid_threads import for_each, for_ranges, thread_count
from lightsim.reconstruct.sparse_adam import SparseGradient

if TYPE_CHECKING:
    from lightsim.reconstruct.hash_grid import HashGridSpec

_SMALLEST_PART = 1024
_SALT_PRIME = np.uint32(3674653429)


def look_up(
    points: Float32[Tensor, "n 3"],
    table: Float32[Tensor, "e f"],
    salt: Int64[Tensor, "n"] | None,
    spec: HashGridSpec,
) -> Float32[Tensor, "n d"]:
    """Features of points; see `hash_grid.hash_encode`."""
    out = torch.empty((len(points), spec.output_dim))
    arrays = points.detach().numpy(), _salt_bits(salt, len(points)), table.detach().numpy()
    scales, features, target = spec.cells_per_m(), (0,) * spec.features, out.numpy()

    def part(first: int, last: int) -> None:
        kernels.look_up(*arrays, scales, features, first, last, target)

    for_ranges(part, len(points), smallest=_SMALLEST_PART)
    return out


def point_gradient(
    points: Float32[Tensor, "n 3"],
    table: Float32[Tensor, "e f"],
    salt: Int64[Tensor, "n"] | None,
    spec: HashGridSpec,
    upstream: Float32[Tensor, "n d"],
) -> Float32[Tensor, "n 3"]:
    """d loss / d points, from `upstream` = d loss / d features."""
    out = torch.empty((len(points), 3))
    arrays = points.detach().numpy(), _salt_bits(salt, len(points)), table.detach().numpy()
    scales, features = spec.cells_per_m(), (0,) * spec.features
    source, target = upstream.numpy(), out.numpy()

    def part(first: int, last: int) -> None:
        kernels.point_gradient(*arrays, scales, features, first, last, source, target)

    for_ranges(part, len(points), smallest=_SMALLEST_PART)
    return out


def scatter(
    points: Float32[Tensor, "n 3"],
    salt: Int64[Tensor, "n"] | None,
    spec: HashGridSpec,
    upstream: Float32[Tensor, "n d"],
    sparse: SparseGradient,
) -> None:
    """Add d loss / d table to `sparse`. Each level belongs to one thread: always the same sum."""
    arrays = points.detach().numpy(), _salt_bits(salt, len(points)), spec.cells_per_m()
    features, source = (0,) * spec.features, upstream.numpy()
    values, is_touched = sparse.values.numpy(), sparse.is_touched.numpy()

    def part(of_levels: np.ndarray) -> None:
        kernels.scatter(*arrays, features, of_levels, source, values, is_touched)

    for_each(part, [(group,) for group in _deal(spec.levels, thread_count())])


def _deal(levels: int, hands: int) -> list[np.ndarray]:
    """Levels dealt forth and back to `hands` groups: fine levels cost more than coarse ones."""
    groups: list[list[int]] = [[] for _ in range(min(hands, levels))]
    order = list(range(len(groups)))
    for start in range(0, levels, len(groups)):
        for hand, level in zip(order, range(start, levels), strict=False):
            groups[hand].append(level)
        order.reverse()
    return [np.array(group) for group in groups]


def _salt_bits(salt: Int64[Tensor, "n"] | None, count: int) -> UInt32[np.ndarray, "n"]:
    if salt is None:
        return np.zeros(count, np.uint32)
    return salt.numpy().astype(np.uint32) * _SALT_PRIME
