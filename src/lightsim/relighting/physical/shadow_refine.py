"""Refinement of the source's sun visibility by the image.

Shadow edges from reconstructed geometry are wrong by some decimetres, and some occluders are
missing. Division of an image by wrong shading leaves a residual of every shadow. The source's sun
visibility is therefore estimated again per pixel from three terms: the rendered visibility, with
less weight near its edges; the pixel's brightness and colour relative to its base colour; and its
neighbours up to the next image edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.colour import luminance
from lightsim.core.dome import Sun
from lightsim.core.found_visibility import decided, unoccluded_sun
from lightsim.relighting.physical.filters import box_mean, guided_filter

# Added to radiance and light before logarithms, in scene units.
_DARKEST = np.float32(1e-4)


@dataclass(frozen=True)
class _LabelModel:
    """Random field of lit and shadowed pixels.

    The values were chosen by eye on log 002 and the street of seed 0 and measured only in
    combination (docs/benchmarks/relighting.md).
    """

    geometry_error_m: float = 0.2
    """Distance from a rendered shadow edge, in metres, over which its log-odds grow by one."""
    largest_prior_logit: float = 3.0
    """Log-odds of the rendered visibility far from its edges."""
    luminance_deviation: float = 0.4
    """Standard deviation of log luminance of an image against base colour times light."""
    chroma_deviation: float = 0.3
    """Standard deviation of the logs of red over blue, and of green over both."""
    largest_image_logit: float = 4.0
    """Limit on the log-odds from one pixel's colour."""
    smoothness_logit: float = 8.0
    """Log-odds if all neighbours have the same label."""
    neighbourhood_fraction: float = 1 / 100
    """Radius of the neighbourhood, as a fraction of the image width."""
    smallest_fraction: float = 1 / 240
    """Width of a strip, as a fraction of the image width, below which a change is taken as
    noise."""
    edge_variance: float = 0.003
    """Variance of log luminance below which the image has no edge."""
    edge_deviation: tuple[float, float] = (0.05, 0.15)
    """Standard deviations of the visibility nearby: at most the first away from shadow borders,
    at least the second at a border."""
    iterations: int = 5
    """Iterations of the mean-field inference."""
    min_contrast: float = 0.15
    """Sunlight over the other light, at least, for a refinement; below, the visibility is as
    rendered."""


_MODEL = _LabelModel()


def refine_sun_visibility(
    radiance: Float32[np.ndarray, "h w 3"],
    buffers: GBuffers,
    shadows: ShadowBuffers,
    sun: Sun,
    is_usable: Bool[np.ndarray, "h w"],
    width_px: int | None = None,
) -> Float32[np.ndarray, "h w"]:
    """Return the sun visibility in [0, 1] that agrees with the image; as rendered where the image
    is not informative.

    Args:
        radiance: the image in scene units.
        shadows: the rendered light of the image's own sky.
        is_usable: pixels with a surface that are neither sky nor clipped.
        width_px: width of the whole picture, if these arrays are a window of it.
    """
    width = width_px or radiance.shape[1]
    colour = np.maximum(buffers.base_colour, np.float32(0.02))
    # Reflections are converted to the light under which a diffuse surface of this colour would
    # have the same radiance.
    by_sun = shadows.sun_visibility[..., None] * shadows.reflected_sun
    sunlight = unoccluded_sun(buffers, shadows, sun) + shadows.reflected_sun / colour
    ambient = shadows.sky + shadows.bounce + (shadows.reflected - by_sun) / colour
    ambient = np.maximum(ambient, _DARKEST)
    contrast = luminance(sunlight) / luminance(ambient)
    is_open = is_usable & buffers.has_surface & (contrast > _MODEL.min_contrast)
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
    """Make the visibility locally linear in the image near shadow borders.

    Shadow details under leaves are finer than the estimate from all pictures. Faces turned away
    from the sun are included, because normals of leaves, sills and reveals are often wrong.
    """
    near = max(1, round(width_px * _MODEL.neighbourhood_fraction))
    weight = is_usable.astype(np.float32)
    guide = np.log(np.maximum(brightness, _DARKEST)).astype(np.float32)
    guided = np.clip(guided_filter(guide, visibility, weight, near, _MODEL.edge_variance), 0.0, 1.0)
    part = weight * border_fraction(visibility, width_px)
    return np.where(part > 0, visibility + part * (guided - visibility), visibility)


