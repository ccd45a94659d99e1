"""Hash grid on the CPU: compiled loops over the memory of torch tensors, on several threads."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float32, Int64, UInt32
from torch import Tensor

from lightsim.core.threads import for_each, for_ranges
from lightsim.reconstruct.field.hash_grid import kernels
from lightsim.reconstruct.field.hash_grid.sparse_gradient import SparseGradient

if TYPE_CHECKING:
    from lightsim.reconstruct.field.hash_grid.spec import HashGridSpec

# Least number of points of a thread's task: smaller tasks cost more than they save.
_SMALLEST_PART = 1024


def look_up(
    points: Float32[Tensor, "n 3"],
    table: Float32[Tensor, "e f"],
    salt: Int64[Tensor, "n"] | None,
    spec: HashGridSpec,
) -> Float32[Tensor, "n d"]:
    """Return the features of points; see `grid.hash_encode`."""
    out = torch.empty((len(points), spec.output_dim))
    arrays = _flat(points), _salt_bits(salt, len(points)), _flat(table)
    scales, features, target = spec.cells_per_m(), (0,) * spec.features, _flat(out)

    def part(first: int, last: int) -> None:
        kernels.look_up(*arrays, scales, features, first, last, target)

    for_ranges(part, len(points), torch.get_num_threads(), smallest=_SMALLEST_PART)
    return out


def point_gradient(
    points: Float32[Tensor, "n 3"],
    table: Float32[Tensor, "e f"],
    salt: Int64[Tensor, "n"] | None,
    spec: HashGridSpec,
    upstream: Float32[Tensor, "n d"],
) -> Float32[Tensor, "n 3"]:
    """Return d loss / d points, given `upstream` = d loss / d features."""
    out = torch.empty((len(points), 3))
    arrays = _flat(points), _salt_bits(salt, len(points)), _flat(table)
    scales, features = spec.cells_per_m(), (0,) * spec.features
    source, target = _flat(upstream), _flat(out)

    def part(first: int, last: int) -> None:
        kernels.point_gradient(*arrays, scales, features, first, last, source, target)

    for_ranges(part, len(points), torch.get_num_threads(), smallest=_SMALLEST_PART)
    return out


def scatter(
    points: Float32[Tensor, "n 3"],
    salt: Int64[Tensor, "n"] | None,
    spec: HashGridSpec,
    upstream: Float32[Tensor, "n d"],
    sparse: SparseGradient,
) -> None:
    """Add d loss / d table to `sparse`. One thread per level makes the sum deterministic."""
    arrays = _flat(points), _salt_bits(salt, len(points)), spec.cells_per_m()
    features, source = (0,) * spec.features, _flat(upstream)
    values, is_touched = _flat(sparse.values), sparse.is_touched.numpy()

    def part(level: int) -> None:
        kernels.scatter(*arrays, features, level, source, values, is_touched)

    # The finest level takes longest and starts first, so that no thread waits for it at the end.
    levels = [(level,) for level in reversed(range(spec.levels))]
    for_each(part, levels, torch.get_num_threads())


def _flat(tensor: Float32[Tensor, "n k"]) -> Float32[np.ndarray, "nk"]:
    """Flat NumPy view of the tensor's memory."""
    return tensor.detach().numpy().reshape(-1)


def _salt_bits(salt: Int64[Tensor, "n"] | None, count: int) -> UInt32[np.ndarray, "n"]:
    if salt is None:
        return np.zeros(count, np.uint32)
    return salt.numpy().astype(np.uint32) * kernels.PRIME_SALT
