"""What relighting networks minimise: colour, perception and edges (paper, L_relight)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lightsim.store.weights import load_weights

_LEAK = 0.05
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Mean and deviation of ImageNet on [-1, 1], as the reference package has them."""
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
    square = (weight * (made - truth).square()).sum((1, 2, 3))
    mean = square / (made.shape[1] * weight.sum((1, 2, 3)) + _TINY)
    return ((mean + _NOISE**2).sqrt() - _NOISE).mean()


def edge_loss(
    made: Float[Tensor, "n 3 h w"],
    truth: Float[Tensor, "n 3 h w"],
    weight: Float[Tensor, "n 1 h w"],
) -> Float[Tensor, ""]:
    """Root mean square of the difference of Sobel gradients (paper, L_edge; Sobel and Feldman
    1968), in codes a pixel."""
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


class Perceptual(nn.Module):
    """LPIPS v0.1 on VGG-16 with a gradient (doi:10.1109/CVPR.2018.00068)."""

    _CONVOLUTIONS = ((0, 1), (2, 3), (4, 5, 6), (7, 8, 9), (10, 11, 12))

    def __init__(self) -> None:
        super().__init__()
        for name, value in load_weights("lpips-vgg16").items():
            value = value.float()
            if value.ndim == 4:
                value = value.contiguous(memory_format=torch.channels_last)
            self.register_buffer(name.replace(".", "_"), value, persistent=False)

    def forward(
        self, made: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"]
    ) -> Float[Tensor, ""]:
        """Mean distance of pictures in [0, 1]."""
        with torch.no_grad():
            wanted = self._features(truth)
        total = made.new_zeros(())
        for i, (a, b) in enumerate(zip(self._features(made), wanted, strict=True)):
            head = getattr(self, f"head{i}")
            total = total + ((a - b).square() * head[:, None, None]).sum(1).mean()
        return total

    def _features(self, image: Float[Tensor, "n 3 h w"]) -> list[Tensor]:
        shift, scale = (image.new_tensor(values)[:, None, None] for values in (_SHIFT, _SCALE))
        x = (image * 2 - 1 - shift) / scale
        x = x.contiguous(memory_format=torch.channels_last)
        stages = []
        for number, convolutions in enumerate(self._CONVOLUTIONS):
            if number:
                x = functional.max_pool2d(x, 2)
            for i in convolutions:
                weight, bias = (getattr(self, f"conv{i}_{part}") for part in ("weight", "bias"))
                x = functional.relu(functional.conv2d(x, weight, bias, padding=1))
            stages.append(x / (x.square().sum(1, keepdim=True) + 1e-10).sqrt())
        return stages
