"""Removal of the recorded picture's noise where relighting would amplify it.

Relighting amplifies deep shade that the target sky lights, and its sensor noise. Non-local means
(Buades et al. 2005, doi:10.1109/CVPR.2005.38) preserve texture that repeats within a few pixels.
The filter strength follows the noise measured in the picture, so a clean picture is unchanged.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int64
from scipy import ndimage

# Side of the compared patches, in pixels; sensitivity not measured.
_PATCH_PX = 5
# Radius of the search window, in pixels; sensitivity not measured.
_REACH_PX = 5
# Strength of the filter, in standard deviations of the noise (scikit-image advises 0.6 to 0.8).
_STRENGTH = 0.6
# Immerkaer's second difference: its response to planes and straight edges is small.
_NOISE_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)


def denoised_where_amplified(
    radiance: Float32[np.ndarray, "h w 3"], factor: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return the picture, denoised where it is amplified.

    Pixels with a factor of 2 or more are denoised, pixels with a factor of 1 or less are unchanged;
    those between are blended.

    Args:
        radiance: linear, 0 or more.
        factor: factor by which each pixel will be multiplied.
    """
    weight = np.clip(np.log2(np.maximum(factor, np.float32(1e-6))), 0.0, 1.0)[..., None]
    rows, columns = (np.flatnonzero((weight > 0).any(axis=(axis, 2))) for axis in (1, 0))
    if len(rows) == 0:
        return radiance
    from skimage.restoration import denoise_nl_means

    # The square root gives photon noise a constant variance.
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
    """Slices of the part of the picture that the rows and columns span, with the filter's
    margin."""
    margin = _PATCH_PX // 2 + _REACH_PX
    first = (max(int(found[0]) - margin, 0) for found in (rows, columns))
    last = (int(found[-1]) + margin + 1 for found in (rows, columns))
    across, along = (slice(*ends) for ends in zip(first, last, strict=True))
    return across, along


def noise_std(image: Float32[np.ndarray, "h w c"]) -> float:
    """Standard deviation of a channel's noise from second differences, which suppress texture and
    edges (Immerkaer 1996, doi:10.1006/cviu.1996.0060, with the median in place of the mean)."""
    size = float(np.sqrt(np.square(_NOISE_KERNEL).sum()))
    deviations = [
        np.median(np.abs(ndimage.convolve(image[..., channel], _NOISE_KERNEL, mode="nearest")))
        for channel in range(image.shape[2])
    ]
    # 0.6745: median of the absolute value of a standard normal variable.
    return float(np.mean(deviations)) / (size * 0.6745)
