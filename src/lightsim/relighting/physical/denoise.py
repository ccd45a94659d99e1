"""Noise of the recorded picture taken out where relighting would amplify it.

Deep shade that another sky lights up is multiplied, and its sensor noise with it. Non-local means
(Buades et al. 2005, doi:10.1109/CVPR.2005.38) keep texture that repeats within a few pixels; at the
noise that the picture itself shows, a clean picture stays as it is.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int64
from scipy import ndimage

_PATCH_PX, _REACH_PX = 5, 5
_STRENGTH = 0.6
"""Of the filter, in standard deviations of the noise (scikit-image advises 0.6 to 0.8)."""
_NOISE_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_MEDIAN_OF_NORMAL = 0.6745
"""Median of the absolute value of a standard normal."""


def denoised_where_amplified(
    radiance: Float32[np.ndarray, "h w 3"], factor: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """The picture without its noise where it is multiplied by 2 and more, as it is up to 1, and
    mixed between.

    Args:
        radiance: linear, 0 or more.
        factor: by which each pixel is about to be multiplied.
    """
    weight = np.clip(np.log2(np.maximum(factor, np.float32(1e-6))), 0.0, 1.0)[..., None]
    rows, columns = (np.flatnonzero((weight > 0).any(axis=(axis, 2))) for axis in (1, 0))
    if len(rows) == 0:
        return radiance
    from skimage.restoration import denoise_nl_means

    # The root makes the noise of photons even.
    root = np.sqrt(np.maximum(radiance, 0.0))
    sigma = noise_std(root)
    if sigma == 0:
        return radiance
    part = _around(rows, columns)
    smooth = denoise_nl_means(
        root[part],
        patch_size=_PATCH_PX,
        patch_distance=_REACH_PX,
        h=_STRENGTH * sigma,
        sigma=sigma,
        fast_mode=True,
        channel_axis=-1,
    )
    result = radiance.copy()
    result[part] += weight[part] * (np.square(smooth) - radiance[part])
    return result


def _around(rows: Int64[np.ndarray, " r"], columns: Int64[np.ndarray, " c"]) -> tuple[slice, slice]:
    """The part of the picture that they span, and as far around it as the filter looks."""
    margin = _PATCH_PX // 2 + _REACH_PX
    first = (max(int(found[0]) - margin, 0) for found in (rows, columns))
    last = (int(found[-1]) + margin + 1 for found in (rows, columns))
    across, along = (slice(*ends) for ends in zip(first, last, strict=True))
    return across, along


def noise_std(image: Float32[np.ndarray, "h w c"]) -> float:
    """Standard deviation of the noise of a channel, from second differences, which texture and
    edges hardly have (Immerkaer 1996, doi:10.1006/cviu.1996.0060; the median in place of the mean).
    """
    size = float(np.sqrt(np.square(_NOISE_KERNEL).sum()))
    deviations = [
        np.median(np.abs(ndimage.convolve(image[..., channel], _NOISE_KERNEL, mode="nearest")))
        for channel in range(image.shape[2])
    ]
    return float(np.mean(deviations)) / (size * _MEDIAN_OF_NORMAL)
