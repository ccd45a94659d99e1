"""U-Net of the baselines, whose finest features have half of the picture's resolution."""

from __future__ import annotations

import itertools

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lightsim.relighting.network.blocks import Residual, UpBlock, padded


class UNet(nn.Module):
    """U-Net (Ronneberger et al. 2015, arXiv:1505.04597) with output 0 before training.

    Args:
        widths: channels at 1/2, 1/4, ... of the picture's size.
    """

    def __init__(self, inputs: int, outputs: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.PixelUnshuffle(2), nn.Conv2d(4 * inputs, widths[0], 1), Residual(widths[0])
        )
        self.down = nn.ModuleList(
            nn.Sequential(nn.Conv2d(a, b, 3, 2, 1), Residual(b))
            for a, b in itertools.pairwise(widths)
        )
        self.up = nn.ModuleList(
            UpBlock(b, a) for a, b in reversed(list(itertools.pairwise(widths)))
        )
        self.head = zero_head(widths[0], outputs)

    def forward(self, x: Float[Tensor, "n i h w"]) -> Float[Tensor, "n o h w"]:
        """Return unbounded planes."""
        x, size = padded(x, 2 ** (len(self.down) + 1))
        levels = [self.stem(x)]
        for step in self.down:
            levels.append(step(levels[-1]))
        x = levels.pop()
        for step in self.up:
            x = step(x, levels.pop())
        return self.head(x)[..., : size[0], : size[1]]


def zero_head(width: int, outputs: int) -> nn.Sequential:
    """Return the last layer, from features at half size to planes at full size; initially 0."""
    last = nn.Conv2d(width, 4 * outputs, 3, padding=1)
    # With zero weights the initial output is defined by the caller: a residual or a bias.
    with torch.no_grad():
        last.weight.zero_()
        if last.bias is not None:
            last.bias.zero_()
    return nn.Sequential(last, nn.PixelShuffle(2))
