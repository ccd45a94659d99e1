"""Layers of the relighting networks."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

# Channels of a group in group normalisation; a common choice, sensitivity not measured.
_GROUP = 8


class Residual(nn.Module):
    """Residual block x + conv(act(norm(conv(act(norm(x)))))) (arXiv:1603.05027)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.GroupNorm(max(1, width // _GROUP), width),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, padding=1),
            nn.GroupNorm(max(1, width // _GROUP), width),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, padding=1),
        )

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)


class UpBlock(nn.Module):
    """Upsample features by 2 and concatenate the encoder's features of that size."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.narrow = nn.Conv2d(inputs, outputs, 1)
        self.join = nn.Conv2d(2 * outputs, outputs, 1)
        self.block = Residual(outputs)

    def forward(self, x: Tensor, known: Tensor) -> Tensor:
        x = functional.interpolate(self.narrow(x), scale_factor=2, mode="bilinear")
        return self.block(self.join(torch.cat([x, known], dim=1)))


def padded(x: Tensor, multiple: int) -> tuple[Tensor, tuple[int, int]]:
    """Pad rows and columns at the end to a multiple by repeating the border; also return the
    original size."""
    height, width = x.shape[-2:]
    below, right = -height % multiple, -width % multiple
    return functional.pad(x, (0, right, 0, below), mode="replicate"), (height, width)
