"""Signed distances along rays to opacities, colours and depths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Conversion = Literal["neus", "unisim"]
_EPSILON = 1e-6


@dataclass(frozen=True, eq=False)
class RenderedRays:
    """What volume rendering gives.

    Args:
        weights: of each sample.
        transmittance: what is left behind the last sample.
    """

    weights: Float[Tensor, "r s"]
    transmittance: Float[Tensor, " r"]

    def mean(self, values: Float[Tensor, "r s *c"]) -> Float[Tensor, "r *c"]:
        """Weighted sum of the samples' values."""
        weights = self.weights.reshape(*self.weights.shape, *([1] * (values.ndim - 2)))
        return (weights * values).sum(dim=1)


def opacities(
    sdf: Float[Tensor, "r s"], beta: Float[Tensor, ""], conversion: Conversion
) -> Float[Tensor, "r s"]:
    """Opacity of each sample, samples in the order of the ray.

    "unisim": 1 / (1 + exp(beta s)) (UniSim, doi:10.1109/CVPR52729.2023.00140, equation 3). "neus":
    the fall of the sigmoid since the sample before (NeuS, doi:10.48550/arXiv.2106.10689, equation
    13); in front of the first sample stands a free one.
    """
    if conversion == "unisim":
        return torch.sigmoid(-beta * sdf)
    free = torch.sigmoid(beta * sdf)
    before = torch.cat([torch.ones_like(free[:, :1]), free[:, :-1]], dim=1)
    return ((before - free) / (before + _EPSILON)).clamp(0.0, 1.0)


def crossings_m(
    t: Float[Tensor, "r s"], sdf: Float[Tensor, "r s"], conversion: Conversion
) -> Float[Tensor, "r s"]:
    """The distance that each sample's opacity stands for.

    A "neus" opacity belongs to the stretch since the sample before: to the zero of the signed
    distance there, interpolated linearly. Taking the sample itself would put every surface half a
    stretch too far away, which the field would learn to make up for.
    """
    if conversion == "unisim":
        return t
    before, after = sdf[:, :-1], sdf[:, 1:]
    fall = (before - after).clamp(min=1e-4)
    fraction = (before / fall).clamp(0.0, 1.0)
    inner = t[:, :-1] + fraction * (t[:, 1:] - t[:, :-1])
    return torch.cat([t[:, :1], inner], dim=1)


def composite(opacity: Float[Tensor, "r s"]) -> RenderedRays:
    """Front-to-back compositing: w_i = a_i prod_{j<i} (1 - a_j).

    Max 1995 (doi:10.1109/2945.468400).
    """
    through = torch.cumprod(1.0 - opacity + _EPSILON, dim=1)
    reaching = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], dim=1)
    return RenderedRays(opacity * reaching, through[:, -1])
