"""Adam for hash tables: only entries that a batch reaches are read, updated and cleared."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lightsim.core.threads import for_ranges
from lightsim.errors import InputError
from lightsim.reconstruct.field.hash_grid import kernels
from lightsim.reconstruct.field.hash_grid.sparse_gradient import (
    SPARSE_GRADIENT,
    new_sparse_gradient,
    zeros_on,
)


class SparseAdam:
    """Adam that does not change values without a gradient, nor their moments.

    If every value has a gradient, it equals `torch.optim.Adam` (Kingma & Ba 2015, arXiv:1412.6980,
    algorithm 1). Afterwards compiled `hash_encode` calls on `table` add to a sparse gradient
    instead of `table.grad`, which only the plain torch implementation writes. `step` uses the sum
    of both and clears both.

    Args:
        table: [entries, features] float32; entries a multiple of `BLOCK_ENTRIES`.
        learning_rate: step size; later in `param_groups[0]["lr"]`, as in torch's optimisers.
        betas: decay of the first and second moment.
        eps: added to the root of the second moment.

    Raises:
        InputError: the table has the wrong type or size.
    """

    def __init__(
        self,
        table: torch.nn.Parameter,
        *,
        learning_rate: float,
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-15,
    ) -> None:
        _check_table(table)
        self.table = table
        self.param_groups: list[dict[str, Any]] = [{"params": [table], "lr": learning_rate}]
        self.betas = betas
        self.eps = eps
        self.steps = 0
        self.first_moment = zeros_on(table.device, tuple(table.shape))
        self.second_moment = zeros_on(table.device, tuple(table.shape))
        self.gradient = new_sparse_gradient(table)
        setattr(table, SPARSE_GRADIENT, self.gradient)

    @torch.no_grad()
    def step(self) -> None:
        """Update the table by its gradient, then clear the gradient."""
        rate = self.param_groups[0]["lr"]
        self.steps += 1
        beta1, beta2 = self.betas
        step_size = rate / (1.0 - beta1**self.steps)
        correction = 1.0 / math.sqrt(1.0 - beta2**self.steps)
        rates = beta1, beta2, step_size, correction, self.eps
        if self.table.grad is not None:
            self.gradient.values.add_(self.table.grad)
            self.gradient.is_touched.fill_(1)
            self.table.grad = None
        if self.table.is_cuda:
            from lightsim.reconstruct.field.hash_grid import triton_kernels

            moments = self.first_moment, self.second_moment
            triton_kernels.update(self.table, self.gradient.values, moments, rates)
        else:
            self._step_blocks(rates)

    def zero_grad(self) -> None:
        """Clear the gradient."""
        self.table.grad = None
        self.gradient.values.zero_()
        self.gradient.is_touched.zero_()

    def state_dict(self) -> dict[str, Any]:
        """Return the optimiser's state for a resumed training, without the table and gradients."""
        return {
            "steps": self.steps,
            "learning_rate": self.param_groups[0]["lr"],
            "first_moment": self.first_moment,
            "second_moment": self.second_moment,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from `state_dict`.

        Raises:
            InputError: the state belongs to a table of another shape.
        """
        shape = tuple(state_dict["first_moment"].shape)
        if shape != tuple(self.table.shape):
            raise InputError(
                "the optimiser state does not fit the table",
                got=shape,
                expected=tuple(self.table.shape),
                remedy="Resume with the hash grid settings of the checkpoint.",
            )
        self.steps = int(state_dict["steps"])
        self.param_groups[0]["lr"] = float(state_dict["learning_rate"])
        self.first_moment.copy_(state_dict["first_moment"])
        self.second_moment.copy_(state_dict["second_moment"])
        self.zero_grad()

    def _step_blocks(self, rates: tuple[float, float, float, float, float]) -> None:
        tensors = self.table, self.gradient.values, self.first_moment, self.second_moment
        arrays = [tensor.detach().numpy().reshape(-1) for tensor in tensors]
        features = (0,) * self.table.shape[1]
        marks = self.gradient.is_touched.numpy()
        single = tuple(np.float32(rate) for rate in rates)

        def update(first: int, last: int) -> None:
            kernels.update_touched(*arrays, marks, features, first, last, single)

        for_ranges(update, marks.size, torch.get_num_threads(), smallest=4096)


def _check_table(table: Tensor) -> None:
    is_whole = table.ndim == 2 and table.shape[0] % kernels.BLOCK_ENTRIES == 0
    if table.dtype != torch.float32 or not is_whole or not table.is_contiguous():
        raise InputError(
            "the hash table cannot be optimised",
            got=f"{table.dtype} {tuple(table.shape)}",
            expected=f"contiguous float32 [n * {kernels.BLOCK_ENTRIES}, features]",
            remedy="Make it with make_table.",
        )
