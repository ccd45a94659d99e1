"""Outlines of occluders from the picture: leaves between an inserted actor and the camera that no
mesh contains.

Near a static surface that is well in front of the actor, pixels of the actor are also hidden if
their recorded colour is that of the surface and not that of the background. Pixels that the mesh
hides stay hidden: the actor was not rendered there, and the colours of poles and walls are too
similar to be separated (examined on log 002; cars as occluders have accurate meshes, and panes).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from lightsim.core.buffers import BACKGROUND, GBuffers
from lightsim.core.outline import nearest_of
from lightsim.core.window import window_around
from lightsim.relighting.physical.filters import colour_guided_filter

# Chosen by eye on log 002; sensitivity not measured.

# Distance of an occluder in front of the actor, at least, in metres. Surfaces that touch the actor,
# such as the ground, have their edge where both meshes meet.
_BEFORE_M = 0.5
# Vertical component of the normal above which a surface is ground and no occluder.
_LEVEL = 0.7
# Distance from a reconstructed surface within which pixels may belong to it: this many metres on
# the surface, plus `_REACH_PX` pixels.
_REACH_M = 0.12
# Part of that distance that does not depend on the depth, in pixels.
_REACH_PX = 1.5
# Limit on that distance, in pixels.
_FARTHEST_PX = 16.0
# Radius of the windows over which the colours of both sides are learnt, over the median reach.
_WINDOW = 3
# Weight of undecided pixels in these windows.
_UNDECIDED_WEIGHT = 0.05
# Variance of sRGB codes below which colours are taken as equal.
_SAME_COLOUR = 1e-3
# Likeness to the occluder's colour at which a pixel begins to belong to it, and at which it belongs
# to it fully.
_LIKENESS = (0.5, 0.8)


def hidden_by_picture(
    codes: Float32[np.ndarray, "h w 3"],
    buffers: GBuffers,
    is_new: Bool[np.ndarray, "h w"],
    focal_px: float,
) -> Float32[np.ndarray, "h w"]:
    """Fraction of the new actors' pixels that a nearer surface hides, according to the recorded
    picture.

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
    reach_px = focal_px * _REACH_M / buffers.depth_z_m[nearest] + _REACH_PX
    is_open = _grown(is_new) & (distance_px <= np.minimum(reach_px, _FARTHEST_PX))
    if not is_open.any():
        return hidden
    radius = _WINDOW * int(np.ceil(np.median(reach_px[is_open]).clip(1, _FARTHEST_PX)))
    part = window_around(is_open, 2 * radius)
    weight = np.where(is_open, np.float32(_UNDECIDED_WEIGHT), np.float32(1))
    likeness = colour_guided_filter(
        codes[part], before[part].astype(np.float32), weight[part], radius, _SAME_COLOUR
    )
    low, high = _LIKENESS
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
    is_before = buffers.depth_z_m < buffers.depth_z_m[nearest] - _BEFORE_M
    is_upright = buffers.normal_world[..., 2] < _LEVEL
    return is_before & is_upright & (buffers.actor_index == BACKGROUND)
