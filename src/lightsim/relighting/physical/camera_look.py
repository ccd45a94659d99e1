"""How sharp and how noisy a camera's pictures are, measured from the pictures themselves, so that
rendered parts look as if the same camera had recorded them.

Sharpness is a variance: that of the point spread beyond the pixel's own square, which renderers
have too. It is negative where the camera's own processing, or making pictures smaller, sharpens.
Noise is a variance that grows with the signal (Foi et al. 2008, doi:10.1109/TIP.2008.2001399), and
a correlation of neighbours, which demosaicing and JPEG leave. It is one for all channels: JPEG
keeps colour at half the resolution, and what it leaves of noise is grey (correlation of the
channels in smooth blocks of log 002: 0.8 to 0.9).
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
from lightsim.relighting.physical.edge_widths import PIXEL_PX2, SCALES_PX, find_edges, pile

_FEWEST_EDGES = 200
# No camera was seen to sharpen more; beyond, the Laplacian would need an endless weight.
_SHARPEST_PX2 = -0.4
# Side of the blocks whose spread around a plane is noise where nothing else is.
_BLOCK_PX = 16
# Noise is what the smoothest part of the blocks of like brightness shows.
_SMOOTHEST = 0.1
_BINS, _FEWEST_BLOCKS = 8, 10
_LEAST_VARIANCE = 1e-9
# Picture value whose photons make as much noise as reading out does, at most. Without a limit rough
# asphalt, the darkest that most pictures show, made dark cars noisy.
_READ_SIGNAL = 0.02
# Beyond 1 / sqrt(2) neighbours of neighbours would weigh more than neighbours.
_GRAINS = np.linspace(0.0, 0.7, 15)
_DARK = 3
"""8-bit codes up to which noise is cut off."""


@dataclass(frozen=True)
class CameraLook:
    """Sharpness and noise of one camera; of linear picture values, 1 is where they clip.

    Args:
        spread_px2: variance of the point spread beyond a pixel's square; negative: sharpened.
        noise_dark: variance of the noise at 0.
        noise_slope: what the variance grows by from 0 to 1.
        grain: weight of each neighbour's noise in a pixel's, along rows and columns.
    """

    spread_px2: float = 0.0
    noise_dark: float = 0.0
    noise_slope: float = 0.0
    grain: float = 0.0

    def noise_std(self, signal: Float32[np.ndarray, "*n"]) -> Float32[np.ndarray, "*n"]:
        """Standard deviation of the noise at picture values."""
        variance = self.noise_dark + self.noise_slope * np.clip(signal, 0.0, 1.0)
        return np.sqrt(variance).astype(np.float32)


def measure_look(
    pictures: Iterable[UInt8[np.ndarray, "h w 3"]], is_left_out: Bool[np.ndarray, "h w"]
) -> CameraLook:
    """The look of a camera by some of its pictures.

    Args:
        is_left_out: pixels that tell nothing of it: the ego vehicle's own.

    Returns:
        What too few edges or smooth blocks tell is 0: as rendered.
    """
    widths, blocks = [], []
    for srgb8 in pictures:
        grey = luminance(linear_from_srgb8(srgb8))
        is_cut = (srgb8 >= CLIPPED_CODE).any(axis=-1) | (srgb8 <= _DARK).all(axis=-1) | is_left_out
        codes = srgb_from_linear(grey).astype(np.float64)
        widths.append(find_edges(codes, is_cut).spread_px2)
        blocks.append(_blocks(grey.astype(np.float64))[_blocks(~is_cut).all(axis=1)])
    edges = np.concatenate(widths)
    spread = pile(edges) if len(edges) >= _FEWEST_EDGES else 0.0
    return CameraLook(spread, *_noise(np.concatenate(blocks)))


def blurred(
    image: Float32[np.ndarray, "h w *c"], look: CameraLook
) -> Float32[np.ndarray, "h w *c"]:
    """What the lens leaves of a rendered image, linear; the same where the camera sharpens."""
    sigma = float(np.sqrt(max(look.spread_px2, 0.0)))
    return ndimage.gaussian_filter(image, sigma, mode="nearest", axes=(0, 1))


def blur_reach_px(look: CameraLook) -> int:
    """How far `blurred` carries anything."""
    return int(np.ceil(4 * np.sqrt(max(look.spread_px2, 0.0))))


def sharpened(
    codes: Float32[np.ndarray, "h w *c"], look: CameraLook
) -> Float32[np.ndarray, "h w *c"]:
    """A picture's sRGB codes, in [0, 1], as the camera sharpens them: a pixel against its four
    neighbours."""
    weight = _sharpening(look.spread_px2)
    kernel = [-weight, 2 * weight, -weight]
    rise = sum(ndimage.convolve1d(codes, kernel, axis=axis, mode="nearest") for axis in (0, 1))
    return (codes + rise).astype(np.float32)


def _sharpening(spread_px2: float) -> float:
    """Weight of each neighbour that makes the gradients of a rendered edge fall between the two
    scales as those of the recorded edges do: the second difference of a Gaussian of variance V at
    its top is 2 (1 - exp(-1 / 2V)) of it."""
    known = np.square(SCALES_PX[:2]) + 1 / 3 + PIXEL_PX2
    fine, coarse = 2 * (1 - np.exp(-0.5 / known))
    spread_px2 = min(max(spread_px2, _SHARPEST_PX2), 0.0)
    fall = np.sqrt((known[1] + spread_px2) / (known[0] + spread_px2) * known[0] / known[1])
    return float((fall - 1) / (fine - fall * coarse))


def noise_like(
    signal: Float32[np.ndarray, "h w"], look: CameraLook, rng: np.random.Generator
) -> Float32[np.ndarray, "h w"]:
    """The noise that the camera would have recorded at these picture values."""
    kernel = np.array([look.grain, 1.0, look.grain], np.float32)
    kernel /= np.sqrt(np.square(kernel).sum())
    noise = rng.standard_normal(signal.shape, dtype=np.float32)
    for axis in (0, 1):
        noise = ndimage.convolve1d(noise, kernel, axis=axis, mode="wrap")
    return (noise * look.noise_std(signal)).astype(np.float32)


def _blocks(image: np.ndarray) -> np.ndarray:
    """Squares of the image, [n, pixels]."""
    n = _BLOCK_PX
    rows, columns = (size // n for size in image.shape)
    cut = image[: rows * n, : columns * n].reshape(rows, n, columns, n)
    return cut.swapaxes(1, 2).reshape(-1, n * n)


def _without_plane() -> Float64[np.ndarray, "k k"]:
    """The projection that takes a plane out of a block."""
    y, x = np.indices((_BLOCK_PX, _BLOCK_PX)).reshape(2, -1)
    plane = np.linalg.qr(np.stack([np.ones(len(x)), x, y], axis=1))[0]
    return np.eye(len(x)) - plane @ plane.T


def _noise(blocks: Float64[np.ndarray, "n k"]) -> tuple[float, float, float]:
    """Noise at 0, its slope and its grain, by the smoothest blocks of each brightness."""
    from scipy.optimize import nnls

    signal = blocks.mean(axis=1)
    rest = blocks @ _without_plane()
    spread = np.square(rest).mean(axis=1)
    found, covariance = [], []
    for inside in np.array_split(np.argsort(signal, kind="stable"), _BINS):
        if len(inside) < _FEWEST_BLOCKS:
            return 0.0, 0.0, 0.0
        # Their median is the wanted quantile of all.
        limit = np.quantile(spread[inside], 2 * _SMOOTHEST)
        smooth = inside[spread[inside] <= limit]
        found.append((signal[smooth].mean(), np.median(spread[smooth])))
        covariance.append(np.median(_beside(rest[smooth]) / np.maximum(spread[smooth], 1e-12)))
    at, variance = np.array(found).T
    grain, kept = _grain(float(np.median(covariance)))
    variance = np.maximum(variance / kept - _rounding(at), _LEAST_VARIANCE)
    # Relative errors count: texture, which only adds, hardly does.
    model = np.stack([at + _READ_SIGNAL, at], axis=1) / variance[:, None]
    both, photons = (float(x) for x in nnls(model, np.ones_like(variance))[0])
    return _READ_SIGNAL * both, both + photons, grain


def _beside(rest: Float64[np.ndarray, "n k"]) -> Float64[np.ndarray, " n"]:
    """Mean product of neighbours in blocks."""
    square = rest.reshape(-1, _BLOCK_PX, _BLOCK_PX)
    along = (square[:, :, 1:] * square[:, :, :-1]).mean(axis=(1, 2))
    across = (square[:, 1:] * square[:, :-1]).mean(axis=(1, 2))
    return (along + across) / 2


def _grain(correlation: float) -> tuple[float, float]:
    """The grain whose noise correlates so between neighbours when a plane is taken out of blocks,
    and the part of its variance that is left then."""
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
    """Variance of the luminance that 8-bit codes add, at picture values; added anew when the
    picture is coded."""
    codes = 255 * srgb_from_linear(signal).astype(np.float64)
    ends = linear_from_srgb((codes[:, None] + [-0.5, 0.5]) / 255).astype(np.float64)
    step = ends[:, 1] - ends[:, 0]
    return step**2 / 12 * float(np.square(LUMINANCE_WEIGHTS).sum())
