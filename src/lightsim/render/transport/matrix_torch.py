"""Sums of the light transport matrix in torch, for CUDA.

They have the same values as `kernels.point_light`, which is faster on a CPU.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float32, Int32, UInt16


def has_torch_cuda() -> bool:
    """Return true if torch finds a CUDA device; a torch built for CPUs finds none."""
    import torch

    return torch.cuda.is_available()


class TorchTransport:
    """Rays of n points, stored on a device for any number of skies.

    Every ray is one row number of a table in which environment cells precede faces, so that one
    look-up serves both; 8 bytes a ray.
    """

    def __init__(
        self,
        sky_cells: UInt16[np.ndarray, "n k"],
        face_rows: Int32[np.ndarray, "n k"],
        cell_count: int,
        device: str = "cuda",
    ) -> None:
        import torch

        self._device = torch.device(device)
        self._cell_count = cell_count
        # torch.as_tensor cannot index with uint16.
        self._cells: Any = torch.from_numpy(sky_cells.astype(np.int32)).to(self._device)
        rows: Any = torch.from_numpy(face_rows).to(self._device)
        self._met: Any = torch.where(rows < 0, self._cells, rows + cell_count)

    def point_light(
        self, sky: Float32[np.ndarray, "c 3"], radiosity: Float32[np.ndarray, "f 3"]
    ) -> Float32[np.ndarray, "n 9"]:
        """Return means over each point's rays: columns 0-2 open sky, 3-5 hit faces, 6-8 all sky."""
        import torch
        from torch.nn.functional import embedding_bag

        cells = torch.from_numpy(sky).to(self._device)
        table = torch.zeros((self._cell_count + len(radiosity), 6), device=self._device)
        table[: self._cell_count, :3] = cells
        table[self._cell_count :, 3:] = torch.from_numpy(radiosity).to(self._device)
        # No training: gradients would only cost memory.
        with torch.no_grad():
            met = embedding_bag(self._met, table, mode="mean")
            whole = embedding_bag(self._cells, cells, mode="mean")
            return torch.cat([met, whole], dim=1).cpu().numpy()
