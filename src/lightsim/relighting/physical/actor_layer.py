"""Rendered actors as a layer that a camera could have recorded: as sharp as its pictures are, and
blurred by what moves while the shutter is open.

A layer is a premultiplied radiance and a coverage (Porter & Duff 1984, doi:10.1145/800031.808606):
whatever blurs one blurs the other, so that edges stay right over any background.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from lightsim.core.colour import linear_from_srgb, srgb_from_linear
from lightsim.core.window import Window, window_around
from lightsim.relighting.physical.camera_look import (
    CameraLook,
    blur_reach_px,
    blurred,
    sharpened,
)
from lightsim.relighting.physical.filters import fill_holes

# Shorter motion is not seen.
_STILL_PX = 0.25
# Taps along the motion lie this close together; between them the layer is interpolated.
_TAP_PX = 0.5


@dataclass(frozen=True, eq=False)
class ActorLayer:
    """Actors without what is behind them, in the whole picture.

    Args:
        radiance: times coverage, linear, scene units.
        coverage: fraction of each pixel.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    coverage: Float32[np.ndarray, "h w"]

    def part(self, window: Window) -> ActorLayer:
        """A window of the picture."""
        return ActorLayer(self.radiance[window], self.coverage[window])

    def over(
        self,
        background: Float32[np.ndarray, "h w 3"],
        look: CameraLook,
        gain: Float32[np.ndarray, "3"],
    ) -> Float32[np.ndarray, "h w 3"]:
        """The background, which the camera recorded, with the actors before it; where the camera
        sharpens, their edges are sharpened with them."""
        seen = self.radiance + (1 - self.coverage[..., None]) * background
        is_shown = self.coverage > 0
        if look.spread_px2 >= 0 or not is_shown.any():
            return seen.astype(np.float32)
        part = window_around(is_shown, 1)
        behind, together = (srgb_from_linear(x[part] * gain) for x in (background, seen))
        cover = self.coverage[part][..., None]
        # Of the background, that is sharpened already, as much is left as is seen.
        layer = np.concatenate([together - (1 - cover) * behind, cover], axis=-1)
        layer = sharpened(layer.astype(np.float32), look)
        codes = layer[..., :3] + (1 - layer[..., 3:]) * behind
        is_near = np.asarray(ndimage.binary_dilation(is_shown[part]), dtype=bool)[..., None]
        # What is brighter than the camera can code keeps its radiance.
        is_touched = is_near & ((codes < 1) | (together < 1))
        seen[part] = np.where(is_touched, linear_from_srgb(codes) / gain, seen[part])
        return seen.astype(np.float32)


def empty_layer(height_px: int, width_px: int) -> ActorLayer:
    """Nobody."""
    return ActorLayer(
        np.zeros((height_px, width_px, 3), np.float32), np.zeros((height_px, width_px), np.float32)
    )


def cut_out(
    rendered: Float32[np.ndarray, "h w 3"],
    sampled: Float32[np.ndarray, "h w"],
    coverage: Float32[np.ndarray, "h w"],
    is_rendered: Bool[np.ndarray, "h w"],
) -> ActorLayer:
    """Actors of a rendered picture: at their edges the part that is background is taken out.

    Args:
        sampled: fraction of the samples that show actors, of those whose mean `rendered` is: with
            another fraction, background would stay at edges, or be taken from the actor.
        coverage: fraction of each pixel that they fill, as exact as edges shall be.
        is_rendered: pixels that the picture shows: those of actors, and some around.
    """
    behind = fill_holes(rendered, is_rendered & (sampled == 0))
    fraction = np.where(sampled > 0, sampled, 1.0)[..., None]
    own = np.maximum(rendered - (1 - fraction) * behind, 0.0) / fraction
    # What lies between all samples of a pixel has the colour of what is beside it.
    actor = fill_holes(own.astype(np.float32), sampled > 0)
    return ActorLayer((coverage[..., None] * actor).astype(np.float32), coverage)


def photographed(
    layer: ActorLayer, look: CameraLook, motion_px: Float32[np.ndarray, "h w 2"]
) -> ActorLayer:
    """The layer as it reaches the camera's sensor.

    Args:
        motion_px: by which (u, v) pixels of actors move while the shutter is open; NaN where
            nobody is.
    """
    is_shown = layer.coverage > 0
    if not is_shown.any():
        return layer
    is_known = np.isfinite(motion_px[..., 0])
    motion_px = fill_holes(np.nan_to_num(motion_px).astype(np.float32), is_known)
    longest_px = float(np.abs(motion_px[is_shown]).max()) if is_known.any() else 0.0
    reach = blur_reach_px(look) + int(np.ceil(longest_px / 2))
    part = window_around(is_shown, reach)
    stack = np.concatenate([layer.radiance[part], layer.coverage[part][..., None]], axis=-1)
    if longest_px >= _STILL_PX:
        stack = _moved(stack, motion_px[part], longest_px)
    stack = blurred(stack, look)
    result = empty_layer(*layer.coverage.shape)
    result.radiance[part], result.coverage[part] = stack[..., :3], stack[..., 3]
    return result


def _moved(
    image: Float32[np.ndarray, "h w c"], motion_px: Float32[np.ndarray, "h w 2"], longest_px: float
) -> Float32[np.ndarray, "h w c"]:
    """Mean over the exposure: each pixel sees what lies along its motion."""
    taps = max(2, int(np.ceil(longest_px / _TAP_PX)))
    times = (np.arange(taps) + 0.5) / taps - 0.5
    rows, columns = np.indices(image.shape[:2], dtype=np.float32)
    mean = np.zeros_like(image)
    for time in times.astype(np.float32):
        at = (rows - time * motion_px[..., 1], columns - time * motion_px[..., 0])
        for channel in range(image.shape[2]):
            mean[..., channel] += ndimage.map_coordinates(
                image[..., channel], at, order=1, mode="nearest"
            )
    return (mean / taps).astype(np.float32)
