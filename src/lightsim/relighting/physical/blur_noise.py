"""Estimate blur and noise of a camera from its pictures, to apply them to rendered actors.

Blur is the variance of the camera's point spread function in excess of the pixel's box filter,
which renderers also have. It is negative if the camera's processing, or downsampling of the
pictures, sharpens. The noise variance grows with the signal (Foi et al. 2008,
doi:10.1109/TIP.2008.2001399); demosaicing and JPEG correlate neighbouring pixels. All channels have
equal noise: JPEG stores colour at half the resolution, so the remaining noise is grey (correlation
of the channels in smooth blocks of log 002: 0.8 to 0.9; no script repeats this).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from scipy import ndimage
from scipy.linalg import toeplitz

from lightsim.core.colour import (
    CLIPPED_CODE,
    LUMINANCE_WEIGHTS,
    linear_from_srgb,
    linear_from_srgb8,
    luminance,
    srgb_from_linear,
)
from lightsim.relighting.physical.edge_widths import (
    PIXEL_PX2,
    SCALES_PX,
    find_edges,
    half_sample_mode,
)

# Sensitivity to the counts below was not measured.

# Minimum number of edges for an estimate of blur.
_MIN_EDGES = 200
# Lower limit of the variance, in px^2: beyond it the weight of the Laplacian diverges. Chosen;
# sensitivity not measured.
_MIN_VARIANCE_PX2 = -0.4
# Side of the blocks, in pixels, whose variance around a plane is noise in smooth regions.
_BLOCK_PX = 16
# Quantile of the variance among blocks of similar brightness that is used as noise, because texture
# only increases the variance.
_NOISE_QUANTILE = 0.1
# Number of brightness bins.
_BINS = 8
# Minimum number of blocks in a bin.
_MIN_BLOCKS = 10

# Maximum picture value at which photon noise equals read-out noise. Without this limit, the texture
# of asphalt, the darkest surface of most pictures, increased the noise of dark cars.
_READ_SIGNAL = 0.02
# Candidate grains. The correlation of neighbours has its maximum at 1 / sqrt(2), so that larger
# grains cannot be identified from it.
_GRAINS = np.linspace(0.0, 0.7, 15)
# 8-bit codes up to which noise is truncated at 0.
_DARK = 3


@dataclass(frozen=True)
class CameraBlurNoise:
    """Blur and noise of one camera, for linear picture values that clip at 1.

    Args:
        spread_px2: variance of the blur beyond a pixel's square; negative if the camera sharpens.
        noise_dark: variance of the noise at 0.
        noise_slope: increase of the variance from 0 to 1.
        grain: weight of each neighbour's noise in a pixel's noise, along rows and columns.
    """

    spread_px2: float = 0.0
    noise_dark: float = 0.0
    noise_slope: float = 0.0
    grain: float = 0.0

    def noise_std(self, signal: Float32[np.ndarray, "*n"]) -> Float32[np.ndarray, "*n"]:
        """Standard deviation of the noise at given picture values."""
        variance = self.noise_dark + self.noise_slope * np.clip(signal, 0.0, 1.0)
        return np.sqrt(variance).astype(np.float32)


def estimate_blur_noise(
    pictures: Iterable[UInt8[np.ndarray, "h w 3"]], is_left_out: Bool[np.ndarray, "h w"]
) -> CameraBlurNoise:
    """Estimate blur and noise of a camera from some of its pictures.

    Args:
        is_left_out: pixels to ignore: those of the ego vehicle.

    Returns:
        The look. Sharpness or noise is 0 (as rendered) if there are too few edges or smooth blocks.
    """
    widths, blocks = [], []
    for srgb8 in pictures:
        grey = luminance(linear_from_srgb8(srgb8))
        is_cut = (srgb8 >= CLIPPED_CODE).any(axis=-1) | (srgb8 <= _DARK).all(axis=-1) | is_left_out
        codes = srgb_from_linear(grey).astype(np.float64)
        widths.append(find_edges(codes, is_cut).spread_px2)
        blocks.append(_blocks(grey.astype(np.float64))[_blocks(~is_cut).all(axis=1)])
    edges = np.concatenate(widths)
    variance = half_sample_mode(edges) if len(edges) >= _MIN_EDGES else 0.0
    return CameraBlurNoise(variance, *_noise(np.concatenate(blocks)))


def blurred(
    image: Float32[np.ndarray, "h w *c"], blur_noise: CameraBlurNoise
) -> Float32[np.ndarray, "h w *c"]:
    """Rendered image, linear, blurred by the lens; unchanged if the camera sharpens."""
    sigma = float(np.sqrt(max(blur_noise.spread_px2, 0.0)))
    return ndimage.gaussian_filter(image, sigma, mode="nearest", axes=(0, 1))


def blur_reach_px(blur_noise: CameraBlurNoise) -> int:
    """Radius of the kernel of `blurred`, in pixels."""
    return int(np.ceil(4 * np.sqrt(max(blur_noise.spread_px2, 0.0))))


def sharpened(
    codes: Float32[np.ndarray, "h w *c"], blur_noise: CameraBlurNoise
) -> Float32[np.ndarray, "h w *c"]:
    """Sharpen a picture's sRGB codes, in [0, 1], as the camera does: a pixel against its four
    neighbours."""
    weight = _sharpening(blur_noise.spread_px2)
    kernel = [-weight, 2 * weight, -weight]
    rise = sum(ndimage.convolve1d(codes, kernel, axis=axis, mode="nearest") for axis in (0, 1))
    return (codes + rise).astype(np.float32)


def _sharpening(spread_px2: float) -> float:
    """Weight of each neighbour with which rendered edges have the gradient ratio of the recorded
    edges.

    The ratio is that of the gradients under the two finer filters. The second difference of a
    Gaussian of variance V at its top is 2 (1 - exp(-1 / 2V)) of its value.
    """
    known = np.square(SCALES_PX[:2]) + 1 / 3 + PIXEL_PX2
    fine, coarse = 2 * (1 - np.exp(-0.5 / known))
    spread_px2 = min(max(spread_px2, _MIN_VARIANCE_PX2), 0.0)
    fall = np.sqrt((known[1] + spread_px2) / (known[0] + spread_px2) * known[0] / known[1])
    return float((fall - 1) / (fine - fall * coarse))


def camera_noise(
    signal: Float32[np.ndarray, "h w"], blur_noise: CameraBlurNoise, rng: np.random.Generator
) -> Float32[np.ndarray, "h w"]:
    """Random noise with the camera's variance and grain at these picture values."""
    # Normalised, so that filtering changes the correlation of the noise but not its variance.
    kernel = np.array([blur_noise.grain, 1.0, blur_noise.grain], np.float32)
    kernel /= np.sqrt(np.square(kernel).sum())
    noise = rng.standard_normal(signal.shape, dtype=np.float32)
    for axis in (0, 1):
        noise = ndimage.convolve1d(noise, kernel, axis=axis, mode="wrap")
    return (noise * blur_noise.noise_std(signal)).astype(np.float32)


