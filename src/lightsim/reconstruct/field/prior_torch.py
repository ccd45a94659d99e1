"""Look-up of the prior in plain torch: the readable version, which also runs on CUDA."""

from __future__ import annotations

from itertools import product

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lightsim.core.fields import BLOCK


class TorchPrior:
    """`TsdfPrior.stack` on a device, with `TsdfPrior.look_up` for tensors."""

    def __init__(self, stack: tuple[np.ndarray, ...], device: torch.device) -> None:
        moved = [torch.from_numpy(array).to(device) for array in stack]
        self._table, self._start, self._low, self._shape = (a.to(torch.int64) for a in moved[:4])
        self._geometry = moved[4].to(torch.float32)
        self._corners = torch.tensor(list(product((0, 1), repeat=3)), device=device)
        self._sdf, self._weight = moved[5].reshape(-1), moved[6].reshape(-1)

    def look_up(
        self, points: Float[Tensor, "n 3"], ranges: Int[Tensor, "n 2"]
    ) -> Float[Tensor, "n 3"]:
        """Return signed distance [m], weight and truncation [m]; see `TsdfPrior.look_up`."""
        found = points.new_zeros((len(points), 3))
        rounds = int((ranges[:, 1] - ranges[:, 0]).max()) if len(points) else 0
        for level in range(rounds):
            rows = torch.nonzero((found[:, 1] <= 0) & (ranges[:, 0] + level < ranges[:, 1]))[:, 0]
            if len(rows) == 0:
                break
            grid = ranges[rows, 0].to(torch.int64) + level
            value, weight = self._interpolated(points[rows], grid)
            answer = torch.stack([value, weight, self._geometry[grid, 4]], dim=1)
            found[rows] = torch.where(weight[:, None] > 0, answer, torch.zeros_like(answer))
        return found

    def _interpolated(
        self, points: Float[Tensor, "m 3"], grid: Int[Tensor, " m"]
    ) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"]]:
        """Trilinear mean over the known corners, if they have half of the total weight."""
        geometry = self._geometry[grid]
        scaled = (points - geometry[:, :3]) / geometry[:, 3:4]
        cell = torch.floor(scaled)
        inner = scaled - cell
        cell = cell.to(torch.int64)
        # All eight corners at once: on a GPU the number of kernels determines the time.
        at_corner = self._corners[:, None]
        fraction = torch.where(at_corner.bool(), inner, 1 - inner).prod(dim=2)
        at = self._sample(cell + at_corner, grid)
        weight = torch.where(at >= 0, self._weight[at.clamp(min=0)], 0.0)
        fraction = torch.where(weight > 0, fraction, 0.0)
        value = (fraction * self._sdf[at.clamp(min=0)]).sum(dim=0)
        evidence, total = (fraction * weight).sum(dim=0), fraction.sum(dim=0)
        is_known = total >= 0.5
        value = torch.where(is_known, value / total.clamp(min=0.5), 0.0)
        return value, torch.where(is_known, evidence, 0.0)

    def _sample(self, index: Int[Tensor, "k m 3"], grid: Int[Tensor, " m"]) -> Int[Tensor, "k m"]:
        """Flat index of a sample in the block arrays, -1 if its block is absent."""
        block = torch.div(index, BLOCK, rounding_mode="floor") - self._low[grid]
        shape = self._shape[grid]
        inside = ((block >= 0) & (block < shape)).all(dim=2)
        flat = (block[..., 0] * shape[:, 1] + block[..., 1]) * shape[:, 2] + block[..., 2]
        row = self._table[torch.where(inside, self._start[grid] + flat, 0)]
        local = torch.remainder(index, BLOCK)
        inner = (local[..., 0] * BLOCK + local[..., 1]) * BLOCK + local[..., 2]
        return torch.where(inside & (row >= 0), row * BLOCK**3 + inner, -1)
