"""Losses of the relighting networks: colour, LPIPS and edges (paper, L_relight)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lightsim_lab.metrics.lpips import lpips_weights, stage_features

# Slope of `shown` above white. Small, so that overexposed pixels hardly count, but not 0: their
# gradient would vanish. Sensitivity not measured.
_LEAK = 0.05
# Added to denominators; a batch may have no weight at all.
_TINY = 1e-6
# One 8-bit code value; errors below it do not count. The square root has a steep gradient at 0, so
# that without this limit identity pairs, whose error is 0, would teach the network to change
# nothing.
_NOISE = 1 / 255


def shown(srgb: Tensor) -> Tensor:
    """Clip sRGB values at white as a camera does, with a small slope above to keep a gradient."""
    return srgb.clamp_max(1.0) + _LEAK * (srgb - 1.0).clamp_min(0.0)


def colour_loss(
    made: Float[Tensor, "n c h w"],
    truth: Float[Tensor, "n c h w"],
    weight: Float[Tensor, "n 1 h w"],
) -> Float[Tensor, ""]:
    """Return the RMS difference of sRGB values, mean over pictures (paper, L_color)."""
    return _errors(made, truth, weight).mean()


def _errors(made: Tensor, truth: Tensor, weight: Tensor) -> Float[Tensor, "n"]:
    square = (weight * (made - truth).square()).sum((1, 2, 3))
    mean = square / (made.shape[1] * weight.sum((1, 2, 3)) + _TINY)
    return (mean + _NOISE**2).sqrt() - _NOISE


def edge_loss(
    made: Float[Tensor, "n 3 h w"],
    truth: Float[Tensor, "n 3 h w"],
    weight: Float[Tensor, "n 1 h w"],
) -> Float[Tensor, ""]:
    """Return the root mean square difference of Sobel gradients, in sRGB code values per pixel.

    This is L_edge of the paper; the operator is that of Sobel and Feldman (1968).
    """
    return colour_loss(_sobel(made), _sobel(truth), weight[..., 1:-1, 1:-1])


def _sobel(image: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 6 p q"]:
    # Kernel of the horizontal derivative; its transpose is that of the vertical one.
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
    """Return the negative log-likelihood of the true error under a Laplace density.

    Args:
        log_error: predicted log of the density's scale (mean absolute sRGB error), at any
            resolution.
    """
    # Detached: the loss trains the predicted error and leaves the picture unchanged.
    error = (weight * (made - truth).abs().mean(1, keepdim=True)).detach() + _NOISE
    # The error is averaged to the resolution of the prediction.
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
) -> dict[str, Tensor]:
    """Return the colour, edge and LPIPS loss of a batch of `shown` pictures.

    Args:
        perception_crops: number of pictures that LPIPS is evaluated on.
    """
    # Edges and LPIPS see the truth where the weight is 0, so that no border is an edge.
    filled, few = weight * made + (1 - weight) * truth, slice(perception_crops)
    ones = torch.ones_like(weight)
    edges = edge_loss(filled, truth, ones)
    return {
        "colour": colour_loss(made, truth, weight),
        "edges": edges,
        "lpips": perceptual(filled[few], truth[few]),
    }


class Perceptual(nn.Module):
    """Differentiable LPIPS v0.1 on VGG-16 (doi:10.1109/CVPR.2018.00068)."""

    def __init__(self) -> None:
        super().__init__()
        self._names = tuple(lpips_weights())
        for name, value in lpips_weights().items():
            # Not persistent: the weights are part of the package, not of a checkpoint.
            self.register_buffer(name.replace(".", "_"), value, persistent=False)

    def forward(
        self, made: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"]
    ) -> Float[Tensor, ""]:
        """Return the mean LPIPS distance of sRGB pictures with values in [0, 1]."""
        weights = {name: self.get_buffer(name.replace(".", "_")) for name in self._names}
        with torch.no_grad():
            wanted = stage_features(truth, weights)
        total = made.new_zeros(())
        for i, (a, b) in enumerate(zip(stage_features(made, weights), wanted, strict=True)):
            total = total + ((a - b).square() * weights[f"head{i}"][:, None, None]).sum(1).mean()
        return total
