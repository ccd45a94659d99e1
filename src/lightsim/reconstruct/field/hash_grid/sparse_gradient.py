"""The gradient of a hash table, kept beside it: only what a batch touched is ever visited."""

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
    """Sum of the gradients of a table since the last step, beside the table itself.

    A dense `table.grad` would have to be written and read in full at every step. Here the backward
    pass adds to `values` and marks the blocks it wrote; the step visits marked blocks only.
    """

    values: Float32[Tensor, "entries features"]
    is_touched: UInt8[Tensor, "blocks"]
    """One mark for every `hash_grid_kernels.BLOCK_ENTRIES` entries."""


def new_sparse_gradient(table: Tensor) -> SparseGradient:
    """No gradient yet, on the table's device."""
    blocks = table.shape[0] // kernels.BLOCK_ENTRIES
    marks = torch.zeros(blocks, dtype=torch.uint8, device=table.device)
    return SparseGradient(zeros_on(table.device, tuple(table.shape)), marks)


def sparse_gradient_of(table: Tensor) -> SparseGradient | None:
    """The sparse gradient that an optimiser attached to `table`, if any."""
    return getattr(table, SPARSE_GRADIENT, None)


def zeros_on(device: torch.device | str, shape: tuple[int, ...]) -> Tensor:
    """Zeros, float32; on the CPU in memory that NumPy asks huge pages for.

    Random access to a hundred megabytes otherwise waits for address translation.
    """
    if torch.device(device).type != "cpu":
        return torch.zeros(shape, device=device)
    zeros = np.empty(shape, np.float32)
    zeros.fill(0.0)
    return torch.from_numpy(zeros)
