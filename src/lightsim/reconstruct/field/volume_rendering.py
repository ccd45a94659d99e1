"""Volume rendering: signed distances along rays to opacities, colours and depths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Conversion = Literal["neus", "unisim"]
# Guards divisions by, and products of, vanishing transmittance.
_EPSILON = 1e-6


@dataclass(frozen=True, eq=False)
class RenderedRays:
    """Rendering weights of samples along rays.

    Args:
        weights: of each sample, in the order of the ray.
        transmittance: fraction of light that passes all samples.
    """

    weights: Float[Tensor, "r s"]
    transmittance: Float[Tensor, " r"]

    def mean(self, values: Float[Tensor, "r s *c"]) -> Float[Tensor, "r *c"]:
        """Return the weighted sum of the samples' values."""
        weights = self.weights.reshape(*self.weights.shape, *([1] * (values.ndim - 2)))
        return (weights * values).sum(dim=1)


def opacities(
    sdf: Float[Tensor, "r s"], beta: Float[Tensor, ""], conversion: Conversion
) -> Float[Tensor, "r s"]:
    """Return the opacity of each sample, samples in the order of the ray.

    "unisim": 1 / (1 + exp(beta s)) (UniSim, doi:10.1109/CVPR52729.2023.00140, equation 3). "neus":
    the relative decrease of the sigmoid since the previous sample (NeuS,
    doi:10.48550/arXiv.2106.10689, equation 13); the space before the first sample is free.
    """
    if conversion == "unisim":
        return torch.sigmoid(-beta * sdf)
    free = torch.sigmoid(beta * sdf)
    before = torch.cat([torch.ones_like(free[:, :1]), free[:, :-1]], dim=1)
    return ((before - free) / (before + _EPSILON)).clamp(0.0, 1.0)


def crossings_m(
    t: Float[Tensor, "r s"], sdf: Float[Tensor, "r s"], conversion: Conversion
) -> Float[Tensor, "r s"]:
    """Return the distance at which each sample's opacity is located, in metres.

    A "neus" opacity is located at the linearly interpolated zero of the signed distance between the
    previous sample and its own. The distance of the sample itself would be half an interval too
    far, and the field would compensate for it.
    """
    if conversion == "unisim":
        return t
    before, after = sdf[:, :-1], sdf[:, 1:]
    fall = (before - after).clamp(min=1e-4)
    fraction = (before / fall).clamp(0.0, 1.0)
    inner = t[:, :-1] + fraction * (t[:, 1:] - t[:, :-1])
    return torch.cat([t[:, :1], inner], dim=1)


def composite(opacity: Float[Tensor, "r s"]) -> RenderedRays:
    """Composite front to back: w_i = a_i prod_{j<i} (1 - a_j).

    Max 1995 (doi:10.1109/2945.468400).
    """
    through = torch.cumprod(1.0 - opacity + _EPSILON, dim=1)
    reaching = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], dim=1)
    return RenderedRays(opacity * reaching, through[:, -1])
