"""Image filters of relighting: box means, guided filters, medians and hole filling."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Int32
from scipy import ndimage

# Lower limit of sums of weights, against division by zero.
_EPSILON = np.float32(1e-6)
# Width in pixels to which wider images are reduced before a median; a limit on time.
_MEDIAN_AT_PX = 480
# Side of the squares, in pixels, up to which selection is faster than a histogram. For 480 x 270
# pixels a histogram takes 33 ms, selection 5 ms with a side of 5, 12 with 7, 34 with 9.
_SMALL_MEDIAN_PX = 7


def box_mean(image: Float32[np.ndarray, "h w *c"], radius_px: int) -> Float32[np.ndarray, "h w *c"]:
    """Mean over a square window of 2 r + 1 pixels, edges repeated."""
    width = 2 * radius_px + 1
    return ndimage.uniform_filter(image, size=width, mode="nearest", axes=(0, 1))


def guided_filter(
    guide: Float32[np.ndarray, "h w"],
    image: Float32[np.ndarray, "h w"],
    weight: Float32[np.ndarray, "h w"],
    radius_px: int,
    epsilon: float,
) -> Float32[np.ndarray, "h w"]:
    """Smooth the image so that it is locally linear in the guide and its edges lie on the guide's.

    He et al., Guided Image Filtering, doi:10.1109/TPAMI.2012.213, with a weight per pixel.
    """
    fraction = box_mean(weight, radius_px) + _EPSILON
    mean_guide = box_mean(guide * weight, radius_px) / fraction
    mean_image = box_mean(image * weight, radius_px) / fraction
    covariance = box_mean(guide * image * weight, radius_px) / fraction - mean_guide * mean_image
    variance = box_mean(guide * guide * weight, radius_px) / fraction - mean_guide**2
    slope = covariance / (np.maximum(variance, 0.0) + np.float32(epsilon))
    offset = mean_image - slope * mean_guide
    slope = box_mean(slope * weight, radius_px) / fraction
    offset = box_mean(offset * weight, radius_px) / fraction
    return (slope * guide + offset).astype(np.float32)


def colour_guided_filter(
    guide: Float32[np.ndarray, "h w 3"],
    image: Float32[np.ndarray, "h w"],
    weight: Float32[np.ndarray, "h w"],
    radius_px: int,
    epsilon: float,
) -> Float32[np.ndarray, "h w"]:
    """Smooth the image so that it is locally linear in a guide of three channels (`guided_filter`,
    there Sec. 3.5)."""
    total = box_mean(weight, radius_px)[..., None]

    def mean(values: np.ndarray) -> np.ndarray:
        return box_mean((values * weight[..., None]).astype(np.float32), radius_px) / total

    products = (guide[..., :, None] * guide[..., None, :]).reshape(*image.shape, 9)
    colour, target = mean(guide), mean(image[..., None])
    covariance = mean(guide * image[..., None]) - colour * target
    scatter = mean(products).reshape(*image.shape, 3, 3)
    scatter = scatter - colour[..., :, None] * colour[..., None, :] + epsilon * np.eye(3)
    slope = np.linalg.solve(scatter, covariance[..., None])[..., 0]
    offset = target - (slope * colour).sum(axis=-1, keepdims=True)
    smooth = box_mean(np.concatenate([slope, offset], axis=-1).astype(np.float32), radius_px)
    return ((smooth[..., :3] * guide).sum(axis=-1) + smooth[..., 3]).astype(np.float32)


def median_smoothed(
    image: Float32[np.ndarray, "h w c"],
    width_fraction: float,
    picture_width_px: int | None = None,
    is_wanted: Bool[np.ndarray, "h w"] | None = None,
) -> Float32[np.ndarray, "h w c"]:
    """Median over squares whose side is a fraction of the picture's width.

    Thin details are removed, edges of larger regions are preserved. Wide pictures are filtered at a
    fraction of their size and enlarged linearly.

    Args:
        image: the picture, or a window of it.
        picture_width_px: width of the whole picture; None if `image` is all of it.
        is_wanted: pixels whose result is used, which saves time; it is undefined elsewhere. None:
            all pixels.
    """
    height, width, channels = image.shape
    picture_width = picture_width_px or width
    step = -(-picture_width // _MEDIAN_AT_PX)
    padded = np.pad(image, ((0, -height % step), (0, -width % step), (0, 0)), mode="edge")
    rows, columns = padded.shape[0] // step, padded.shape[1] // step
    small = _block_sum(padded, step) / np.float32(step * step)
    size = 2 * round(width_fraction * -(-picture_width // step) / 2) + 1
    wanted = _wanted_blocks(
        np.ones((height, width), bool) if is_wanted is None else is_wanted, step
    )
    smooth = np.stack([median(small[..., c], size, wanted) for c in range(channels)], axis=-1)
    if step == 1:
        return smooth
    up = _enlarged(smooth, step * rows, step * columns)
    return np.ascontiguousarray(up[:height, :width])


def _block_sum(image: Float32[np.ndarray, "h w c"], step: int) -> Float32[np.ndarray, "r q c"]:
    """Sums of blocks of `step` x `step` pixels, by strided views: a sum over two axes of a block
    view takes five times as long."""
    first, *others = (image[i::step, j::step] for i, j in np.ndindex(step, step))
    total = first.copy()
    for part in others:
        total += part
    return total


def _wanted_blocks(is_wanted: Bool[np.ndarray, "h w"], step: int) -> Bool[np.ndarray, "r c"]:
    """Blocks of `step` x `step` pixels whose values enlargement uses at a wanted pixel."""
    if step == 1:
        return is_wanted
    height, width = is_wanted.shape
    padded = np.pad(is_wanted, ((0, -height % step), (0, -width % step)))
    blocks = np.logical_or.reduce([padded[i::step, j::step] for i, j in np.ndindex(step, step)])
    return ndimage.maximum_filter(blocks, size=3)


def median(
    image: Float32[np.ndarray, "h w"], size_px: int, is_wanted: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Median over squares of an odd number of pixels, edges repeated; undefined at pixels that are
    not wanted.

    Equal to `scipy.ndimage.median_filter`, which is slower because it sorts for every pixel.
    """
    from lightsim.relighting.physical.filter_kernels import rank_medians, small_medians

    if 1 < size_px <= _SMALL_MEDIAN_PX:
        codes = _ordered_codes(image.view(np.int32))
        out = np.zeros_like(codes)
        small_medians(np.pad(codes, size_px // 2, mode="edge"), size_px, is_wanted, out)
        return _ordered_codes(out).view(np.float32)
    # Medians of ranks are exact for any values, in whatever order equal values have their ranks,
    # and a histogram of ranks has no empty bins.
    order = np.argsort(image, axis=None)
    ranks = np.empty(image.size, dtype=np.int32)
    ranks[order] = np.arange(image.size, dtype=np.int32)
    padded = np.pad(ranks.reshape(image.shape), size_px // 2, mode="edge")
    smooth = np.zeros_like(image)
    rank_medians(padded, size_px, image.reshape(-1)[order], is_wanted, smooth)
    return smooth


def _ordered_codes(bits: Int32[np.ndarray, "h w"]) -> Int32[np.ndarray, "h w"]:
    """Return whole numbers in the order of the float32 values of these bits, and the reverse: the
    magnitude of negative values is inverted."""
    return bits ^ ((bits >> 31) & np.int32(0x7FFFFFFF))


def fill_holes(
    image: Float32[np.ndarray, "h w c"], is_known: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w c"]:
    """Fill unknown pixels from their surroundings (pull-push pyramid); known pixels are unchanged.

    The result is 0 if no pixel is known. Gortler et al., The Lumigraph, Sec. 3.4,
    doi:10.1145/237170.237200.
    """
    if is_known.all():
        return image
    weight = is_known.astype(np.float32)[..., None]
    smooth = _pull_push(np.where(is_known[..., None], image, 0.0).astype(np.float32), weight)
    return np.where(is_known[..., None], image, smooth).astype(np.float32)


def _pull_push(
    total: Float32[np.ndarray, "h w c"], weight: Float32[np.ndarray, "h w 1"]
) -> Float32[np.ndarray, "h w c"]:
    """Fill by coarser levels; `total` is value times weight."""
    own = total / np.maximum(weight, _EPSILON)
    height, width = weight.shape[:2]
    if max(height, width) == 1 or bool((weight >= 1).all()):
        return np.where(weight > 0, own, 0.0).astype(np.float32)
    sums = _halved(weight)
    # Weights saturate at 1, so that a coarse pixel with one known fine pixel is fully known.
    clamped = np.minimum(sums, 1.0)
    coarse = _pull_push(_halved(total) * (clamped / np.maximum(sums, _EPSILON)), clamped)
    trust = np.minimum(weight, 1.0)
    return (trust * own + (1.0 - trust) * _enlarged(coarse, height, width)).astype(np.float32)


def _enlarged(
    image: Float32[np.ndarray, "a b c"], height: int, width: int
) -> Float32[np.ndarray, "h w c"]:
    """Enlarge bilinearly, edges repeated; equal to `scipy.ndimage.zoom` of order 1 in grid mode,
    which is several times slower."""
    from lightsim.relighting.physical.filter_kernels import enlarge

    places = []
    for own, size in zip(image.shape[:2], (height, width), strict=True):
        place = np.clip((np.arange(size) + 0.5) * (own / size) - 0.5, 0, own - 1)
        low = place.astype(np.int64)
        places += [low, np.minimum(low + 1, own - 1), (place - low).astype(np.float32)]
    out = np.empty((height, width, image.shape[2]), dtype=np.float32)
    enlarge(image, tuple(places[:3]), tuple(places[3:]), out)
    return out


def _halved(image: Float32[np.ndarray, "h w c"]) -> Float32[np.ndarray, "_ _ c"]:
    """Sums of 2x2 blocks."""
    height, width = image.shape[:2]
    return _block_sum(np.pad(image, ((0, height % 2), (0, width % 2), (0, 0))), 2)
