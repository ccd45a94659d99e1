"""What the picture knows better of an occluder's edge than the twin's mesh: leaves between an
inserted actor and the camera that no mesh holds.

Near a static surface that stands well before the actor, pixels of the actor whose recorded colour
is that of the surface, and not that of what lies behind it, are hidden too. Whatever the mesh
hides stays hidden: what the actor looks like there was not rendered, and colours of poles and walls
are too alike to tell (looked at on log 002; cars as occluders have good meshes, and panes).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from lightsim.core.buffers import BACKGROUND, GBuffers
from lightsim.core.outline import nearest_of
from lightsim.core.window import window_around
from lightsim.relighting.physical.filters import colour_guided_filter

# An occluder stands at least this far before the actor: what touches it, as the ground does, has
# its edge where both meshes meet. Surfaces less upright than that are ground.
_BEFORE_M, _LEVEL = 0.5, 0.7
# What is as near as this to a reconstructed surface may belong to it, in metres and pixels; and no
# farther than this many pixels.
_REACH_M, _REACH_PX, _FARTHEST_PX = 0.12, 1.5, 16.0
# The colours of both sides are learnt over windows this many times as wide; pixels that are in
# question count this much.
_WINDOW, _IN_QUESTION = 3, 0.05
# Variance of sRGB codes below which colours are one; from which on a pixel is partly, and from
# which on wholly the occluder's. Looked at on log 002.
_SAME_COLOUR, _SURE = 1e-3, (0.5, 0.8)


def hidden_by_picture(
    codes: Float32[np.ndarray, "h w 3"],
    buffers: GBuffers,
    is_new: Bool[np.ndarray, "h w"],
    focal_px: float,
) -> Float32[np.ndarray, "h w"]:
    """Fraction of new actors' pixels that something nearer hides, by the recorded picture.

    Args:
        codes: the recorded picture, sRGB in [0, 1].
        buffers: of the street with the actors.
        is_new: pixels whose centres show them; those beside may show a part of them.
    """
    hidden = np.zeros(is_new.shape, np.float32)
    before = _occluders(buffers, is_new)
    if not (is_new.any() and before.any()):
        return hidden
    distance_px, nearest = nearest_of(before)
    reach_px = focal_px * _REACH_M / buffers.depth_z_m[nearest] + _REACH_PX
    is_asked = _grown(is_new) & (distance_px <= np.minimum(reach_px, _FARTHEST_PX))
    if not is_asked.any():
        return hidden
    radius = _WINDOW * int(np.ceil(np.median(reach_px[is_asked]).clip(1, _FARTHEST_PX)))
    part = window_around(is_asked, 2 * radius)
    weight = np.where(is_asked, np.float32(_IN_QUESTION), np.float32(1))
    likeness = colour_guided_filter(
        codes[part], before[part].astype(np.float32), weight[part], radius, _SAME_COLOUR
    )
    sure = np.clip((likeness - _SURE[0]) / (_SURE[1] - _SURE[0]), 0.0, 1.0)
    hidden[part] = np.where(is_asked[part], sure, 0.0)
    return hidden


def _grown(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    return np.asarray(ndimage.binary_dilation(mask, np.ones((3, 3), bool)), dtype=bool)


def _occluders(buffers: GBuffers, is_new: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Static upright surfaces that stand before the nearest pixel of an actor."""
    if not is_new.any():
        return np.zeros_like(is_new)
    _, nearest = nearest_of(is_new)
    is_before = buffers.depth_z_m < buffers.depth_z_m[nearest] - _BEFORE_M
    is_upright = buffers.normal_world[..., 2] < _LEVEL
    return is_before & is_upright & (buffers.actor_index == BACKGROUND)
