"""Soft borders of the sky matte at full resolution."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from lightsim.core.colour import linear_from_srgb8
from lightsim.masks.sky_regions import ImageEvidence

# Thin lines: linear light of the ground below which none is told, drop that is noise, and a line's
# own light over its ground's at most: one narrower than a pixel is paler wherever it is seen.
_DARK_GROUND, _NOISE, _PALEST_LINE = 0.02, 0.12, 0.35
# Half of the widest line, and the shortest one that ends in the open sky (dashes of a faint wire
# count as one), by the picture's width. What is shorter or wider is texture of clouds.
_WIDEST_LINE, _SHORTEST_LINE = 1 / 320, 1 / 50


def refine_matte(
    srgb8: UInt8[np.ndarray, "h w 3"],
    probability: Float32[np.ndarray, "a b"],
    evidence: ImageEvidence,
    border_px: int,
) -> Float32[np.ndarray, "h w"]:
    """Alpha of every full-size pixel.

    Along borders a pixel is a mix of the mean sky colour and the mean other colour nearby
    (colour-line matting, Chuang et al. 2001, doi:10.1109/CVPR.2001.990970, with one Gaussian a
    side); inside the sky, thin dark lines (wires, twigs) take their share away.
    """
    height, width = srgb8.shape[:2]
    is_sky = probability > 0.5
    if not is_sky.any():
        return np.zeros((height, width), np.float32)
    alpha = _resize(probability, height, width)
    is_border = _resize(_border(is_sky, border_px).astype(np.float32), height, width) > 0.5
    sky, other, reliable = _local_colours(srgb8, is_sky, border_px)
    rows, columns = np.nonzero(is_border)
    pixels = srgb8[rows, columns].astype(np.float32) / np.float32(255.0)
    r = np.minimum(rows * is_sky.shape[0] // height, is_sky.shape[0] - 1)
    c = np.minimum(columns * is_sky.shape[1] // width, is_sky.shape[1] - 1)
    line = sky[r, c] - other[r, c]
    length2 = np.sum(line**2, axis=1)
    fraction = np.sum((pixels - other[r, c]) * line, axis=1) / np.maximum(length2, 1e-4)
    # Pull the foot and shoulder to 0 and 1: both sides vary around their mean.
    fraction = np.clip((fraction - 0.2) / 0.6, 0.0, 1.0)
    trust = np.clip(length2 / 0.01, 0.0, 1.0) * reliable[r, c]
    alpha[rows, columns] = trust * fraction + (1 - trust) * alpha[rows, columns]
    is_matter = _resize((~is_sky).astype(np.float32), height, width) > 0.0
    alpha *= 1.0 - _long(_thin_lines(srgb8), is_matter)
    is_out = _resize(evidence.is_excluded.astype(np.float32), height, width) > 0.5
    alpha[is_out] = 0.0
    return np.clip(alpha, 0.0, 1.0).astype(np.float32)


def _border(is_sky: Bool[np.ndarray, "a b"], border_px: int) -> Bool[np.ndarray, "a b"]:
    from scipy.ndimage import maximum_filter, minimum_filter

    size = 2 * border_px + 1
    grown, shrunk = maximum_filter(is_sky, size), minimum_filter(is_sky, size)
    return np.asarray(grown, bool) & ~np.asarray(shrunk, bool)


def _local_colours(
    srgb8: UInt8[np.ndarray, "h w 3"], is_sky: Bool[np.ndarray, "a b"], border_px: int
) -> tuple[Float[np.ndarray, "a b 3"], Float[np.ndarray, "a b 3"], Float[np.ndarray, "a b"]]:
    """Mean sRGB of the sky and of the rest nearby, away from the border, and whether sky exists.

    A wire in the open sky has nothing else nearby: a dark grey then stands for it.
    """
    from scipy.ndimage import minimum_filter, uniform_filter

    from lightsim.core.resample import resize_area

    rgb = resize_area(srgb8.astype(np.float32) / np.float32(255.0), *is_sky.shape)
    window = 8 * border_px + 1
    means, masses = [], []
    for side in (is_sky, ~is_sky):
        core = minimum_filter(side, 3).astype(np.float32)
        mass = uniform_filter(core, window)
        total = np.stack([uniform_filter(rgb[..., k] * core, window) for k in range(3)], axis=-1)
        means.append(total / np.maximum(mass, 1e-6)[..., None])
        masses.append(mass)
    other = np.where((masses[1] > 0.01)[..., None], means[1], 0.3 * means[0])
    return means[0], other, (masses[0] > 0.01).astype(np.float32)


def _thin_lines(srgb8: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Fraction of each pixel that a thin dark line covers: black top-hat of linear light over the
    bright ground, of which the line's own darkest pixels nearby have all, or nearly so."""
    from scipy.ndimage import grey_closing, grey_erosion

    width = srgb8.shape[1]
    green = linear_from_srgb8(srgb8[..., 1])
    size = max(3, 2 * round(width * _WIDEST_LINE) + 1)
    closed = np.maximum(grey_closing(green, size=(size, size)), _DARK_GROUND)
    drop = 1 - green / closed
    whole = 1 - np.minimum(grey_erosion(1 - drop, size=(3, 3)), _PALEST_LINE)
    return np.clip((drop - _NOISE) / (whole - _NOISE), 0.0, 1.0).astype(np.float32)


def _long(
    lines: Float32[np.ndarray, "h w"], is_matter: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Without short ones, but for those that begin at matter (twigs, lamps)."""
    from scipy.ndimage import binary_dilation, find_objects, label

    square = np.ones((3, 3), dtype=bool)
    number = np.zeros(lines.shape, dtype=np.int32)
    label(binary_dilation(lines > 0.0, square), square, output=number)
    extent = [0, *(max(s.stop - s.start for s in place) for place in find_objects(number))]
    is_kept = np.array(extent) - 2 >= _SHORTEST_LINE * lines.shape[1]
    is_kept[np.unique(number[is_matter])] = True
    return np.where(is_kept[number], lines, np.float32(0.0))


def _resize(image: Float32[np.ndarray, "a b"], height: int, width: int) -> np.ndarray:
    """Bilinear enlargement."""
    from PIL import Image

    resized = Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR)
    return np.array(resized, dtype=np.float32)
