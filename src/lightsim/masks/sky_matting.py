"""Soft borders of the sky matte at full resolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from lightsim.core.colour import linear_from_srgb8
from lightsim.masks.sky_regions import ImageEvidence

_SQUARE = np.ones((3, 3), dtype=bool)
# Of the way from what is not sky to the sky: below the foot nothing shows sky; from so many of the
# sky's own standard deviations before its mean on, at least the foot and at most so much, all does.
_FOOT, _SPREADS, _WIDEST_SPREAD = 0.2, 2.0, 0.6
# Thin lines: linear light of the ground below which none is told, drop that is noise, and a line's
# own light over its ground's at most: one narrower than a pixel is paler wherever it is seen.
_DARK_GROUND, _NOISE, _PALEST_LINE = 0.02, 0.12, 0.35
# Half of the widest line, and the shortest one that ends in the open sky (dashes of a faint wire
# count as one), by the picture's width; and how broad that one may be for its length (wires .03 to
# .1, textures of clouds .3 to .5). What is shorter or wider is texture of clouds.
_WIDEST_LINE, _SHORTEST_LINE, _BROADEST_LINE = 1 / 320, 1 / 50, 0.2


@dataclass(frozen=True, eq=False)
class SkyMatte:
    """How much of each pixel is sky: 1 sky, 0 anything else.

    Args:
        expected: the mean over what may be: a cloud that is sky with a probability of .8 has .8.
            What is built from pictures goes by it, for half-sure sky is no free space.
        likeliest: as if what is likelier sky than not were sky. Pictures are put together by it:
            .8 of another sky before a cloud of the recorded one is what nobody would see.
    """

    expected: Float32[np.ndarray, "h w"]
    likeliest: Float32[np.ndarray, "h w"]


def refine_matte(
    srgb8: UInt8[np.ndarray, "h w 3"],
    probability: Float32[np.ndarray, "a b"],
    evidence: ImageEvidence,
    border_px: int,
) -> SkyMatte:
    """The matte of every full-size pixel.

    Along borders a pixel is a mix of the mean sky colour and the mean other colour nearby
    (colour-line matting, Chuang et al. 2001, doi:10.1109/CVPR.2001.990970, with one Gaussian a
    side); inside the sky, thin dark lines (wires, twigs) take their share away.
    """
    height, width = srgb8.shape[:2]
    is_sky = probability > 0.5
    if not is_sky.any():
        return SkyMatte(*np.zeros((2, height, width), np.float32))
    is_border = _resize(_border(is_sky, border_px).astype(np.float32), height, width) > 0.5
    sky, other, spread, reliable = _local_colours(srgb8, is_sky, border_px)
    rows, columns = np.nonzero(is_border)
    pixels = srgb8[rows, columns].astype(np.float32) / np.float32(255.0)
    r = np.minimum(rows * is_sky.shape[0] // height, is_sky.shape[0] - 1)
    c = np.minimum(columns * is_sky.shape[1] // width, is_sky.shape[1] - 1)
    line = sky[r, c] - other[r, c]
    length2 = np.sum(line**2, axis=1)
    fraction = np.sum((pixels - other[r, c]) * line, axis=1) / np.maximum(length2, 1e-4)
    # Pull the foot and shoulder to 0 and 1: both sides vary around their mean, a sky with clouds
    # before the sun by as much as they differ.
    variance = np.einsum("na,nab,nb->n", line, spread[r, c], line)
    varies = np.sqrt(np.maximum(variance, 0.0)) / np.maximum(length2, 1e-4)
    shoulder = 1 - np.clip(_SPREADS * varies, _FOOT, _WIDEST_SPREAD)
    fraction = np.clip((fraction - _FOOT) / (shoulder - _FOOT), 0.0, 1.0)
    trust = np.clip(length2 / 0.01, 0.0, 1.0) * reliable[r, c]
    likely = _resize(is_sky.astype(np.float32), height, width)
    # No twig begins at a speck: a lone return in the open sky.
    number, length_px, _ = _parts(~is_sky)
    is_matter = (length_px >= _SHORTEST_LINE * is_sky.shape[1])[number]
    is_matter = _resize(is_matter.astype(np.float32), height, width) > 0.0
    share = 1.0 - _long(_thin_lines(srgb8), is_matter)
    share[_resize(evidence.is_excluded.astype(np.float32), height, width) > 0.5] = 0.0

    def refined(alpha: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
        alpha[rows, columns] = trust * fraction + (1 - trust) * alpha[rows, columns]
        return np.clip(alpha * share, 0.0, 1.0).astype(np.float32)

    return SkyMatte(refined(_resize(probability, height, width)), refined(likely))


def _border(is_sky: Bool[np.ndarray, "a b"], border_px: int) -> Bool[np.ndarray, "a b"]:
    from scipy.ndimage import maximum_filter, minimum_filter

    size = 2 * border_px + 1
    grown, shrunk = maximum_filter(is_sky, size), minimum_filter(is_sky, size)
    return np.asarray(grown, bool) & ~np.asarray(shrunk, bool)


def _local_colours(
    srgb8: UInt8[np.ndarray, "h w 3"], is_sky: Bool[np.ndarray, "a b"], border_px: int
) -> tuple[
    Float[np.ndarray, "a b 3"],
    Float[np.ndarray, "a b 3"],
    Float[np.ndarray, "a b 3 3"],
    Float[np.ndarray, "a b"],
]:
    """Mean sRGB of the sky and of the rest nearby, away from the border, the sky's covariance, and
    whether sky exists.

    A wire in the open sky has nothing else nearby: a dark grey then stands for it.
    """
    from scipy.ndimage import minimum_filter, uniform_filter

    from lightsim.core.resample import resize_area

    rgb = resize_area(srgb8.astype(np.float32) / np.float32(255.0), *is_sky.shape)
    window = 8 * border_px + 1
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
    spread = np.zeros((*is_sky.shape, 3, 3))
    spread[..., pairs[0], pairs[1]] = moments[..., 3:] - sky[..., pairs[0]] * sky[..., pairs[1]]
    spread[..., pairs[1], pairs[0]] = spread[..., pairs[0], pairs[1]]
    return sky, other, spread, (sky_mass > 0.01).astype(np.float32)


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
    """Without what is short or broad, but for what begins at matter (twigs, lamps)."""
    from scipy.ndimage import binary_dilation

    number, length_px, width_px = _parts(binary_dilation(lines > 0.0, _SQUARE))
    is_kept = length_px >= _SHORTEST_LINE * lines.shape[1] + 2
    is_kept &= width_px < _BROADEST_LINE * length_px
    is_kept[np.unique(number[is_matter])] = True
    return np.where(is_kept[number], lines, np.float32(0.0))


def _parts(
    is_in: Bool[np.ndarray, "h w"],
) -> tuple[Int[np.ndarray, "h w"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Connected parts by number (0: none), and how long and broad each is: of a rectangle with the
    same second moments."""
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
    """Bilinear enlargement."""
    from PIL import Image

    resized = Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR)
    return np.array(resized, dtype=np.float32)
