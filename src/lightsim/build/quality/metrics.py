"""Image scores on sRGB values in [0, 1], whole or over the valid pixels only.

What is not valid is filled with the truth in both images before SSIM and LPIPS look at
neighbourhoods, and left out of every mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.colour import linear_from_srgb, srgb_from_linear
from lightsim.errors import InputError

SSIM_BORDER_PX = 5
"""Half a window along the border has no SSIM."""
_SSIM_WINDOW_PX = 2 * SSIM_BORDER_PX + 1
_EXPOSURE_RANGE_EV = 6.0
_MAX_SAMPLES = 200_000


@dataclass(frozen=True)
class ImageScores:
    """Of one image, or the mean over several. LPIPS (on VGG-16, and on AlexNet) is NaN where it was
    not asked for."""

    psnr_db: float
    ssim: float
    lpips: float = float("nan")
    lpips_alex: float = float("nan")


def psnr(
    predicted_srgb: Float32[np.ndarray, "h w 3"],
    truth_srgb: Float32[np.ndarray, "h w 3"],
    is_valid: Bool[np.ndarray, "h w"] | None = None,
) -> float:
    """Peak signal-to-noise ratio in dB over the valid pixels; inf for equal images.

    Raises:
        InputError: no pixel is valid.
    """
    squared = np.square(predicted_srgb.astype(np.float64) - truth_srgb).mean(axis=-1)
    error = float(_select(squared, is_valid).mean())
    return float("inf") if error == 0 else float(-10 * np.log10(error))


def ssim(
    predicted_srgb: Float32[np.ndarray, "h w 3"],
    truth_srgb: Float32[np.ndarray, "h w 3"],
    is_valid: Bool[np.ndarray, "h w"] | None = None,
) -> float:
    """Structural similarity with the Gaussian window (sigma 1.5) of Wang et al. 2004
    (doi:10.1109/TIP.2003.819861), mean over channels and valid pixels.

    As in scikit-image, half a window along the image border does not count.

    Raises:
        InputError: no pixel is valid, or the image is smaller than the window.
    """
    filled = fill_invalid(predicted_srgb, truth_srgb, is_valid)
    return mean_ssim(ssim_map(filled, truth_srgb), is_valid)


def mean_ssim(
    similarity: Float32[np.ndarray, "h w"], is_valid: Bool[np.ndarray, "h w"] | None = None
) -> float:
    """Mean of `ssim_map` over the valid pixels.

    Raises:
        InputError: no pixel is valid, or only some along the border.
    """
    inner = np.s_[SSIM_BORDER_PX:-SSIM_BORDER_PX, SSIM_BORDER_PX:-SSIM_BORDER_PX]
    mask = None if is_valid is None else is_valid[inner]
    return float(_select(similarity[inner], mask).mean())


def ssim_map(
    predicted_srgb: Float32[np.ndarray, "h w 3"], truth_srgb: Float32[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w"]:
    """Structural similarity about each pixel, mean over the channels; see `ssim`.

    Raises:
        InputError: the image is smaller than the window.
    """
    from skimage.metrics import structural_similarity

    if min(truth_srgb.shape[:2]) < _SSIM_WINDOW_PX:
        raise InputError(
            "the image is too small for SSIM",
            got=f"{truth_srgb.shape[1]}x{truth_srgb.shape[0]} px",
            expected=f"at least {_SSIM_WINDOW_PX} px each way",
        )
    similarity = structural_similarity(
        predicted_srgb,
        truth_srgb,
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )[1]
    return similarity.mean(axis=-1).astype(np.float32)


def fill_invalid(
    image: Float32[np.ndarray, "h w 3"],
    truth: Float32[np.ndarray, "h w 3"],
    is_valid: Bool[np.ndarray, "h w"] | None,
) -> Float32[np.ndarray, "h w 3"]:
    """The image with the truth where it does not count."""
    return image if is_valid is None else np.where(is_valid[..., None], image, truth)


def fit_exposure(
    predicted_srgb: Sequence[Float32[np.ndarray, "_ 3"]],
    truth_srgb: Sequence[Float32[np.ndarray, "_ 3"]],
) -> float:
    """The factor on linear light that brings a sequence closest to its truth.

    One number for all images (lists of valid pixels); it minimises the squared error of the
    sRGB values, hence maximises the PSNR of the pooled pixels, within 6 stops either way.
    """
    from scipy.optimize import fminbound

    predicted = linear_from_srgb(np.concatenate(list(predicted_srgb)))
    truth = np.concatenate(list(truth_srgb))
    step = max(1, len(truth) // _MAX_SAMPLES)
    predicted, truth = predicted[::step], truth[::step]

    def error(exposure_ev: float) -> float:
        return float(np.square(srgb_from_linear(predicted * 2.0**exposure_ev) - truth).mean())

    # Clipping makes the error flat far away: start from the best of a coarse grid.
    grid = np.linspace(-_EXPOSURE_RANGE_EV, _EXPOSURE_RANGE_EV, 25)
    best = float(grid[int(np.argmin([error(float(ev)) for ev in grid]))])
    found = fminbound(error, best - 0.5, best + 0.5)
    return float(2.0 ** np.asarray(found))


def expose(srgb: Float32[np.ndarray, "h w 3"], factor: float) -> Float32[np.ndarray, "h w 3"]:
    """An sRGB image with its linear light multiplied by a factor."""
    return srgb_from_linear(linear_from_srgb(srgb) * factor).astype(np.float32)


def _select(values: np.ndarray, is_valid: Bool[np.ndarray, "h w"] | None) -> np.ndarray:
    if is_valid is None:
        return values
    if not is_valid.any():
        raise InputError("no pixel is left to score", remedy="Check the mask.")
    return values[is_valid]
