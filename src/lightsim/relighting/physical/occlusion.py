"""Outlines of occluders from the picture, such as leaves in front of an inserted actor that are
missing in the mesh.

Near a static surface in front of the actor, pixels of the actor are also occluded if their recorded
colour resembles the surface rather than the background. Occlusion by the mesh is unchanged: the
actor is not rendered there, and the colours of poles and walls are too similar to be separated
(examined on log 002; cars as occluders have accurate meshes, and panes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from lightsim.core.buffers import BACKGROUND, GBuffers
from lightsim.core.outline import nearest_of
from lightsim.core.window import window_around
from lightsim.relighting.physical.filters import colour_guided_filter


@dataclass(frozen=True)
class _OutlineModel:
    """Thresholds between occluder and background.

    The values were chosen by eye on log 002; their sensitivity was not measured.
    """

    before_m: float = 0.5
    """Distance of an occluder in front of the actor, at least, in metres. Surfaces that touch
    the actor, such as the ground, have their edge where both meshes meet."""
    level: float = 0.7
    """Vertical component of the normal above which a surface is ground and no occluder."""
    reach_m: float = 0.12
    """Distance from a reconstructed surface within which pixels may belong to it: this many
    metres on the surface, plus `reach_px` pixels."""
    reach_px: float = 1.5
    """Part of that distance that does not depend on the depth, in pixels."""
    farthest_px: float = 16.0
    """Limit on that distance, in pixels."""
    window: int = 3
    """Radius of the windows in which the colours of both sides are fitted, relative to the median
    reach."""
    undecided_weight: float = 0.05
    """Weight of undecided pixels in these windows."""
    same_colour: float = 1e-3
    """Variance of sRGB codes below which colours are taken as equal."""
    likeness: tuple[float, float] = (0.5, 0.8)
    """Similarity to the occluder's colour at which a pixel is first partly, then fully occluded."""


_MODEL = _OutlineModel()


def occlusion_from_picture(
    codes: Float32[np.ndarray, "h w 3"],
    buffers: GBuffers,
    is_new: Bool[np.ndarray, "h w"],
    focal_px: float,
) -> Float32[np.ndarray, "h w"]:
    """Return the occluded fraction of the new actors' pixels according to the recorded picture.

    Args:
        codes: the recorded picture, sRGB in [0, 1].
        buffers: geometry of the street with the actors.
        is_new: pixels whose centres show new actors; their neighbours may show a part of them.
    """
    hidden = np.zeros(is_new.shape, np.float32)
    before = _occluders(buffers, is_new)
    if not (is_new.any() and before.any()):
        return hidden
    distance_px, nearest = nearest_of(before)
    # Depth errors move outlines by a length in the scene, and sampling by about a pixel.
    reach_px = focal_px * _MODEL.reach_m / buffers.depth_z_m[nearest] + _MODEL.reach_px
    is_open = _grown(is_new) & (distance_px <= np.minimum(reach_px, _MODEL.farthest_px))
    if not is_open.any():
        return hidden
    radius = _MODEL.window * int(np.ceil(np.median(reach_px[is_open]).clip(1, _MODEL.farthest_px)))
    part = window_around(is_open, 2 * radius)
    weight = np.where(is_open, np.float32(_MODEL.undecided_weight), np.float32(1))
    # The filter fits, per window, the occluder mask as a linear function of colour (a local matte).
    likeness = colour_guided_filter(
        codes[part], before[part].astype(np.float32), weight[part], radius, _MODEL.same_colour
    )
    low, high = _MODEL.likeness
    fraction = np.clip((likeness - low) / (high - low), 0.0, 1.0)
    hidden[part] = np.where(is_open[part], fraction, 0.0)
    return hidden


def _grown(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    return np.asarray(ndimage.binary_dilation(mask, np.ones((3, 3), bool)), dtype=bool)


def _occluders(buffers: GBuffers, is_new: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Static upright surfaces in front of the nearest pixel of an actor."""
    if not is_new.any():
        return np.zeros_like(is_new)
    _, nearest = nearest_of(is_new)
    is_before = buffers.depth_z_m < buffers.depth_z_m[nearest] - _MODEL.before_m
    is_upright = buffers.normal_world[..., 2] < _MODEL.level
    return is_before & is_upright & (buffers.actor_index == BACKGROUND)
