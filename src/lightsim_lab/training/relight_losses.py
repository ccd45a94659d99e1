"""Losses of the relighting networks: colour, LPIPS and edges, of RelitNet and of the paper."""

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
# One 8-bit code value; errors below it do not count. Without this limit, the steep gradient of the
# square root at 0 on identity pairs, whose error is 0, would train the network to change nothing.
_NOISE = 1 / 255


def shown(srgb: Tensor) -> Tensor:
    """Clip sRGB values at white as a camera does, with a small slope above to keep a gradient."""
    return srgb.clamp_max(1.0) + _LEAK * (srgb - 1.0).clamp_min(0.0)


def colour_loss(
    made: Float[Tensor, "n c h w"],
    truth: Float[Tensor, "n c h w"],
    weight: Float[Tensor, "n 1 h w"],
) -> Float[Tensor, ""]:
    """Return the RMS difference of sRGB values beyond one code value, mean over pictures."""
    return ((_mean_square(made, truth, weight) + _NOISE**2).sqrt() - _NOISE).mean()


def _mean_square(made: Tensor, truth: Tensor, weight: Tensor) -> Float[Tensor, "n"]:
    """Return the mean squared difference of each picture."""
    square = (weight * (made - truth).square()).sum((1, 2, 3))
    return square / (made.shape[1] * weight.sum((1, 2, 3)) + _TINY)


def edge_loss(
    made: Float[Tensor, "n 3 h w"],
    truth: Float[Tensor, "n 3 h w"],
    weight: Float[Tensor, "n 1 h w"],
) -> Float[Tensor, ""]:
    """Return the root mean square difference of gradients, in sRGB code values per pixel."""
    # The Sobel operator sums eight differences of neighbouring pixels.
    return colour_loss(sobel(made) / 8, sobel(truth) / 8, weight[..., 1:-1, 1:-1])


def sobel(image: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 6 p q"]:
    """Return both derivatives of every channel by the 3 x 3 operator of Sobel and Feldman (1968),
    not normalised: 8 for a slope of 1 per pixel."""
    # Kernel of the horizontal derivative; its transpose is that of the vertical one.
    along = torch.tensor([[-1.0, 0, 1], [-2, 0, 2], [-1, 0, 1]], device=image.device)
    kernels = torch.stack([along, along.T])[:, None]
    n, _, h, w = image.shape
    both = functional.conv2d(image.reshape(3 * n, 1, h, w), kernels)
    return both.reshape(n, 6, h - 2, w - 2)


def norm_loss(
    made: Float[Tensor, "n c h w"],
    truth: Float[Tensor, "n c h w"],
    weight: Float[Tensor, "n 1 h w"],
) -> Float[Tensor, ""]:
    """Return the L2 norm of the difference, mean over pictures (paper, L_relight).

    The norm is divided by the square root of the number of values, so that it does not depend on
    the size of the picture; the paper leaves this open.
    """
    # Below this limit, far under one code value, the square root would have no finite gradient.
    return _mean_square(made, truth, weight).clamp_min(_TINY**2).sqrt().mean()


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
    """Return the colour, edge and LPIPS loss of RelitNet for a batch of `shown` pictures.

    Args:
        perception_crops: number of pictures that LPIPS is evaluated on.
    """
    filled, few = _filled(made, truth, weight), slice(perception_crops)
    return {
        "colour": colour_loss(made, truth, weight),
        "edges": edge_loss(filled, truth, torch.ones_like(weight)),
        "lpips": perceptual(filled[few], truth[few]),
    }


def paper_terms(
    made: Float[Tensor, "n 3 h w"],
    truth: Float[Tensor, "n 3 h w"],
    weight: Float[Tensor, "n 1 h w"],
    perceptual: nn.Module,
    perception_crops: int,
) -> dict[str, Tensor]:
    """Return L_color, L_edge and L_lpips of the paper (Sec. 4, "Learning"), without their weights.

    Args:
        perception_crops: as in `picture_terms`.
    """
    filled, few = _filled(made, truth, weight), slice(perception_crops)
    inside = torch.ones_like(weight)[..., 1:-1, 1:-1]
    return {
        "colour": norm_loss(made, truth, weight),
        "edges": norm_loss(sobel(filled), sobel(truth), inside),
        "lpips": perceptual(filled[few], truth[few]),
    }


def _filled(made: Tensor, truth: Tensor, weight: Tensor) -> Float[Tensor, "n 3 h w"]:
    """Return the picture with the truth where the weight is 0, so that no border is an edge."""
    return weight * made + (1 - weight) * truth


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
