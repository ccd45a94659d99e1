"""Completion of pixels that no recorded picture shows, from the rendered twin."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from lightsim.relighting.physical.filters import box_mean, fill_holes

# Width of the filter, as a fraction of the picture's width, with which the twin's colours are
# matched to the pictures. Sensitivity not measured.
_MATCH_WIDTH = 1 / 20
# Minimum fraction of sky on the border of a hole that is sky. Sensitivity not measured.
_MIN_SKY_BORDER = 0.1
# Radiance, scene units, below which surfaces count as unlit; added before logarithms.
_DARKEST = np.float32(1e-3)


def completed_by_twin(
    observed: Float32[np.ndarray, "h w 4"],
    rendered: Float32[np.ndarray, "h w 3"],
    is_observed: Bool[np.ndarray, "h w"],
    is_surface: Bool[np.ndarray, "h w"],
) -> Float32[np.ndarray, "h w 4"]:
    """Return radiance (RGB) and sky matte of the pictures, completed by the twin with its colours
    matched to the pictures, surfaces and sky separately.

    An unobserved hole of the twin is sky if it is adjacent to sky; otherwise it is a surface, such
    as a gap between a crown and the house behind it.
    """
    around = fill_holes(observed, is_observed)
    is_open = _is_sky_hole(~is_surface & ~is_observed, is_observed & (observed[..., 3] > 0.5))
    # Without any picture, pixels without a surface show the sky of the twin.
    is_open |= ~is_surface & ~is_observed.any()
    # Observed pixels retain their matte; holes are decided as a whole.
    matte = np.where(is_observed, observed[..., 3], is_open)
    surface, sky = (
        _match(observed[..., :3], rendered, is_observed & kind)
        for kind in (is_surface & (matte < 0.5), ~is_surface & (matte >= 0.5))
    )
    twin = rendered * np.where(is_surface[..., None], surface, sky)
    # Surfaces behind a hole of the twin's mesh receive no light: the surroundings are a better
    # estimate.
    is_unlit = is_surface & (rendered < _DARKEST).all(axis=-1) & is_observed.any()
    is_around = (is_unlit | ~(is_surface | is_open))[..., None]
    filled = np.where(is_around, around[..., :3], twin)
    radiance = np.where(is_observed[..., None], observed[..., :3], filled)
    return np.dstack([radiance, matte]).astype(np.float32)


def _is_sky_hole(
    is_hole: Bool[np.ndarray, "h w"], is_sky: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the connected holes with at least `_MIN_SKY_BORDER` of sky on their border."""
    hole = np.zeros(is_hole.shape, dtype=np.int32)
    ndimage.label(is_hole, np.ones((3, 3)), output=hole)
    border = np.where(is_hole, 0, ndimage.maximum_filter(hole, 3)).ravel()
    length = np.bincount(border, minlength=hole.max() + 1)
    sky = np.bincount(border, is_sky.ravel(), minlength=hole.max() + 1)
    return np.asarray(is_hole & (sky > _MIN_SKY_BORDER * length)[hole])


def _match(
    radiance: Float32[np.ndarray, "h w 3"],
    rendered: Float32[np.ndarray, "h w 3"],
    is_observed: Bool[np.ndarray, "h w"],
) -> Float32[np.ndarray, "h w 3"]:
    """Return the smoothed ratio of pictures to twin, interpolated over pixels without a picture."""
    if not is_observed.any():
        return np.ones_like(rendered)
    # Logarithms give bright and dark pixels the same weight in the mean.
    ratio = np.log(radiance + _DARKEST) - np.log(rendered + _DARKEST)
    filled = fill_holes(ratio.astype(np.float32), is_observed)
    radius = max(1, round(_MATCH_WIDTH * radiance.shape[1] / 2))
    return np.exp(box_mean(filled, radius)).astype(np.float32)
