"""Image filters of relighting: box means, guided filters, medians and hole filling."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

# Lower limit of sums of weights, against division by zero.
_EPSILON = np.float32(1e-6)
# Width in pixels to which wider images are reduced before a median; a limit on time.
_MEDIAN_AT_PX = 480


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
    image: Float32[np.ndarray, "h w c"], width_fraction: float, picture_width_px: int | None = None
) -> Float32[np.ndarray, "h w c"]:
    """Median over squares whose side is a fraction of the picture's width.

    Thin details are removed, edges of larger regions are preserved. Wide pictures are filtered at a
    fraction of their size and enlarged linearly.

    Args:
        image: the picture, or a window of it.
        picture_width_px: width of the whole picture; None if `image` is all of it.
    """
    height, width, channels = image.shape
    picture_width = picture_width_px or width
    step = -(-picture_width // _MEDIAN_AT_PX)
    padded = np.pad(image, ((0, -height % step), (0, -width % step), (0, 0)), mode="edge")
    rows, columns = padded.shape[0] // step, padded.shape[1] // step
    small = padded.reshape(rows, step, columns, step, channels).mean(axis=(1, 3))
    size = 2 * round(width_fraction * -(-picture_width // step) / 2) + 1
    smooth = np.stack([median(small[..., c], size) for c in range(channels)], axis=-1)
    if step == 1:
        return smooth
    up = _enlarged(smooth, step * rows, step * columns)
    return np.ascontiguousarray(up[:height, :width])


def median(image: Float32[np.ndarray, "h w"], size_px: int) -> Float32[np.ndarray, "h w"]:
    """Median over squares of an odd number of pixels, edges repeated.

    Equal to `scipy.ndimage.median_filter`, which is slower because it sorts for every pixel.
    """
    from lightsim.relighting.physical.median_kernels import rank_medians

    # Medians of ranks are exact for any values, and a histogram of ranks has no empty bins.
    order = np.argsort(image, axis=None, kind="stable")
    ranks = np.empty(image.size, dtype=np.int32)
    ranks[order] = np.arange(image.size, dtype=np.int32)
    padded = np.pad(ranks.reshape(image.shape), size_px // 2, mode="edge")
    out = np.empty_like(image)
    rank_medians(padded, size_px, image.reshape(-1)[order], out)
    return out


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
    for axis, size in ((0, height), (1, width)):
        own = image.shape[axis]
        place = np.clip((np.arange(size) + 0.5) * (own / size) - 0.5, 0, own - 1)
        low = place.astype(np.int64)
        part = (place - low).astype(np.float32).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        first, second = (np.take(image, np.minimum(low + k, own - 1), axis) for k in (0, 1))
        image = first + part * (second - first)
    return image.astype(np.float32)


def _halved(image: Float32[np.ndarray, "h w c"]) -> Float32[np.ndarray, "_ _ c"]:
    """Sums of 2x2 blocks."""
    height, width, channels = image.shape
    padded = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)))
    blocks = padded.reshape((height + 1) // 2, 2, (width + 1) // 2, 2, channels)
    return blocks.sum(axis=(1, 3))
