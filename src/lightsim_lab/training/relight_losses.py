"""What relighting networks minimise: colour, perception and edges (paper, L_relight)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lightsim_lab.metrics.lpips import lpips_weights, stage_features

_LEAK = 0.05
_TINY = 1e-6
_NOISE = 1 / 255
"""Smaller errors than a code of 8 bits are none: the root of their square would pull as hard as
any, and frames whose target is the source would teach the network to do nothing anywhere."""


def shown(srgb: Tensor) -> Tensor:
    """sRGB code as it is recorded: clipped at white, but with a small slope above it, or nothing
    would bring a pixel back."""
    return srgb.clamp_max(1.0) + _LEAK * (srgb - 1.0).clamp_min(0.0)


def colour_loss(
    made: Float[Tensor, "n c h w"],
    truth: Float[Tensor, "n c h w"],
    weight: Float[Tensor, "n 1 h w"],
) -> Float[Tensor, ""]:
    """Root mean square of the codes' difference, mean over the pictures (paper, L_color)."""
    return _errors(made, truth, weight).mean()


def even_loss(
    made: Float[Tensor, "n c h w"],
    truth: Float[Tensor, "n c h w"],
    weight: Float[Tensor, "n 1 h w"],
    knee: float,
) -> Float[Tensor, ""]:
    """The same, but errors above the knee count by their logarithm, as they do in decibels: a
    picture that is nearly right can gain as much as one that hardly can be."""
    return knee * torch.log1p(_errors(made, truth, weight) / knee).mean()


def _errors(made: Tensor, truth: Tensor, weight: Tensor) -> Float[Tensor, "n"]:
    square = (weight * (made - truth).square()).sum((1, 2, 3))
    mean = square / (made.shape[1] * weight.sum((1, 2, 3)) + _TINY)
    return (mean + _NOISE**2).sqrt() - _NOISE


def edge_loss(
    made: Float[Tensor, "n 3 h w"],
    truth: Float[Tensor, "n 3 h w"],
    weight: Float[Tensor, "n 1 h w"],
    pixel_px: int = 1,
) -> Float[Tensor, ""]:
    """Root mean square of the difference of Sobel gradients (paper, L_edge; Sobel and Feldman
    1968), in codes a pixel.

    Args:
        pixel_px: pictures are looked at with pixels so many times as large: what is left of a
            shadow is a step with soft edges, which a fine gradient hardly sees.
    """
    if pixel_px > 1:
        made, truth, weight = (functional.avg_pool2d(x, pixel_px) for x in (made, truth, weight))
    return colour_loss(_sobel(made), _sobel(truth), weight[..., 1:-1, 1:-1])


def _sobel(image: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 6 p q"]:
    along = torch.tensor([[-1.0, 0, 1], [-2, 0, 2], [-1, 0, 1]], device=image.device) / 8
    kernels = torch.stack([along, along.T])[:, None]
    n, _, h, w = image.shape
    both = functional.conv2d(image.reshape(3 * n, 1, h, w), kernels)
    return both.reshape(n, 6, h - 2, w - 2)


def error_loss(
    log_error: Float[Tensor, "n 1 p q"],
    made: Float[Tensor, "n 3 h w"],
    truth: Float[Tensor, "n 3 h w"],
    weight: Float[Tensor, "n 1 h w"],
) -> Float[Tensor, ""]:
    """Negative log-likelihood of the Laplace density of the error that is there: it teaches the
    network how far off it is, and nothing else."""
    error = (weight * (made - truth).abs().mean(1, keepdim=True)).detach() + _NOISE
    size = log_error.shape[-2:]
    error, part = (functional.interpolate(x, size, mode="area") for x in (error, weight))
    loss = log_error + error * torch.exp(-log_error)
    return (part * loss).sum() / (part.sum() + _TINY)


def picture_terms(
    made: Float[Tensor, "n 3 h w"],
    truth: Float[Tensor, "n 3 h w"],
    weight: Float[Tensor, "n 1 h w"],
    perceptual: nn.Module,
    perception_crops: int,
    edge_pixels_px: Sequence[int] = (1,),
) -> dict[str, Tensor]:
    """Colour, edges and LPIPS of pictures as they are `shown`; what does not count looks like the
    truth.

    Args:
        perception_crops: pictures that LPIPS looks at.
        edge_pixels_px: sizes of pixels whose edges' losses are summed.
    """
    filled, few = weight * made + (1 - weight) * truth, slice(perception_crops)
    ones = torch.ones_like(weight)
    edges = [edge_loss(filled, truth, ones, px) for px in edge_pixels_px]
    return {
        "colour": colour_loss(made, truth, weight),
        "edges": torch.stack(edges).sum(),
        "lpips": perceptual(filled[few], truth[few]),
    }


class Perceptual(nn.Module):
    """LPIPS v0.1 on VGG-16 with a gradient (doi:10.1109/CVPR.2018.00068)."""

    def __init__(self) -> None:
        super().__init__()
        self._names = tuple(lpips_weights())
        for name, value in lpips_weights().items():
            self.register_buffer(name.replace(".", "_"), value, persistent=False)

    def forward(
        self, made: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"]
    ) -> Float[Tensor, ""]:
        """Mean distance of pictures in [0, 1]."""
        weights = {name: self.get_buffer(name.replace(".", "_")) for name in self._names}
        with torch.no_grad():
            wanted = stage_features(truth, weights)
        total = made.new_zeros(())
        for i, (a, b) in enumerate(zip(stage_features(made, weights), wanted, strict=True)):
            total = total + ((a - b).square() * weights[f"head{i}"][:, None, None]).sum(1).mean()
        return total