def border_fraction(
    visibility: Float32[np.ndarray, "h w"], width_px: int
) -> Float32[np.ndarray, "h w"]:
    """Weight that is 1 near borders of shadows and 0 in uniformly lit or shadowed regions."""
    near = max(1, round(width_px * _MODEL.neighbourhood_fraction))
    variance = box_mean(np.square(visibility), near) - np.square(box_mean(visibility, near))
    flat, edge = _MODEL.edge_deviation
    deviation = np.sqrt(np.maximum(variance, np.float32(0)))
    return np.clip((deviation - flat) / (edge - flat), 0.0, 1.0).astype(np.float32)


def _changed_fraction(
    visibility: Float32[np.ndarray, "h w"],
    rendered: Float32[np.ndarray, "h w"],
    width_px: int,
) -> Float32[np.ndarray, "h w"]:
    """Weight that is 1 where lit and shadowed pixels are exchanged and fades to 0 beside them.

    Elsewhere rendered edges are sharper than estimated ones. Small specks are left out.
    """
    smallest = max(2, round(width_px * _MODEL.smallest_fraction))
    is_changed = (visibility > 0.5) != (rendered > 0.5)
    is_changed = ndimage.binary_opening(is_changed, np.ones((smallest, smallest)))
    grown = np.asarray(ndimage.binary_dilation(is_changed, np.ones((3, 3))))
    return np.clip(3 * box_mean(grown.astype(np.float32), smallest), 0.0, 1.0)


def _infer(
    colour_model: tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"]],
    prior: Float32[np.ndarray, "h w"],
    brightness: Float32[np.ndarray, "h w"],
    is_open: Bool[np.ndarray, "h w"],
    width_px: int,
) -> Float32[np.ndarray, "h w"]:
    """Estimate the visibility by mean-field inference.

    Args:
        colour_model: log of the image over the model without sun, and the log step of the sun.
        prior: log-odds of lit from the rendered visibility.
    """
    near = max(1, round(width_px * _MODEL.neighbourhood_fraction))
    weight = is_open.astype(np.float32)
    guide = np.log(np.maximum(brightness, _DARKEST)).astype(np.float32)
    # The initial value includes each pixel's colour: with the prior alone, a wide false shadow
    # would be a fixed point of the iteration.
    own = prior + _image_logit(*colour_model)
    visibility = _sigmoid(own)
    for _ in range(_MODEL.iterations):
        mean = guided_filter(guide, visibility, weight, near, 0.05)
        visibility = _sigmoid(
            own + np.float32(_MODEL.smoothness_logit) * (2 * np.clip(mean, 0, 1) - 1)
        )
    soft = guided_filter(guide, visibility, weight, max(1, near // 2), 0.01)
    return np.clip(soft, 0.0, 1.0).astype(np.float32)


def _image_logit(
    residual: Float32[np.ndarray, "h w 3"],
    step: Float32[np.ndarray, "h w 3"],
) -> Float32[np.ndarray, "h w"]:
    """Log-odds of lit against shadowed from each pixel's colour alone, limited.

    Brightness, red over blue, and green over both are taken as independent Gaussians.
    """
    basis = np.array([[1 / 3, 1 / 3, 1 / 3], [1.0, 0.0, -1.0], [-0.5, 1.0, -0.5]], np.float32)
    deviation = np.array(
        [_MODEL.luminance_deviation, _MODEL.chroma_deviation, _MODEL.chroma_deviation], np.float32
    )
    if_shadowed = residual @ basis.T / deviation
    if_lit = (residual - step) @ basis.T / deviation
    logit = 0.5 * (np.square(if_shadowed) - np.square(if_lit)).sum(axis=-1)
    limit = np.float32(_MODEL.largest_image_logit)
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
    logit = signed_px * _footprint_m(buffers) / _MODEL.geometry_error_m
    limit = _MODEL.largest_prior_logit
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
