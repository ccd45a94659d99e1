"""The network of `--method paper`: RelitNet as LightSim (NeurIPS 2023) describes it.

Eq. RelitNet and appendix, "Neural deferred rendering architecture": a U-Net with image encoder,
lighting encoder, latent fuser and rendering decoder. It has seven inputs of three channels each:
source picture, ambient occlusion, normal, depth, position, and both shadow ratios. Latents of
source and target dome are joined with the picture's. Sizes are not published; those here are small
enough for a CPU. A linear layer requires a fixed size, so the latent is computed from means over 4
x 8 parts of the picture.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lightsim.relighting.network.blocks import Residual, UpBlock, padded
from lightsim.relighting.network.features import FAR_M, Batch, RemovedInput, log_coded, without

# Rows and columns of parts over which features are averaged before the linear layers; not
# published, sensitivity not measured.
_PARTS = (4, 8)


@dataclass(frozen=True)
class PaperNetConfig:
    """Size of the network."""

    widths: tuple[int, ...] = (32, 64, 96, 128, 128)
    """Channels of the image encoder at full size, a half, a quarter, ..."""
    latent: int = 256
    """Length of the picture's latent."""
    sky_latent: int = 64
    """Length of each dome's latent."""
    unseen: tuple[RemovedInput, ...] = ()
    """Inputs that ablations remove."""
    tile_px: int = 96
    """Rows and columns of the pictures in training. Larger pictures are predicted in tiles of this
    size, so that the latent represents as large an area as in training."""


class PaperNet(nn.Module):
    """Network from picture, buffers, shadow ratios and domes to the picture under the target
    sky."""

    def __init__(self, config: PaperNetConfig) -> None:
        super().__init__()
        self.config = config
        widths = config.widths
        self.stem = nn.Sequential(nn.Conv2d(7 * 3, widths[0], 3, padding=1), Residual(widths[0]))
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
        self.up = nn.ModuleList(
            UpBlock(b, a) for a, b in reversed(list(itertools.pairwise(widths)))
        )
        self.head = nn.Conv2d(widths[0], 3, 3, padding=1)

    def forward(self, batch: Batch) -> Float[Tensor, "n 3 h w"]:
        """Return the relit picture, sRGB in [0, 1]."""
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
        """Fuse the latents of the picture and of both skies, and enlarge them to the size of
        `x`."""
        image = self.compress(functional.adaptive_avg_pool2d(self.squeeze(x), _PARTS).flatten(1))
        skies = [self.lighting(log_coded(batch[f"{w}_dome"])) for w in ("source", "target")]
        fused = self.spread(torch.cat([image, *skies], dim=1))
        fused = functional.silu(fused).unflatten(1, (-1, *_PARTS))
        return functional.interpolate(fused, x.shape[-2:], mode="bilinear")


def _inputs(batch: Batch) -> Float[Tensor, "n 21 h w"]:
    depth = torch.log1p(batch["depth"]) / math.log1p(FAR_M)
    return torch.cat(
        [
            batch["source"],
            batch["openness"].expand(-1, 3, -1, -1),
            batch["normal"],
            depth.expand(-1, 3, -1, -1),
            batch["position"] / FAR_M,
            batch["source_ratio"],
            batch["target_ratio"],
        ],
        dim=1,
    )
