"""Padding on the sphere and contextual attention, for the networks on panoramas.

Yu et al., Generative Image Inpainting with Contextual Attention, CVPR 2018,
doi:10.1109/CVPR.2018.00577.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

# Stride at which patches are compared and copied: half resolution, as published.
MATCH_STRIDE = 2
# Side of the copied patches in pixels: twice the stride, so that four patches overlap on every
# pixel (as published).
_COPY_SIZE = 4


def pad_sphere(x: Float[Tensor, "n c h w"], size: int) -> Float[Tensor, "n c _ _"]:
    """Pad a panorama by `size` pixels on each side as on the sphere.

    Columns wrap around. Beyond a pole the panorama continues on the opposite meridian: rows are
    mirrored and shifted by half a turn.
    """
    if size == 0:
        return x
    width = x.shape[-1]
    above = x[..., :size, :].flip(-2).roll(width // 2, -1)
    below = x[..., -size:, :].flip(-2).roll(width // 2, -1)
    tall = torch.cat([above, x, below], -2)
    return torch.cat([tall[..., width - size :], tall, tall[..., :size]], -1)


def fold_sphere(padded: Float[Tensor, "n c _ _"], size: int) -> Float[Tensor, "n c h w"]:
    """Transpose of `pad_sphere`: values on the padding are added to the pixels they were copied
    from."""
    width = padded.shape[-1] - 2 * size
    tall = padded[..., size : size + width].clone()
    tall[..., width - size :] += padded[..., :size]
    tall[..., :size] += padded[..., size + width :]
    height = tall.shape[-2] - 2 * size
    x = tall[..., size : size + height, :].clone()
    x[..., :size, :] += tall[..., :size, :].flip(-2).roll(-(width // 2), -1)
    x[..., height - size :, :] += tall[..., size + height :, :].flip(-2).roll(-(width // 2), -1)
    return x


def contextual_attention(
    features: Float[Tensor, "n c h w"],
    hole: Float[Tensor, "n 1 h w"],
    *,
    sharpness: float = 10.0,
    propagates: bool = False,
) -> Float[Tensor, "n c h w"]:
    """Reconstruct every position from patches of the known part with similar features.

    3x3 patches at half resolution are compared by the cosine of their features; the softmax of
    `sharpness` times the cosine weights the 4x4 patches that are copied, four over every pixel.
    With `propagates`, scores are averaged over neighbouring patches (the paper's fusion, with
    wrapped columns). Where no patch is fully known, all patches are used.
    """
    small = functional.avg_pool2d(features, MATCH_STRIDE)
    rows, columns = small.shape[-2:]
    patches = functional.unfold(pad_sphere(small, 1), 3)
    patches = functional.normalize(patches, dim=1, eps=1e-4)
    scores = patches.transpose(1, 2) @ patches * sharpness
    if propagates:
        scores = _propagated(scores, rows, columns)
    touched = functional.unfold(pad_sphere(hole, 1), _COPY_SIZE, stride=MATCH_STRIDE).amax(1)
    # Patches that touch the hole are excluded by a finite score, so that the weights stay defined
    # where all patches are excluded.
    weights = torch.softmax(scores + -1e4 * touched[:, :, None], dim=1)
    copies = functional.unfold(pad_sphere(features, 1), _COPY_SIZE, stride=MATCH_STRIDE)
    size = (features.shape[-2] + 2, features.shape[-1] + 2)
    laid = functional.fold(copies @ weights, size, _COPY_SIZE, stride=MATCH_STRIDE)
    return fold_sphere(laid, 1) / (_COPY_SIZE / MATCH_STRIDE) ** 2


def _propagated(scores: Float[Tensor, "n k q"], rows: int, columns: int) -> Float[Tensor, "n k q"]:
    """Scores averaged over both horizontal neighbours, then over both vertical ones."""
    grid = scores.reshape(-1, rows, columns, rows, columns)
    grid = (grid + grid.roll((1, 1), (2, 4)) + grid.roll((-1, -1), (2, 4))) / 3
    total = grid.clone()
    total[:, 1:, :, 1:] += grid[:, :-1, :, :-1]
    total[:, :-1, :, :-1] += grid[:, 1:, :, 1:]
    return (total / 3).reshape(scores.shape)
