"""Layers for panoramas: convolutions that wrap around in azimuth."""

from __future__ import annotations

import itertools

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lightsim.core.equirect import pixel_directions

# Channels of a group in group normalisation; a common choice, sensitivity not measured.
_GROUP = 8


def direction_map(height_px: int, rows: int, device: torch.device) -> Float[Tensor, "1 3 r w"]:
    """Unit vectors towards the pixels of the first rows of an (h, 2h) panorama."""
    directions = torch.from_numpy(pixel_directions(height_px)[:rows]).to(device, torch.float32)
    return directions.permute(2, 0, 1)[None].contiguous()


def pad_borders(
    image: Float[Tensor, "n c h w"], size: int, *, wraps: bool = True
) -> Float[Tensor, "n c h2 w2"]:
    """Pad the image by `size` pixels on each side: wrapped sideways (or replicated, if `wraps` is
    false), replicated above and below."""
    image = functional.pad(image, (size, size, 0, 0), mode="circular" if wraps else "replicate")
    return functional.pad(image, (0, 0, size, size), mode="replicate")


def upsampled(image: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c H W"]:
    """Enlarge to twice the size, bilinear, without a seam."""
    padded = pad_borders(image, 1)
    double = functional.interpolate(padded, scale_factor=2, mode="bilinear", align_corners=False)
    return double[..., 2:-2, 2:-2]


class WrapConv(nn.Module):
    """3x3 convolution over a panorama (or over a picture, with `wraps=False`)."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1, *, wraps: bool = True) -> None:
        super().__init__()
        self.wraps = wraps
        self.convolution = nn.Conv2d(inputs, outputs, 3, stride)

    def forward(self, image: Float[Tensor, "n c h w"]) -> Float[Tensor, "n d h2 w2"]:
        """Convolve; height and width are divided by the stride and rounded up."""
        return self.convolution(pad_borders(image, 1, wraps=self.wraps))


class Residual(nn.Module):
    """x + conv(act(norm(conv(act(norm(x)))))): a block of He et al. 2016 (arXiv:1603.05027)."""

    def __init__(self, width: int, *, wraps: bool = True) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.GroupNorm(max(1, width // _GROUP), width),
            nn.SiLU(),
            WrapConv(width, width, wraps=wraps),
            nn.GroupNorm(max(1, width // _GROUP), width),
            nn.SiLU(),
            WrapConv(width, width, wraps=wraps),
        )

    def forward(self, image: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """Return the image plus the output of two convolutions, in the same size."""
        return image + self.layers(image)


class Pyramid(nn.Module):
    """Features at strides 2, 4, 8 ...: one downward convolution and one residual block each.

    Args:
        inputs: channels of the image.
        widths: channels at each stride.
        wraps: the image is a panorama.
    """

    def __init__(self, inputs: int, widths: tuple[int, ...], *, wraps: bool = True) -> None:
        super().__init__()
        channels = (inputs, *widths)
        self.levels = nn.ModuleList(
            nn.Sequential(WrapConv(a, b, stride=2, wraps=wraps), Residual(b, wraps=wraps))
            for a, b in itertools.pairwise(channels)
        )

    def forward(self, image: Float[Tensor, "n c h w"]) -> list[Tensor]:
        """Return one feature map [n, widths[i], h / 2^(i + 1), w / 2^(i + 1)] per level, finest
        first."""
        features = []
        for level in self.levels:
            image = level(image)
            features.append(image)
        return features


class Merge(nn.Module):
    """Merge a pyramid from its coarsest to its finest level by sums.

    A feature pyramid network (Lin et al. 2017, doi:10.1109/CVPR.2017.106).
    """

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.sideways = nn.ModuleList(nn.Conv2d(w, widths[0], 1) for w in widths)
        self.smooth = nn.ModuleList(WrapConv(widths[0], widths[0]) for _ in widths[1:])

    def forward(self, features: list[Tensor]) -> Float[Tensor, "n c h w"]:
        """Return merged features at the size and width of `features[0]`, the finest level."""
        merged = self.sideways[-1](features[-1])
        for index in range(len(features) - 2, -1, -1):
            merged = upsampled(merged) + self.sideways[index](features[index])
            merged = self.smooth[index](functional.silu(merged))
        return merged


class UNet(nn.Module):
    """Image to image, with a vector added at the coarsest level.

    After the U-Net of Ronneberger et al. 2015 (arXiv:1505.04597).

    Args:
        inputs: channels of the image.
        outputs: channels of the result.
        widths: channels at strides 1, 2, 4 ...
        vector: length of the vector.
    """

    def __init__(self, inputs: int, outputs: int, widths: tuple[int, ...], vector: int) -> None:
        super().__init__()
        self.entry = WrapConv(inputs, widths[0])
        self.down = Pyramid(widths[0], widths[1:])
        self.fuse = nn.Linear(vector, widths[-1])
        self.middle = Residual(widths[-1])
        self.up = nn.ModuleList(WrapConv(a + b, a) for a, b in itertools.pairwise(widths))
        self.exit = WrapConv(widths[0], outputs)

    def forward(
        self, image: Float[Tensor, "n c h w"], vector: Float[Tensor, "n v"]
    ) -> tuple[Float[Tensor, "n o h w"], Float[Tensor, "n m"]]:
        """Return the result, and the mean of the features at the coarsest level."""
        levels = [self.entry(image)]
        levels += self.down(functional.silu(levels[0]))
        x = self.middle(levels[-1] + self.fuse(vector)[:, :, None, None])
        mean = x.mean(dim=(2, 3))
        for skip, layer in zip(levels[-2::-1], list(self.up)[::-1], strict=True):
            x = functional.silu(layer(torch.cat([skip, upsampled(x)], dim=1)))
        return self.exit(x), mean


def pooled(features: Float[Tensor, "n c h w"]) -> Float[Tensor, "n d"]:
    """Mean and maximum over the image, which are invariant to rotations of the panorama."""
    return torch.cat([features.mean(dim=(2, 3)), features.amax(dim=(2, 3))], dim=1)


def filled(
    image: Float[Tensor, "n c h w"], seen: Float[Tensor, "n 1 h w"]
) -> Float[Tensor, "n c h w"]:
    """Replace unobserved pixels by a smooth continuation of the observed ones (pull-push)."""
    height, width = image.shape[-2:]
    if height % 2 or width % 2 or min(height, width) <= 2:
        total = seen.sum(dim=(2, 3), keepdim=True)
        mean = (image * seen).sum(dim=(2, 3), keepdim=True) / total.clamp_min(1e-6)
        return image * seen + mean * (1 - seen)
    weight = functional.avg_pool2d(seen, 2)
    half = functional.avg_pool2d(image * seen, 2) / weight.clamp_min(1e-6)
    coarse = upsampled(filled(half, (weight > 0).to(image)))
    return image * seen + coarse * (1 - seen)
