"""The network of `--method paper`: RelitNet as LightSim (NeurIPS 2023) describes it.

Eq. RelitNet and appendix, "Neural deferred rendering architecture": a U-Net with image encoder,
lighting encoder, latent fuser and rendering decoder. Seven inputs of three channels each: source
picture, ambient occlusion, normal, depth, position, and both shadow ratios; source and target dome
give latents that are joined with the picture's. Sizes are not published; ours are small enough for
a CPU. A linear layer needs a picture of one size: here it looks at means over 4 x 8 parts.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lightsim.relighting.network.blocks import Residual, Rise, padded
from lightsim.relighting.network.features import Batch, Unseen, without

_INPUTS = 21
_PARTS = (4, 8)
_FAR_M = 200.0
_DARK = 0.02


@dataclass(frozen=True)
class PaperNetConfig:
    """Size of the network."""

    widths: tuple[int, ...] = (32, 64, 96, 128, 128)
    """Channels of the image encoder at full size, a half, a quarter, ..."""
    latent: int = 256
    """Of the picture."""
    sky_latent: int = 64
    """Of each dome."""
    unseen: tuple[Unseen, ...] = ()
    """What ablations leave out."""


class PaperNet(nn.Module):
    """Picture, buffers, shadow ratios and domes -> the picture under the target sky."""

    def __init__(self, config: PaperNetConfig) -> None:
        super().__init__()
        self.config = config
        widths = config.widths
        self.stem = nn.Sequential(nn.Conv2d(_INPUTS, widths[0], 3, padding=1), Residual(widths[0]))
        self.down = nn.ModuleList(
            nn.Sequential(nn.Conv2d(a, b, 3, 2, 1), Residual(b))
            for a, b in itertools.pairwise(widths)
        )
        self.lighting = nn.Sequential(
            nn.Conv2d(3, 16, 3, 2, 1),
            nn.SiLU(),
            nn.Conv2d(16, 32, 3, 2, 1),
            nn.SiLU(),
            nn.Conv2d(32, 32, 3, 2, 1),
            nn.SiLU(),
            nn.Flatten(),
            nn.Linear(32 * 4 * 8, config.sky_latent),
        )
        cells = _PARTS[0] * _PARTS[1]
        self.squeeze = nn.Conv2d(widths[-1], 32, 3, padding=1)
        self.compress = nn.Linear(32 * cells, config.latent)
        self.spread = nn.Linear(config.latent + 2 * config.sky_latent, widths[-1] * cells)
        self.up = nn.ModuleList(Rise(b, a) for a, b in reversed(list(itertools.pairwise(widths))))
        self.head = nn.Conv2d(widths[0], 3, 3, padding=1)

    def forward(self, batch: Batch) -> Float[Tensor, "n 3 h w"]:
        """sRGB in [0, 1]."""
        x, size = padded(
            _inputs(without(batch, self.config.unseen)), 2 ** (len(self.config.widths) - 1)
        )
        x = self.stem(x)
        levels = [x]
        for step in self.down:
            levels.append(step(levels[-1]))
        x = levels.pop()
        x = x + self._fused(x, batch)
        for step in self.up:
            x = step(x, levels.pop())
        return torch.sigmoid(self.head(x))[..., : size[0], : size[1]]

    def _fused(self, x: Tensor, batch: Batch) -> Tensor:
        """The picture's latent and those of both skies, brought back to the size of `x`."""
        image = self.compress(functional.adaptive_avg_pool2d(self.squeeze(x), _PARTS).flatten(1))
        skies = [self.lighting(_coded_dome(batch[f"{w}_dome"])) for w in ("source", "target")]
        fused = self.spread(torch.cat([image, *skies], dim=1))
        fused = functional.silu(fused).unflatten(1, (-1, *_PARTS))
        return functional.interpolate(fused, x.shape[-2:], mode="bilinear")


def _inputs(batch: Batch) -> Float[Tensor, "n 21 h w"]:
    depth = torch.log1p(batch["depth"]) / math.log1p(_FAR_M)
    return torch.cat(
        [
            batch["source"],
            batch["openness"].expand(-1, 3, -1, -1),
            batch["normal"],
            depth.expand(-1, 3, -1, -1),
            batch["position"] / _FAR_M,
            batch["source_ratio"],
            batch["target_ratio"],
        ],
        dim=1,
    )


def _coded_dome(dome: Float[Tensor, "n 3 r c"]) -> Float[Tensor, "n 3 r c"]:
    return torch.log1p(dome.clamp_min(0.0) / _DARK) / math.log1p(1 / _DARK)
