"""Combination of observed sky and analytic sky in one dome."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy import ndimage

from lightsim.core.twin import Panorama

# Width of the transition from observed to analytic sky, in dome pixels. Chosen by eye.
_FEATHER_PX = 6.0
# Angle over which the observed sky's colour is extended into the unobserved part, in degrees;
# sensitivity not measured.
_CORRECTION_DEG = 12.0


def blend_observed(
    panorama: Panorama,
    analytic: Float32[np.ndarray, "h w 3"],
) -> Float32[np.ndarray, "h w 3"]:
    """Blend the observed sky into the analytic one.

    Near the observed part, the analytic sky is corrected towards its colour; the border is
    feathered. Saturated sky is at least as bright as the model. The lower half is black.
    """
    height = len(analytic)
    seen = panorama.is_sky & panorama.is_seen
    observed, coverage = shrink_masked(panorama.radiance, seen, height)
    _, clipped = shrink_masked(panorama.radiance, seen & panorama.is_clipped, height)
    model = analytic.astype(np.float64)
    upper = np.zeros(coverage.shape, dtype=bool)
    upper[: height // 2] = True
    is_seen = (coverage > 0.5) & upper
    is_bright = is_seen & (clipped > 0)
    observed[is_bright] = np.maximum(observed[is_bright], model[is_bright])
    if not is_seen.any():
        return analytic
    # The correction is limited to a factor of 5, so that single bad pixels do not dominate it.
    near = np.clip(observed / np.maximum(model, 1e-6), 0.2, 5.0)
    # Saturated pixels are excluded: their radiance is only a lower limit.
    log_ratio = np.log(near) * (is_seen & ~is_bright)[..., None]
    sigma_px = _CORRECTION_DEG / 180.0 * height
    support = _blur((is_seen & ~is_bright).astype(np.float64), sigma_px)
    extended = np.stack([_blur(log_ratio[..., c], sigma_px) for c in range(3)], axis=-1)
    corrected = model * np.exp(extended / (support + 0.05)[..., None])
    weight = _feathered(is_seen)
    blended = corrected + weight[..., None] * (observed - corrected)
    blended[height // 2 :] = 0.0
    return blended.astype(np.float32)


def unseen_weight(panorama: Panorama, height_px: int) -> Float[np.ndarray, "h w"]:
    """Weight of the model in a dome of that height: 1 where the sky was not observed, 0 where it
    was observed and on the ground, with a soft transition."""
    _, coverage = shrink_masked(panorama.radiance, panorama.is_sky & panorama.is_seen, height_px)
    weight = 1.0 - _feathered(coverage > 0.5)
    weight[height_px // 2 :] = 0.0
    return weight


def _feathered(is_seen: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Weight that is 1 inside the observed sky and falls to 0 at its border; the horizon is no
    border."""
    height = len(is_seen)
    # Three copies side by side, so that distances wrap around in azimuth.
    padded = np.concatenate([is_seen] * 3, axis=1)
    padded[height // 2 :] = True
    inside = np.asarray(ndimage.distance_transform_edt(padded))[:, 2 * height : 4 * height]
    return np.clip(inside / _FEATHER_PX, 0.0, 1.0) * is_seen


def _blur(image: Float[np.ndarray, "h w"], sigma_px: float) -> Float[np.ndarray, "h w"]:
    """Gaussian blur, wrapping around in azimuth."""
    rows = ndimage.gaussian_filter1d(image, sigma_px, axis=0, mode="nearest")
    return np.asarray(ndimage.gaussian_filter1d(rows, sigma_px, axis=1, mode="wrap"))


def shrink_masked(
    image: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], height_px: int
) -> tuple[Float[np.ndarray, "a b 3"], Float[np.ndarray, "a b"]]:
    """Mean over the masked pixels of each cell, and the fraction of the cell that is masked."""
    row = (np.arange(image.shape[0]) * height_px) // image.shape[0]
    column = (np.arange(image.shape[1]) * 2 * height_px) // image.shape[1]
    index = (row[:, None] * 2 * height_px + column[None, :]).ravel()
    count = 2 * height_px * height_px
    number = np.bincount(index, mask.ravel(), minlength=count)
    size = np.bincount(index, minlength=count)
    sums = [np.bincount(index, (image[..., c] * mask).ravel(), minlength=count) for c in range(3)]
    mean = np.stack(sums, axis=-1) / np.maximum(number, 1)[:, None]
    shape = (height_px, 2 * height_px)
    return mean.reshape(*shape, 3), (number / np.maximum(size, 1)).reshape(shape)
