"""LPIPS v0.1 on VGG-16: the learned distance between image patches.

Zhang et al., The Unreasonable Effectiveness of Deep Features as a Perceptual Metric, CVPR 2018,
doi:10.1109/CVPR.2018.00068. Smaller is better; identical images have 0.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch.nn import functional

from lightsim.errors import InputError
from lightsim.store.weights import load_weights

_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_CONVOLUTIONS_BY_STAGE = ((0, 1), (2, 3), (4, 5, 6), (7, 8, 9), (10, 11, 12))
_SMALLEST_PX = 16

Features = list[Float[torch.Tensor, "1 _ _ _"]]


@functools.cache
def _weights() -> dict[str, torch.Tensor]:
    return {name: value.float() for name, value in load_weights("lpips-vgg16").items()}


def lpips_features(srgb: Float32[np.ndarray, "h w 3"]) -> Features:
    """Unit-length VGG-16 features of the five stages, for images that are compared many times.

    Raises:
        InputError: the image is smaller than 16 pixels, so that the last stage is empty.
    """
    if min(srgb.shape[:2]) < _SMALLEST_PX:
        raise InputError(
            "the image is too small for LPIPS",
            got=f"{srgb.shape[1]}x{srgb.shape[0]} px",
            expected=f"at least {_SMALLEST_PX} px each way",
        )
    weights = _weights()
    with torch.inference_mode():
        image = torch.from_numpy(np.ascontiguousarray(srgb)).permute(2, 0, 1)[None] * 2 - 1
        shift, scale = torch.tensor(_SHIFT), torch.tensor(_SCALE)
        x = (image - shift[:, None, None]) / scale[:, None, None]
        stages: Features = []
        for number, convolutions in enumerate(_CONVOLUTIONS_BY_STAGE):
            if number:
                x = functional.max_pool2d(x, 2)
            for i in convolutions:
                weight, bias = weights[f"conv{i}.weight"], weights[f"conv{i}.bias"]
                x = functional.relu(functional.conv2d(x, weight, bias, padding=1))
            stages.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
    return stages


def lpips_of_features(
    first: Features, second: Features, is_valid: Bool[np.ndarray, "h w"] | None = None
) -> float:
    """Distance of two images by their features, averaged over the valid pixels.

    At each stage a cell counts with the fraction of its pixels that are valid. Fill what is not
    valid alike in both images before taking features, since receptive fields reach across.
    """
    weights = _weights()
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
    first_srgb: Float32[np.ndarray, "h w 3"], second_srgb: Float32[np.ndarray, "h w 3"]
) -> float:
    """LPIPS (VGG) of two sRGB images in [0, 1], as the reference package computes it."""
    return lpips_of_features(lpips_features(first_srgb), lpips_features(second_srgb))
