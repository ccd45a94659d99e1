"""Where the image says that the source's sun shadows lie.

Reconstructed geometry puts shadow edges some decimetres off, and misses some casters. Dividing an
image by wrong shading leaves a ghost of every shadow, so the source's sun visibility is decided
again per pixel: by the rendered one, less and less trusted near its own edges, by how bright and
how blue the pixel is for its surface, and by its neighbours up to the next image edge.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.colour import luminance
from lightsim.core.dome import Sun
from lightsim.core.found_visibility import decided, unoccluded_sun
from lightsim.relighting.physical.filters import box_mean, guided_filter

_DARKEST = np.float32(1e-4)


# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/relighting.md).

# Distance from a rendered shadow edge over which it gains the trust of one logit.
_GEOMETRY_ERROR_M = 0.2
# Trust in the rendered visibility far from its edges.
_LARGEST_PRIOR_LOGIT = 3.0
# Standard deviation of log luminance of an image against base colour times light.
_LUMINANCE_DEVIATION = 0.4
# The same of the log of red over blue and of green over the two.
_CHROMA_DEVIATION = 0.3
# Most that the look of one pixel may say.
_LARGEST_IMAGE_LOGIT = 4.0
# Weight of the neighbours' vote.
_SMOOTHNESS_LOGIT = 8.0
# Radius of the neighbourhood as a fraction of the image width.
_NEIGHBOURHOOD_FRACTION = 1 / 100
# Width of a strip, as a fraction of the image width, below which a change is taken for noise.
_SMALLEST_FRACTION = 1 / 240
# Variance of log luminance below which the image has no edge; deviations of the visibility nearby
# that are no border of a shadow, and that are one.
_EDGE_VARIANCE, _EDGE_DEVIATION = 0.003, (0.05, 0.15)
# Rounds of the vote.
_ITERATIONS = 5
# Sun light below this fraction of the other light is left as rendered.
_LEAST_CONTRAST = 0.15


def refine_sun_visibility(
    radiance: Float32[np.ndarray, "h w 3"],
    buffers: GBuffers,
    shadows: ShadowBuffers,
    sun: Sun,
    is_usable: Bool[np.ndarray, "h w"],
    width_px: int | None = None,
) -> Float32[np.ndarray, "h w"]:
    """Sun visibility in [0, 1] that agrees with the image; as rendered where it cannot be told.

    Args:
        radiance: the image in scene units.
        shadows: the rendered light of the image's own sky.
        is_usable: pixels with a surface that are neither sky nor clipped.
        width_px: of the picture, where all this is a window of it.
    """
    width = width_px or radiance.shape[1]
    colour = np.maximum(buffers.base_colour, np.float32(0.02))
    # Reflections count as light that a diffuse surface of this colour would need.
    by_sun = shadows.sun_visibility[..., None] * shadows.reflected_sun
    sunlight = unoccluded_sun(buffers, shadows, sun) + shadows.reflected_sun / colour
    ambient = shadows.sky + shadows.bounce + (shadows.reflected - by_sun) / colour
    ambient = np.maximum(ambient, _DARKEST)
    contrast = luminance(sunlight) / luminance(ambient)
    is_open = is_usable & buffers.has_surface & (contrast > _LEAST_CONTRAST)
    if not is_open.any():
        return shadows.sun_visibility
    prior = _prior_logit(shadows.sun_visibility, buffers, is_open)
    residual = np.log(np.maximum(radiance, _DARKEST)) - np.log(colour * ambient)
    step = np.log1p(sunlight / ambient)
    visibility = _infer((residual, step), prior, luminance(radiance), is_open, width)
    fraction = is_open * _changed_fraction(visibility, shadows.sun_visibility, width)
    rendered = shadows.sun_visibility
    mixed = np.where(fraction > 0, rendered + fraction * (visibility - rendered), rendered)
    is_surface = is_usable & buffers.has_surface
    return decided(_along_edges(mixed, luminance(radiance), is_surface, width))


def _along_edges(
    visibility: Float32[np.ndarray, "h w"],
    brightness: Float32[np.ndarray, "h w"],
    is_usable: Bool[np.ndarray, "h w"],
    width_px: int,
) -> Float32[np.ndarray, "h w"]:
    """Where light meets shade, locally linear in the image: dapples under leaves are thinner than
    what all pictures together tell. Faces that turn from the sun take part: those of leaves, sills
    and reveals are often not where the mesh has them."""
    near = max(1, round(width_px * _NEIGHBOURHOOD_FRACTION))
    weight = is_usable.astype(np.float32)
    guide = np.log(np.maximum(brightness, _DARKEST)).astype(np.float32)
    guided = np.clip(guided_filter(guide, visibility, weight, near, _EDGE_VARIANCE), 0.0, 1.0)
    part = weight * border_fraction(visibility, width_px)
    return np.where(part > 0, visibility + part * (guided - visibility), visibility)


def border_fraction(
    visibility: Float32[np.ndarray, "h w"], width_px: int
) -> Float32[np.ndarray, "h w"]:
    """1 about borders of shadows, 0 where all nearby is lit or all is shadowed."""
    near = max(1, round(width_px * _NEIGHBOURHOOD_FRACTION))
    variance = box_mean(np.square(visibility), near) - np.square(box_mean(visibility, near))
    flat, edge = _EDGE_DEVIATION
    deviation = np.sqrt(np.maximum(variance, np.float32(0)))
    return np.clip((deviation - flat) / (edge - flat), 0.0, 1.0).astype(np.float32)


def _changed_fraction(
    visibility: Float32[np.ndarray, "h w"],
    rendered: Float32[np.ndarray, "h w"],
    width_px: int,
) -> Float32[np.ndarray, "h w"]:
    """1 where lit and shadowed are exchanged, fading to 0 beside: elsewhere rendered edges are
    sharper than found ones. Specks are left out."""
    smallest = max(2, round(width_px * _SMALLEST_FRACTION))
    is_changed = (visibility > 0.5) != (rendered > 0.5)
    is_changed = ndimage.binary_opening(is_changed, np.ones((smallest, smallest)))
    grown = np.asarray(ndimage.binary_dilation(is_changed, np.ones((3, 3))))
    return np.clip(3 * box_mean(grown.astype(np.float32), smallest), 0.0, 1.0)


def _infer(
    look: tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"]],
    prior: Float32[np.ndarray, "h w"],
    brightness: Float32[np.ndarray, "h w"],
    is_open: Bool[np.ndarray, "h w"],
    width_px: int,
) -> Float32[np.ndarray, "h w"]:
    """Mean-field inference: `look` is log(image / unlit model), and what sun adds to it."""
    near = max(1, round(width_px * _NEIGHBOURHOOD_FRACTION))
    weight = is_open.astype(np.float32)
    guide = np.log(np.maximum(brightness, _DARKEST)).astype(np.float32)
    # From the looks of each pixel on: the vote of a wide false shadow would never leave the prior.
    own = prior + _image_logit(*look)
    visibility = _sigmoid(own)
    for _ in range(_ITERATIONS):
        vote = guided_filter(guide, visibility, weight, near, 0.05)
        visibility = _sigmoid(own + np.float32(_SMOOTHNESS_LOGIT) * (2 * np.clip(vote, 0, 1) - 1))
    soft = guided_filter(guide, visibility, weight, max(1, near // 2), 0.01)
    return np.clip(soft, 0.0, 1.0).astype(np.float32)


def _image_logit(
    residual: Float32[np.ndarray, "h w 3"],
    step: Float32[np.ndarray, "h w 3"],
) -> Float32[np.ndarray, "h w"]:
    """Log-odds of lit against shadowed from the look of each pixel alone, clipped.

    Brightness, red over blue, and green over both are taken as independent Gaussians.
    """
    basis = np.array([[1 / 3, 1 / 3, 1 / 3], [1.0, 0.0, -1.0], [-0.5, 1.0, -0.5]], np.float32)
    deviation = np.array([_LUMINANCE_DEVIATION, _CHROMA_DEVIATION, _CHROMA_DEVIATION], np.float32)
    if_shadowed = residual @ basis.T / deviation
    if_lit = (residual - step) @ basis.T / deviation
    logit = 0.5 * (np.square(if_shadowed) - np.square(if_lit)).sum(axis=-1)
    limit = np.float32(_LARGEST_IMAGE_LOGIT)
    return (limit * np.tanh(logit / limit)).astype(np.float32)


def _prior_logit(
    visibility: Float32[np.ndarray, "h w"],
    buffers: GBuffers,
    is_open: Bool[np.ndarray, "h w"],
) -> Float32[np.ndarray, "h w"]:
    """Log-odds of lit from the rendered visibility: 0 on its edges, growing with distance."""
    is_lit = visibility > 0.5
    inside = np.asarray(ndimage.distance_transform_edt(is_lit | ~is_open))
    outside = np.asarray(ndimage.distance_transform_edt(~is_lit | ~is_open))
    signed_px = np.where(is_lit, inside, -outside)
    logit = signed_px * _footprint_m(buffers) / _GEOMETRY_ERROR_M
    limit = _LARGEST_PRIOR_LOGIT
    return (limit * np.tanh(logit / limit)).astype(np.float32)


def _footprint_m(buffers: GBuffers) -> Float32[np.ndarray, "h w"]:
    """Size of a pixel on its surface along the finer direction, smoothed; 0 without a surface."""
    position = buffers.position_world
    right = np.linalg.norm(np.diff(position, axis=1, append=position[:, -2:-1]), axis=-1)
    down = np.linalg.norm(np.diff(position, axis=0, append=position[-2:-1]), axis=-1)
    finer = np.where(buffers.has_surface, np.minimum(right, down), 0.0)
    return ndimage.median_filter(finer.astype(np.float32), size=3)


def _sigmoid(logit: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    return (0.5 * (1 + np.tanh(0.5 * logit))).astype(np.float32)
