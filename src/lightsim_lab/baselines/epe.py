"""Network of `--method epe`: photorealism enhancement of the twin's rendering under the target sky.

Re-implementation of Richter et al. 2021, Enhancing Photorealism Enhancement (arXiv:2105.04619), as
LightSim uses it (appendix). Inputs are rendering and G-buffers, never the recorded picture.
Encoded G-buffers scale and shift normalised features (rendering-aware denormalisation). Training
adds a patch discriminator. Differences from the original: docs/models/baselines.md.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.parametrizations import spectral_norm

from lightsim.relighting.network.blocks import UpBlock, padded
from lightsim.relighting.network.features import Batch, grey, log_coded, rendered, srgb_of
from lightsim_lab.baselines.unet import zero_head

# Planes of `_g_buffers`.
_BUFFERS = 19
# Unit of positions and distances in the input, in metres: LiDAR of road vehicles reaches as far.
_FAR_M = 200.0


@dataclass(frozen=True)
class EpeConfig:
    """Size of the network."""

    widths: tuple[int, ...] = (32, 64, 96, 128)
    """Channels at 1/2, 1/4, ... of the picture's size."""
    buffer_width: int = 24
    """Channels of the encoded G-buffers."""


class EpeNet(nn.Module):
    """Residual U-Net on rendering and G-buffers; untrained, it returns the rendering."""

    def __init__(self, config: EpeConfig) -> None:
        super().__init__()
        self.config = config
        widths, own = config.widths, config.buffer_width
        self.stem = nn.Sequential(nn.PixelUnshuffle(2), nn.Conv2d(12, widths[0], 1))
        self.encode = nn.Sequential(
            nn.PixelUnshuffle(2), nn.Conv2d(4 * _BUFFERS, own, 1), nn.SiLU()
        )
        self.encode_down = nn.ModuleList(
            nn.Sequential(nn.Conv2d(own, own, 3, 2, 1), nn.SiLU()) for _ in widths[1:]
        )
        self.blocks = nn.ModuleList(_Modulated(width, own) for width in widths)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, 2, 1) for a, b in itertools.pairwise(widths))
        self.up = nn.ModuleList(
            UpBlock(b, a) for a, b in reversed(list(itertools.pairwise(widths)))
        )
        self.head = zero_head(widths[0], 3)

    def forward(self, batch: Batch) -> Float[Tensor, "n 3 h w"]:
        """Return sRGB values, not clipped."""
        # The network corrects a displayable picture, so highlights are clipped first.
        picture = srgb_of(rendered(batch, "target")).clamp_max(1.0)
        multiple = 2 ** len(self.config.widths)
        x, size = padded(picture, multiple)
        x = self.stem(x)
        g = self.encode(padded(_g_buffers(batch), multiple)[0])
        # G-buffers are encoded once per level, and modulate the features of the same level.
        levels = [self.blocks[0](x, g)]
        steps = zip(self.down, self.encode_down, list(self.blocks)[1:], strict=True)
        for down, encode_down, block in steps:
            g = encode_down(g)
            levels.append(block(down(levels[-1]), g))
        x = levels.pop()
        for step in self.up:
            x = step(x, levels.pop())
        return picture + self.head(x)[..., : size[0], : size[1]].float()


class _Modulated(nn.Module):
    """Residual block whose normalised features are scaled and shifted by encoded G-buffers."""

    def __init__(self, width: int, buffer_width: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.GroupNorm(width // 8, width, affine=False) for _ in range(2))
        self.scales = nn.ModuleList(nn.Conv2d(buffer_width, 2 * width, 1) for _ in range(2))
        self.layers = nn.ModuleList(nn.Conv2d(width, width, 3, padding=1) for _ in range(2))

    def forward(self, x: Tensor, g: Tensor) -> Tensor:
        y = x
        for norm, scale, layer in zip(self.norms, self.scales, self.layers, strict=True):
            factor, shift = scale(g).chunk(2, dim=1)
            y = layer(functional.silu(norm(y) * (1 + factor) + shift))
        return x + y


class PatchDiscriminator(nn.Module):
    """Scores of overlapping patches of sRGB pictures, high for true pictures (Isola et al. 2017,
    arXiv:1611.07004; spectral norms, arXiv:1802.05957)."""

    def __init__(self, widths: tuple[int, ...] = (32, 64, 128)) -> None:
        super().__init__()
        steps = itertools.pairwise((3, *widths))
        self.layers = nn.ModuleList(spectral_norm(nn.Conv2d(a, b, 4, 2, 1)) for a, b in steps)
        self.last = spectral_norm(nn.Conv2d(widths[-1], 1, 3, padding=1))

    def forward(self, picture: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 1 p q"]:
        """Return unbounded scores."""
        # Discriminators are trained on values in [-1, 1].
        x = 2 * picture - 1
        for layer in self.layers:
            x = functional.leaky_relu(layer(x), 0.2)
        return self.last(x)


def _g_buffers(batch: Batch) -> Float[Tensor, "n 19 h w"]:
    """Return geometry, material and light of the twin, each scaled to a few units around 0."""
    return torch.cat(
        [
            batch["surface"],
            batch["actor"],
            torch.log1p(batch["depth"]) / math.log1p(_FAR_M),
            batch["position"] / _FAR_M,
            batch["normal"],
            batch["openness"],
            batch["base_colour"].clamp_min(0.0).sqrt(),
            log_coded(batch["target_shaded"]),
            batch["target_sun"],
            grey(batch["target_ratio"]),
            log_coded(grey(batch["target_reflected"])),
        ],
        dim=1,
    )
