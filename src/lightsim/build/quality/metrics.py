"""Image scores on sRGB values in [0, 1], over all or only the valid pixels.

Invalid pixels are replaced by the truth in both images, because SSIM and LPIPS evaluate
neighbourhoods, and are left out of every mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.colour import linear_from_srgb, srgb_from_linear
from lightsim.errors import InputError

SSIM_BORDER_PX = 5
"""Half a window of SSIM: pixels closer to the border have no value."""
_SSIM_WINDOW_PX = 2 * SSIM_BORDER_PX + 1  # 11, as in Wang et al. 2004.
# Range of the fitted exposure, in stops either way. Chosen: a prediction that is off by more is
# wrong otherwise, too.
_EXPOSURE_RANGE_EV = 6.0
# Largest number of pixels from which the exposure is fitted, for speed. Chosen; sensitivity not
# measured.
_MAX_SAMPLES = 200_000


@dataclass(frozen=True)
class ImageScores:
    """Scores of one image, or means over several. LPIPS (with VGG-16, and with AlexNet) is NaN if
    it was not computed."""

    psnr_db: float
    ssim: float
    lpips: float = float("nan")
    lpips_alex: float = float("nan")


def psnr(
    predicted_srgb: Float32[np.ndarray, "h w 3"],
    truth_srgb: Float32[np.ndarray, "h w 3"],
    is_valid: Bool[np.ndarray, "h w"] | None = None,
) -> float:
    """Return the peak signal-to-noise ratio over the valid pixels, in dB; inf for equal images.

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
    """Return the structural similarity with the Gaussian window (sigma 1.5) of Wang et al. 2004
    (doi:10.1109/TIP.2003.819861), mean over channels and valid pixels.

    As in scikit-image, half a window along the image border is left out.

    Raises:
        InputError: no pixel is valid, or the image is smaller than the window.
    """
    filled = fill_invalid(predicted_srgb, truth_srgb, is_valid)
    return mean_ssim(ssim_map(filled, truth_srgb), is_valid)


def mean_ssim(
    similarity: Float32[np.ndarray, "h w"], is_valid: Bool[np.ndarray, "h w"] | None = None
) -> float:
    """Return the mean of `ssim_map` over the valid pixels.

    Raises:
        InputError: no pixel is valid, or only some along the border.
    """
    inner = np.s_[SSIM_BORDER_PX:-SSIM_BORDER_PX, SSIM_BORDER_PX:-SSIM_BORDER_PX]
    mask = None if is_valid is None else is_valid[inner]
    return float(_select(similarity[inner], mask).mean())


def ssim_map(
    predicted_srgb: Float32[np.ndarray, "h w 3"], truth_srgb: Float32[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w"]:
    """Return the structural similarity at each pixel, mean over the channels; see `ssim`.

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
    # The parameters of Wang et al.; those that scikit-image has by default differ.
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
    """Return the image with the truth in invalid pixels."""
    return image if is_valid is None else np.where(is_valid[..., None], image, truth)


def fit_exposure(
    predicted_srgb: Sequence[Float32[np.ndarray, "_ 3"]],
    truth_srgb: Sequence[Float32[np.ndarray, "_ 3"]],
) -> float:
    """Fit the factor on linear light that minimises the distance of a sequence to its truth.

    One number for all images (lists of valid pixels); it minimises the squared error of the
    sRGB values, hence maximises the PSNR of the pooled pixels, within 6.5 stops either way.
    """
    from scipy.optimize import fminbound

    predicted = linear_from_srgb(np.concatenate(list(predicted_srgb)))
    truth = np.concatenate(list(truth_srgb))
    step = max(1, len(truth) // _MAX_SAMPLES)
    predicted, truth = predicted[::step], truth[::step]

    def error(exposure_ev: float) -> float:
        return float(np.square(srgb_from_linear(predicted * 2.0**exposure_ev) - truth).mean())

    # Clipping makes the error flat far from the optimum: start from the best of a grid in steps of
    # half a stop.
    grid = np.linspace(-_EXPOSURE_RANGE_EV, _EXPOSURE_RANGE_EV, 25)
    best = float(grid[int(np.argmin([error(float(ev)) for ev in grid]))])
    found = fminbound(error, best - 0.5, best + 0.5)
    return float(2.0 ** np.asarray(found))


def expose(srgb: Float32[np.ndarray, "h w 3"], factor: float) -> Float32[np.ndarray, "h w 3"]:
    """Return an sRGB image with its linear light multiplied by a factor."""
    return srgb_from_linear(linear_from_srgb(srgb) * factor).astype(np.float32)


def _select(values: np.ndarray, is_valid: Bool[np.ndarray, "h w"] | None) -> np.ndarray:
    if is_valid is None:
        return values
    if not is_valid.any():
        raise InputError("no pixel is left to score", remedy="Check the mask.")
    return values[is_valid]