def _blocks(image: np.ndarray) -> np.ndarray:
    """Square blocks of the image, [n, pixels]."""
    n = _BLOCK_PX
    rows, columns = (size // n for size in image.shape)
    cut = image[: rows * n, : columns * n].reshape(rows, n, columns, n)
    return cut.swapaxes(1, 2).reshape(-1, n * n)


def _without_plane() -> Float64[np.ndarray, "k k"]:
    """Projection that removes the best-fitting plane of a block."""
    y, x = np.indices((_BLOCK_PX, _BLOCK_PX)).reshape(2, -1)
    plane = np.linalg.qr(np.stack([np.ones(len(x)), x, y], axis=1))[0]
    return np.eye(len(x)) - plane @ plane.T


def _noise(blocks: Float64[np.ndarray, "n k"]) -> tuple[float, float, float]:
    """Noise variance at 0, its slope and the grain, from the smoothest blocks of each
    brightness."""
    from scipy.optimize import nnls

    signal = blocks.mean(axis=1)
    rest = blocks @ _without_plane()
    scatter = np.square(rest).mean(axis=1)
    found, covariance = [], []
    for inside in np.array_split(np.argsort(signal, kind="stable"), _BINS):
        if len(inside) < _MIN_BLOCKS:
            return 0.0, 0.0, 0.0
        # The median of the lower part is the required quantile of all blocks.
        limit = np.quantile(scatter[inside], 2 * _NOISE_QUANTILE)
        smooth = inside[scatter[inside] <= limit]
        found.append((signal[smooth].mean(), np.median(scatter[smooth])))
        covariance.append(np.median(_beside(rest[smooth]) / np.maximum(scatter[smooth], 1e-12)))
    at, variance = np.array(found).T
    grain, kept = _grain(float(np.median(covariance)))
    variance = np.maximum(variance / kept - _rounding(at), 1e-9)
    # Relative errors, so that bins with texture, whose variance is too large, count little.
    model = np.stack([at + _READ_SIGNAL, at], axis=1) / variance[:, None]
    both, photons = (float(x) for x in nnls(model, np.ones_like(variance))[0])
    return _READ_SIGNAL * both, both + photons, grain


def _beside(rest: Float64[np.ndarray, "n k"]) -> Float64[np.ndarray, " n"]:
    """Mean product of neighbouring pixels in each block."""
    square = rest.reshape(-1, _BLOCK_PX, _BLOCK_PX)
    along = (square[:, :, 1:] * square[:, :, :-1]).mean(axis=(1, 2))
    across = (square[:, 1:] * square[:, :-1]).mean(axis=(1, 2))
    return (along + across) / 2


def _grain(correlation: float) -> tuple[float, float]:
    """Return the grain with this correlation between neighbours after a plane is removed, and the
    fraction of the variance that remains."""
    rest = _without_plane()
    found = []
    for grain in _GRAINS:
        size = 1 + 2 * grain**2
        row = np.zeros(_BLOCK_PX)
        row[:3] = 1.0, 2 * grain / size, grain**2 / size
        line = toeplitz(row)
        left = rest @ np.kron(line, line) @ rest
        kept = float(np.trace(left)) / len(left)
        lines = left.reshape([_BLOCK_PX] * 4)
        beside = np.einsum("ijij->ij", lines[:, 1:, :, :-1]).mean()
        found.append((beside / kept, grain, kept))
    known, grains, kept = np.array(found).T
    grain = float(np.interp(correlation, known, grains))
    return grain, float(np.interp(grain, grains, kept))


def _rounding(signal: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Variance of the luminance that rounding to 8-bit codes adds at given picture values; it is
    subtracted because coding the picture adds it again."""
    codes = 255 * srgb_from_linear(signal).astype(np.float64)
    ends = linear_from_srgb((codes[:, None] + [-0.5, 0.5]) / 255).astype(np.float64)
    step = ends[:, 1] - ends[:, 0]
    return step**2 / 12 * float(np.square(LUMINANCE_WEIGHTS).sum())
