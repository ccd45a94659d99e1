"""Soft borders of the sky matte at full resolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from lightsim.core.colour import linear_from_srgb8
from lightsim.masks.sky_regions import ImageEvidence

# Sensitivity of the matte to these constants is not measured; tests/masks has the cases that must
# not fail.

# Neighbourhood of eight pixels for connected parts.
_SQUARE = np.ones((3, 3), dtype=bool)
# Half width of the soft border, in working pixels.
_BORDER_PX = 3
# Position on the line from the mean other colour (0) to the mean sky colour (1) below which a pixel
# has no sky.
_FOOT = 0.2
# Distance from the mean sky colour within which a pixel is all sky, in standard deviations of the
# sky; on the same line it is at least `_FOOT` and at most the limit below.
_SHOULDER_DEVIATIONS = 2.0
# Largest distance from the mean sky colour within which a pixel is all sky.
_WIDEST_SHOULDER = 0.6
# Linear light of the surroundings of a thin line below which it cannot be detected.
_DARK_SURROUNDINGS = 0.02
# Relative drop of light that is noise.
_NOISE = 0.12
# Largest light of a line relative to its surroundings. A line narrower than a pixel is paler than
# this in every pixel, and its fraction is measured relative to this value.
_PALEST_LINE = 0.35
# Half of the largest width of a line, as a fraction of the image's width.
_WIDEST_LINE = 1 / 320
# Least length of a line that ends in the open sky (dashes of a faint wire count as one line), as a
# fraction of the image's width; shorter ones are texture of clouds.
_SHORTEST_LINE = 1 / 50
# Largest ratio of width to length of such a line: wires have 0.03 to 0.1, texture of clouds has 0.3
# to 0.5.
_BROADEST_LINE = 0.2


@dataclass(frozen=True, eq=False)
class SkyMatte:
    """Fraction of each pixel that is sky, from 0 to 1.

    Args:
        expected: expected fraction: 0.8 for a cloud that is sky with probability 0.8. Used for
            reconstruction, because uncertain sky does not prove free space.
        likeliest: maximum a posteriori matte, with the alpha of each region thresholded at 0.5.
            Used for compositing, because 0.8 would leave a fifth of the recorded sky.
    """

    expected: Float32[np.ndarray, "h w"]
    likeliest: Float32[np.ndarray, "h w"]


def refine_matte(
    srgb8: UInt8[np.ndarray, "h w 3"],
    probability: Float32[np.ndarray, "a b"],
    evidence: ImageEvidence,
) -> SkyMatte:
    """Compute the matte at full size from the probability of sky at working width.

    A pixel at a border is a mix of the mean sky colour and the mean other colour nearby (Bayesian
    matting, Chuang et al. 2001, doi:10.1109/CVPR.2001.990970, with one Gaussian per side). Inside
    the sky, the fraction that thin dark lines (wires, twigs) cover is subtracted.
    """
    height, width = srgb8.shape[:2]
    is_sky = probability > 0.5
    if not is_sky.any():
        return SkyMatte(*np.zeros((2, height, width), np.float32))
    is_border = _resize(_border(is_sky).astype(np.float32), height, width) > 0.5
    sky, other, covariance, reliable = _local_colours(srgb8, is_sky)
    rows, columns = np.nonzero(is_border)
    pixels = srgb8[rows, columns].astype(np.float32) / np.float32(255.0)
    r = np.minimum(rows * is_sky.shape[0] // height, is_sky.shape[0] - 1)
    c = np.minimum(columns * is_sky.shape[1] // width, is_sky.shape[1] - 1)
    line = sky[r, c] - other[r, c]
    length2 = np.sum(line**2, axis=1)
    fraction = np.sum((pixels - other[r, c]) * line, axis=1) / np.maximum(length2, 1e-4)
    # Both sides vary around their means, a sky with clouds in front of the sun by as much as the
    # means differ. The foot and the shoulder of this variation are mapped to 0 and 1.
    variance = np.einsum("na,nab,nb->n", line, covariance[r, c], line)
    deviation = np.sqrt(np.maximum(variance, 0.0)) / np.maximum(length2, 1e-4)
    shoulder = 1 - np.clip(_SHOULDER_DEVIATIONS * deviation, _FOOT, _WIDEST_SHOULDER)
    fraction = np.clip((fraction - _FOOT) / (shoulder - _FOOT), 0.0, 1.0)
    trust = np.clip(length2 / 0.01, 0.0, 1.0) * reliable[r, c]
    likely = _resize(is_sky.astype(np.float32), height, width)
    # Twigs begin at a part of some length, not at a single return in the open sky.
    number, length_px, _ = _parts(~is_sky)
    is_matter = (length_px >= _SHORTEST_LINE * is_sky.shape[1])[number]
    is_matter = _resize(is_matter.astype(np.float32), height, width) > 0.0
    open_fraction = 1.0 - _long(_thin_lines(srgb8), is_matter)
    open_fraction[_resize(evidence.is_excluded.astype(np.float32), height, width) > 0.5] = 0.0

    def refined(alpha: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
        alpha[rows, columns] = trust * fraction + (1 - trust) * alpha[rows, columns]
        return np.clip(alpha * open_fraction, 0.0, 1.0).astype(np.float32)

    return SkyMatte(refined(_resize(probability, height, width)), refined(likely))


def _border(is_sky: Bool[np.ndarray, "a b"]) -> Bool[np.ndarray, "a b"]:
    from scipy.ndimage import maximum_filter, minimum_filter

    size = 2 * _BORDER_PX + 1
    grown, shrunk = maximum_filter(is_sky, size), minimum_filter(is_sky, size)
    return np.asarray(grown, bool) & ~np.asarray(shrunk, bool)


def _local_colours(
    srgb8: UInt8[np.ndarray, "h w 3"], is_sky: Bool[np.ndarray, "a b"]
) -> tuple[
    Float[np.ndarray, "a b 3"],
    Float[np.ndarray, "a b 3"],
    Float[np.ndarray, "a b 3 3"],
    Float[np.ndarray, "a b"],
]:
    """Return the mean sRGB of nearby sky and other pixels away from the border, the covariance of
    the sky, and 1 where there is sky nearby.

    Without other pixels nearby, as beside a wire in the open sky, the other colour is a dark grey.
    """
    from scipy.ndimage import minimum_filter, uniform_filter

    from lightsim.core.resample import resize_area

    rgb = resize_area(srgb8.astype(np.float32) / np.float32(255.0), *is_sky.shape)
    window = 8 * _BORDER_PX + 1
    pairs = np.triu_indices(3)
    values = np.concatenate([rgb, rgb[..., pairs[0]] * rgb[..., pairs[1]]], axis=-1)

    def nearby(side: Bool[np.ndarray, "a b"], count: int) -> tuple[np.ndarray, np.ndarray]:
        core = minimum_filter(side, 3).astype(np.float32)
        mass = uniform_filter(core, window)
        total = [uniform_filter(values[..., k] * core, window) for k in range(count)]
        return mass, np.stack(total, axis=-1) / np.maximum(mass, 1e-6)[..., None]

    sky_mass, moments = nearby(is_sky, 9)
    other_mass, other = nearby(~is_sky, 3)
    sky = moments[..., :3]
    other = np.where((other_mass > 0.01)[..., None], other, 0.3 * sky)
    covariance = np.zeros((*is_sky.shape, 3, 3))
    covariance[..., pairs[0], pairs[1]] = moments[..., 3:] - sky[..., pairs[0]] * sky[..., pairs[1]]
    covariance[..., pairs[1], pairs[0]] = covariance[..., pairs[0], pairs[1]]
    return sky, other, covariance, (sky_mass > 0.01).astype(np.float32)


def _thin_lines(srgb8: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Return the fraction of each pixel that thin dark lines cover.

    It is the black top-hat of linear light relative to the bright surroundings, divided by that of
    the darkest pixels nearby, which the line covers completely.
    """
    from scipy.ndimage import grey_closing, grey_erosion

    width = srgb8.shape[1]
    green = linear_from_srgb8(srgb8[..., 1])
    size = max(3, 2 * round(width * _WIDEST_LINE) + 1)
    closed = np.maximum(grey_closing(green, size=(size, size)), _DARK_SURROUNDINGS)
    drop = 1 - green / closed
    whole = 1 - np.minimum(grey_erosion(1 - drop, size=(3, 3)), _PALEST_LINE)
    return np.clip((drop - _NOISE) / (whole - _NOISE), 0.0, 1.0).astype(np.float32)


