"""Sparse gradient of a hash table: only the blocks that a batch touched are visited."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from lightsim.reconstruct.field.hash_grid import kernels

SPARSE_GRADIENT = "lightsim_sparse_gradient"


@dataclass(frozen=True)
class SparseGradient:
    """Sum of the gradients of a table since the last step, with marks of the touched blocks.

    A dense `table.grad` requires a full write and read in every step. Instead, the backward pass
    adds to `values` and marks the written blocks, and the step visits marked blocks only.
    """

    values: Float32[Tensor, "entries features"]
    is_touched: UInt8[Tensor, "blocks"]
    """One mark for every `kernels.BLOCK_ENTRIES` entries."""


def new_sparse_gradient(table: Tensor) -> SparseGradient:
    """Return a zero gradient on the table's device."""
    blocks = table.shape[0] // kernels.BLOCK_ENTRIES
    marks = torch.zeros(blocks, dtype=torch.uint8, device=table.device)
    return SparseGradient(zeros_on(table.device, tuple(table.shape)), marks)


def sparse_gradient_of(table: Tensor) -> SparseGradient | None:
    """Return the sparse gradient that an optimiser attached to `table`, or None."""
    return getattr(table, SPARSE_GRADIENT, None)


def zeros_on(device: torch.device | str, shape: tuple[int, ...]) -> Tensor:
    """Return zeros, float32; on the CPU in NumPy memory, which uses huge pages.

    Random access to a hundred megabytes is otherwise limited by address translation.
    """
    if torch.device(device).type != "cpu":
        return torch.zeros(shape, device=device)
    # `np.empty` requests huge pages for large arrays; `np.zeros` may not.
    zeros = np.empty(shape, np.float32)
    zeros.fill(0.0)
    return torch.from_numpy(zeros)
