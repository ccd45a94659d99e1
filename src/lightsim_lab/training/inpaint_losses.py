"""Losses of the inpainting: weighted L1, and the adversarial hinge loss.

The hinge loss is that of Lim & Ye 2017 (arXiv:1705.02894).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional


def row_weights(height_px: int) -> Float[Tensor, "h 1"]:
    """Return the relative solid angle of the pixels of each row, with mean 1."""
    edges = torch.cos(torch.linspace(0.0, math.pi, height_px + 1, dtype=torch.float64))
    return ((edges[:-1] - edges[1:]) * (height_px / 2)).float()[:, None]


def reconstruction_loss(
    result: Float[Tensor, "n 3 h w"],
    truth: Float[Tensor, "n 3 h w"],
    hole: Float[Tensor, "n 1 h w"],
    known_weight: float,
) -> Float[Tensor, ""]:
    """Return the mean absolute error, weighted by solid angle.

    Args:
        known_weight: weight of a known pixel relative to one in a hole.
    """
    weight = (hole + known_weight * (1 - hole)) * row_weights(hole.shape[-2]).to(hole.device)
    error = (result - truth).abs().mean(1, keepdim=True)
    return (error * weight).sum() / weight.sum().clamp_min(1e-6)


def discriminator_loss(
    of_truth: Float[Tensor, "*shape"], of_result: Float[Tensor, "*shape"]
) -> Float[Tensor, ""]:
    """Return the hinge loss of scores above 1 for the truth and below -1 for results."""
    return functional.relu(1 - of_truth).mean() + functional.relu(1 + of_result).mean()


def generator_loss(of_result: Float[Tensor, "*shape"]) -> Float[Tensor, ""]:
    """Return the generator's adversarial loss: minus the mean score of its results."""
    return -of_result.mean()