def _long(
    lines: Float32[np.ndarray, "h w"], is_matter: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Return the lines without short or broad parts, unless they begin at a surface (twigs)."""
    from scipy.ndimage import binary_dilation

    number, length_px, width_px = _parts(binary_dilation(lines > 0.0, _SQUARE))
    is_kept = length_px >= _SHORTEST_LINE * lines.shape[1] + 2
    is_kept &= width_px < _BROADEST_LINE * length_px
    is_kept[np.unique(number[is_matter])] = True
    return np.where(is_kept[number], lines, np.float32(0.0))


def _parts(
    is_in: Bool[np.ndarray, "h w"],
) -> tuple[Int[np.ndarray, "h w"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the number of each pixel's connected part (0: none), and length and width of each part
    in pixels, those of a rectangle with the same second moments."""
    from scipy.ndimage import label

    number = np.zeros(is_in.shape, dtype=np.int32)
    label(is_in, _SQUARE, output=number)
    count = int(number.max()) + 1
    rows, columns = np.nonzero(is_in)
    part = number[rows, columns]
    area = np.maximum(np.bincount(part, minlength=count), 1)
    place = np.stack([rows, columns], axis=1).astype(np.float64)
    mean = np.stack([np.bincount(part, x, count) / area for x in place.T], axis=1)
    r, c = (place - mean[part]).T
    rr, cc, rc = (np.bincount(part, x, count) / area for x in (r * r, c * c, r * c))
    half, apart = (rr + cc) / 2, np.hypot((rr - cc) / 2, rc)
    length, width = (np.sqrt(12 * np.maximum(x, 0.0)) for x in (half + apart, half - apart))
    return number, length, width


def _resize(image: Float32[np.ndarray, "a b"], height: int, width: int) -> np.ndarray:
    """Return the image, enlarged bilinearly."""
    from PIL import Image

    resized = Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR)
    return np.array(resized, dtype=np.float32)
