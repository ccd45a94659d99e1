"""Completion of panoramas with holes, by the trained network or by a smooth continuation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy import ndimage

from lightsim.core.colour import linear_from_srgb, srgb_from_linear
from lightsim.core.equirect import pixel_directions, sample_bilinear
from lightsim.core.laplace import fill_smoothly, nearest_known
from lightsim.core.resample import resize_area
from lightsim.errors import InputError

if TYPE_CHECKING:
    import torch

# Rows at which holes are filled smoothly; a smooth fill has no finer detail. Sensitivity not
# measured.
SMOOTH_HEIGHT_PX = 64
# Standard deviation of the transition from fill to observed pixels, in pixels of the filled size;
# sensitivity not measured.
_BLEND_PX = 1.5


def check_panorama_size(height_px: int, width_px: int) -> None:
    """Raise InputError unless a panorama is twice as wide as high."""
    if width_px != 2 * height_px:
        raise InputError(
            "a panorama must be twice as wide as high",
            got=f"{width_px}x{height_px} px",
            expected=f"{2 * height_px}x{height_px} px",
            remedy="Crop or pad it to an equirectangular image.",
        )


def complete_panorama(
    ldr: Float32[np.ndarray, "h w 3"],
    is_seen: Bool[np.ndarray, "h w"],
    weights: Mapping[str, torch.Tensor] | None,
) -> Float32[np.ndarray, "h w 3"]:
    """Return a panorama (sRGB in [0, 1]) without holes; observed pixels are unchanged, bit for bit.

    Holes are filled at the network's size, and the fill is enlarged and blended into the observed
    pixels. Without `weights` the colours are continued smoothly (Laplace).

    Raises:
        InputError: the panorama is not twice as wide as high, or no pixel was observed.
    """
    height, width = ldr.shape[:2]
    check_panorama_size(height, width)
    if not is_seen.any():
        raise InputError(
            "the panorama has no observed pixel, so its holes cannot be filled",
            expected="one observed pixel or more",
        )
    if is_seen.all():
        return ldr.copy()
    small_height = SMOOTH_HEIGHT_PX if weights is None else int(weights["height_px"])
    small, small_seen = downsample_observed(ldr, is_seen, small_height)
    if weights is None:
        filled = fill_by_laplace(small, small_seen)
    else:
        filled = fill_by_network(small[None], small_seen[None], weights)[0]
    large = filled if height == small_height else sample_bilinear(filled, pixel_directions(height))
    large = blend_into_observed(large, ldr, is_seen, _BLEND_PX * height / small_height)
    return np.where(is_seen[..., None], ldr, np.clip(large, 0.0, 1.0)).astype(np.float32)


def fill_by_network(
    ldr: Float32[np.ndarray, "n h w 3"],
    is_seen: Bool[np.ndarray, "n h w"],
    weights: Mapping[str, torch.Tensor],
) -> Float32[np.ndarray, "n h w 3"]:
    """Fill the holes with the generator's refined picture; the generator's stride must divide the
    size."""
    import torch

    from lightsim.lighting.panorama.inpaint_network import InpaintGenerator

    generator = InpaintGenerator.from_weights(weights)
    image = torch.from_numpy(np.ascontiguousarray(ldr.transpose(0, 3, 1, 2))) * 2 - 1
    hole = torch.from_numpy(~is_seen)[:, None].float()
    with torch.inference_mode():
        _, refined = generator(image, hole)
    filled = (refined.clamp(-1, 1).numpy().transpose(0, 2, 3, 1) + 1) / 2
    return np.where(is_seen[..., None], ldr, filled).astype(np.float32)


def fill_by_laplace(
    ldr: Float32[np.ndarray, "h w 3"], is_seen: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """Fill the holes by Laplace interpolation of the observed pixels, periodic in azimuth."""
    margin = ldr.shape[1] // 2
    around = np.pad(ldr, ((0, 0), (margin, margin), (0, 0)), mode="wrap").astype(np.float64)
    known = np.pad(is_seen, ((0, 0), (margin, margin)), mode="wrap")
    channels = [fill_smoothly(around[..., c], known)[:, margin:-margin] for c in range(3)]
    return np.stack(channels, axis=-1).astype(np.float32)


def fill_by_nearest(
    ldr: Float32[np.ndarray, "h w 3"], is_seen: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """Fill every hole pixel with the colour of the nearest observed one, periodic in azimuth."""
    margin = ldr.shape[1] // 2
    known = np.pad(is_seen, ((0, 0), (margin, margin)), mode="wrap")
    around = np.pad(ldr, ((0, 0), (margin, margin), (0, 0)), mode="wrap")
    return nearest_known(around, known)[:, margin:-margin]


def fill_by_rows(
    ldr: Float32[np.ndarray, "h w 3"], is_seen: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """Fill every hole pixel with the mean observed colour of its row, or of the nearest row that
    has observed pixels."""
    counts = is_seen.sum(axis=1)
    means = (ldr * is_seen[..., None]).sum(axis=1) / np.maximum(counts, 1)[:, None]
    rows = np.flatnonzero(counts)
    nearest = rows[np.abs(np.arange(len(counts))[:, None] - rows).argmin(axis=1)]
    return np.where(is_seen[..., None], ldr, means[nearest][:, None]).astype(np.float32)


def downsample_observed(
    ldr: Float32[np.ndarray, "h w 3"], is_seen: Bool[np.ndarray, "h w"], height_px: int
) -> tuple[Float32[np.ndarray, "h2 w2 3"], Bool[np.ndarray, "h2 w2"]]:
    """Return linear means of the observed pixels on a smaller grid; a pixel counts as observed if
    half of it was."""
    weight = is_seen[..., None].astype(np.float32)
    fraction = resize_area(weight, height_px, 2 * height_px)
    linear = resize_area(linear_from_srgb(ldr) * weight, height_px, 2 * height_px)
    seen = fraction[..., 0] >= min(0.5, float(fraction.max()))
    small = srgb_from_linear(linear / np.maximum(fraction, 1e-6)) * seen[..., None]
    return small.astype(np.float32), seen


def blend_into_observed(
    large: Float[np.ndarray, "h w 3"],
    ldr: Float32[np.ndarray, "h w 3"],
    is_seen: Bool[np.ndarray, "h w"],
    sigma_px: float,
) -> Float[np.ndarray, "h w 3"]:
    """Add the fill's error at the observed pixels to the holes nearby, with a Gaussian fall-off."""
    weight = is_seen[..., None].astype(np.float64)
    near = _blurred(weight, sigma_px)
    error = _blurred((ldr - large) * weight, sigma_px) / np.maximum(near, 1e-6)
    # At a straight border only half of the neighbourhood is observed, hence the factor 2.
    return large + error * np.clip(2 * near, 0.0, 1.0)


def _blurred(image: Float[np.ndarray, "h w c"], sigma_px: float) -> Float[np.ndarray, "h w c"]:
    """Gaussian blur, wrapped in azimuth."""
    wide = ndimage.gaussian_filter1d(image, sigma_px, axis=1, mode="wrap")
    return ndimage.gaussian_filter1d(wide, sigma_px, axis=0, mode="nearest")
