"""The detector: trunk, neck, lift, convolutions on the bird's-eye view, and centre head."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lightsim_lab.detect.config import DetectorConfig
from lightsim_lab.detect.lift import AttentionLift, BilinearLift
from lightsim_lab.detect.targets import HEAT, MAPS
from lightsim_lab.detect.trunk import CHANNELS, Trunk

# Channels per group of the normalisation; statistics of batches of four would be noisy.
_GROUP = 8
# Initial probability of a centre: the logarithm of .1 over .9 (Lin et al. 2017, arXiv:1708.02002).
_PRIOR_LOGIT = -2.19


def _conv(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
        nn.GroupNorm(outputs // _GROUP, outputs),
        nn.ReLU(),
    )


class Detector(nn.Module):
    """Monocular detector of vehicles."""

    def __init__(self, config: DetectorConfig, trunk: Trunk) -> None:
        super().__init__()
        self.config = config
        c = config.channels
        # Only the attention reads the coarse level itself; both have it in the fine level.
        strides = (8,) if config.lift == "bilinear" else (8, 16)
        self.trunk = trunk
        self._lateral = nn.ModuleList(nn.Conv2d(CHANNELS[stride], c, 1) for stride in (8, 16))
        self._smooth = nn.ModuleList(_conv(c, c) for _ in strides)
        self._lift = (
            BilinearLift(config) if config.lift == "bilinear" else AttentionLift(config, strides)
        )
        self._bev = nn.ModuleList(_conv(c, c) for _ in range(config.bev_layers))
        self._head = nn.Sequential(_conv(c, c), nn.Conv2d(c, MAPS, 1))
        last = self._head[1]
        assert isinstance(last, nn.Conv2d)
        assert last.bias is not None
        nn.init.zeros_(last.bias)
        nn.init.constant_(last.bias[HEAT : HEAT + 1], _PRIOR_LOGIT)
        self.trunk.requires_grad_(not config.is_trunk_frozen)

    @torch.no_grad()
    def prepared(self, pictures: Tensor) -> Tensor:
        """Return the network's input for 8-bit pictures [n, 3, h, w]. With a frozen trunk these are
        its features at strides 8 and 16, in half precision and of the size of stride 8; otherwise
        the pictures themselves."""
        if not self.config.is_trunk_frozen:
            return pictures
        fine = self.trunk.fine(pictures)
        coarse = functional.interpolate(self.trunk.coarse(fine), fine.shape[-2:])
        return torch.cat([fine, coarse], 1).half()

    def forward(
        self, inputs: Tensor, projections: Float[Tensor, "n 3 4"]
    ) -> Float[Tensor, "n maps x y"]:
        """Return the maps of the centre head (`targets.encode`).

        Args:
            inputs: result of `prepared`.
            projections: pixels of the network's input from the level frame, homogeneous.
        """
        if self.config.is_trunk_frozen:
            fine, coarse = inputs.float().split(list(CHANNELS.values()), 1)
        else:
            fine = self.trunk.fine(inputs)
            coarse = self.trunk.coarse(fine)
        coarse = self._lateral[1](coarse)
        fine = self._lateral[0](fine) + functional.interpolate(coarse, fine.shape[-2:])
        levels = [smooth(x) for smooth, x in zip(self._smooth, (fine, coarse), strict=False)]
        x = self._lift(levels, projections)
        for layer in self._bev:
            x = x + layer(x)
        return self._head(x)

    def groups(self) -> list[dict[str, object]]:
        """Return the parameter groups of the optimiser: trunk and other parts."""
        trunk = list(self.trunk.parameters())
        own = {id(p) for p in trunk}
        others = [p for p in self.parameters() if id(p) not in own]
        groups = [{"params": others, "lr": self.config.rate}]
        if not self.config.is_trunk_frozen:
            groups.append({"params": trunk, "lr": self.config.trunk_rate})
        return groups
