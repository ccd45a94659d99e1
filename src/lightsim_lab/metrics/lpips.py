"""LPIPS v0.1 with VGG-16 and AlexNet: a learned distance between images.

Zhang et al., The Unreasonable Effectiveness of Deep Features as a Perceptual Metric, CVPR 2018,
doi:10.1109/CVPR.2018.00068. Smaller is better; identical images have distance 0.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch.nn import functional

from lightsim.build.quality.frames import FramesConfig
from lightsim.errors import InputError
from lightsim.store.weights import load_weights
from lightsim_lab.weights import LAB_WEIGHTS_FOLDER

# Mean and standard deviation of ImageNet pictures in [-1, 1], as in the reference package.
_NORMALISATION = ((-0.030, -0.088, -0.188), (0.458, 0.448, 0.450))
# Backbone, as in LPIPS(VGG) and LPIPS(Alex) of papers; their values are not comparable.
Network = Literal["vgg", "alex"]


@dataclass(frozen=True)
class _Architecture:
    """Backbone with five stages of numbered convolutions.

    Args:
        weights: name of the weights in the package.
        stages: numbers of the convolutions of each stage.
        pool_before: stages preceded by max pooling of size `pool_px` and stride 2.
        first_stride: stride of convolution 0; the others have 1.
        smallest_px: smallest picture for which the last stage is not empty.
    """

    weights: str
    stages: tuple[tuple[int, ...], ...]
    pool_before: frozenset[int]
    pool_px: int
    first_stride: int
    padding_by_convolution: tuple[int, ...]
    smallest_px: int


# Layers of the two backbones in torchvision, up to the last stage that LPIPS uses.
_ARCHITECTURES: dict[Network, _Architecture] = {
    "vgg": _Architecture(
        "lpips-vgg16",
        ((0, 1), (2, 3), (4, 5, 6), (7, 8, 9), (10, 11, 12)),
        frozenset({1, 2, 3, 4}),
        2,
        1,
        (1,) * 13,
        16,
    ),
    "alex": _Architecture(
        "lpips-alex", ((0,), (1,), (2,), (3,), (4,)), frozenset({1, 2}), 3, 4, (2, 2, 1, 1, 1), 31
    ),
}

Features = list[Float[torch.Tensor, "n _ _ _"]]


# Convolutions and heads by name.
Weights = Mapping[str, torch.Tensor]


@functools.cache
def lpips_weights(network: Network = "vgg") -> Weights:
    """Load the weights of the package."""
    loaded = load_weights(_ARCHITECTURES[network].weights, LAB_WEIGHTS_FOLDER)
    # Convolutions take half of the time with channels last.
    return {
        name: value.float().contiguous(memory_format=torch.channels_last)
        if value.ndim == 4
        else value.float()
        for name, value in loaded.items()
    }


def lpips_features(srgb: Float32[np.ndarray, "h w 3"], network: Network = "vgg") -> Features:
    """Return the normalised features of the five stages, for images that are compared repeatedly.

    Raises:
        InputError: the image is so small that the last stage is empty.
    """
    net = _ARCHITECTURES[network]
    if min(srgb.shape[:2]) < net.smallest_px:
        raise InputError(
            "the image is too small for LPIPS",
            got=f"{srgb.shape[1]}x{srgb.shape[0]} px",
            expected=f"at least {net.smallest_px} px each way",
        )
    with torch.inference_mode():
        image = torch.from_numpy(np.ascontiguousarray(srgb)).permute(2, 0, 1)[None]
        return stage_features(image, lpips_weights(network), network)


def stage_features(
    srgb: Float[torch.Tensor, "n 3 h w"], weights: Weights, network: Network = "vgg"
) -> Features:
    """Return `lpips_features` of a batch of pictures in [0, 1], differentiably.

    Args:
        weights: result of `lpips_weights`, on the device of the pictures.
    """
    net = _ARCHITECTURES[network]
    shift, scale = (srgb.new_tensor(values)[:, None, None] for values in _NORMALISATION)
    x = ((srgb * 2 - 1 - shift) / scale).contiguous(memory_format=torch.channels_last)
    stages: Features = []
    for number, convolutions in enumerate(net.stages):
        if number in net.pool_before:
            x = functional.max_pool2d(x, net.pool_px, 2)
        for i in convolutions:
            weight, bias = weights[f"conv{i}.weight"], weights[f"conv{i}.bias"]
            stride = 1 if i else net.first_stride
            padding = net.padding_by_convolution[i]
            response = functional.conv2d(x, weight, bias, stride, padding)
            x = functional.relu(response, inplace=True)
        # The guard is within the root: the gradient of a root is infinite at 0.
        stages.append(x / (x.square().sum(1, keepdim=True) + 1e-20).sqrt())
    return stages


def lpips_of_features(
    first: Features,
    second: Features,
    is_valid: Bool[np.ndarray, "h w"] | None = None,
    network: Network = "vgg",
) -> float:
    """Return the distance of two images by their features, averaged over the valid pixels.

    At each stage a cell has the weight of its fraction of valid pixels. Invalid pixels must have
    equal values in both images, because receptive fields extend across the mask.
    """
    weights = lpips_weights(network)
    total = 0.0
    with torch.inference_mode():
        for i, (a, b) in enumerate(zip(first, second, strict=True)):
            distance = ((a - b).square() * weights[f"head{i}"][:, None, None]).sum(1)[0]
            if is_valid is None:
                total += float(distance.mean())
                continue
            mask = torch.from_numpy(is_valid.astype(np.float32))[None, None]
            cells = (distance.shape[0], distance.shape[1])
            fraction = functional.adaptive_avg_pool2d(mask, cells)[0, 0]
            total += float((distance * fraction).sum() / fraction.sum())
    return total


def lpips(
    first_srgb: Float32[np.ndarray, "h w 3"],
    second_srgb: Float32[np.ndarray, "h w 3"],
    network: Network = "vgg",
) -> float:
    """Return LPIPS of two sRGB images in [0, 1], equal to the reference package."""
    first, second = (lpips_features(image, network) for image in (first_srgb, second_srgb))
    return lpips_of_features(first, second, network=network)


class Lpips:
    """LPIPS with VGG-16 and AlexNet, about one second per half megapixel and image on two cores.

    Implements `lightsim.build.quality.frames.PerceptualDistance`.
    """

    def features(self, srgb: Float32[np.ndarray, "h w 3"]) -> dict[Network, Features]:
        """Return the features of a picture by network."""
        return {network: lpips_features(srgb, network) for network in _ARCHITECTURES}

    def distances(
        self,
        srgb: Float32[np.ndarray, "h w 3"],
        truth_features: dict[Network, Features],
        is_valid: Bool[np.ndarray, "h w"] | None,
    ) -> tuple[float, ...]:
        """Return LPIPS (VGG) and LPIPS (Alex) between a picture and the truth of the features."""
        return tuple(
            lpips_of_features(lpips_features(srgb, network), wanted, is_valid, network)
            for network, wanted in truth_features.items()
        )


# Configuration for PSNR, SSIM and LPIPS, raw and with one fitted exposure per sequence.
ALL_MEASURES = FramesConfig(perceptual=Lpips())
