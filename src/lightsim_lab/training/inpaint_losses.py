"""The losses of inpainting: weighted L1 and the hinge of the patch discriminator.

The hinge is that of Lim & Ye 2017 (arXiv:1705.02894).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional


def row_weights(height_px: int) -> Float[Tensor, "h 1"]:
    """The solid angle of each row's pixels, with mean 1."""
    edges = torch.cos(torch.linspace(0.0, math.pi, height_px + 1, dtype=torch.float64))
    return ((edges[:-1] - edges[1:]) * (height_px / 2)).float()[:, None]


def reconstruction_loss(
    result: Float[Tensor, "n 3 h w"],
    truth: Float[Tensor, "n 3 h w"],
    hole: Float[Tensor, "n 1 h w"],
    known_weight: float,
) -> Float[Tensor, ""]:
    """Mean absolute error by solid angle; what was known counts `known_weight` times a hole."""
    weight = (hole + known_weight * (1 - hole)) * row_weights(hole.shape[-2]).to(hole.device)
    error = (result - truth).abs().mean(1, keepdim=True)
    return (error * weight).sum() / weight.sum().clamp_min(1e-6)


def discriminator_loss(
    of_truth: Float[Tensor, "*shape"], of_result: Float[Tensor, "*shape"]
) -> Float[Tensor, ""]:
    """Hinge: truth is to be judged above 1 and results below -1."""
    return functional.relu(1 - of_truth).mean() + functional.relu(1 + of_result).mean()


def generator_loss(of_result: Float[Tensor, "*shape"]) -> Float[Tensor, ""]:
    """Results are to be judged as high as can be."""
    return -of_result.mean()
