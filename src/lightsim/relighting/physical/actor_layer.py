"""Image layer of rendered actors with the sharpness of the recording camera and motion blur.

A layer is a premultiplied radiance and a coverage (Porter & Duff 1984, doi:10.1145/800031.808606).
Both are blurred alike, so that edges are correct over any background.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from lightsim.core.colour import linear_from_srgb, srgb_from_linear
from lightsim.core.window import Window, window_around
from lightsim.relighting.physical.blur_noise import (
    CameraBlurNoise,
    blur_reach_px,
    blurred,
    sharpened,
)
from lightsim.relighting.physical.filters import fill_holes

# Motion during the exposure, in pixels, below which no motion blur is applied: it is invisible.
_STILL_PX = 0.25
# Distance between samples along the motion, in pixels; the layer is interpolated between pixels.
_TAP_PX = 0.5


@dataclass(frozen=True, eq=False)
class ActorLayer:
    """Actors without their background, in the whole picture.

    Args:
        radiance: radiance times coverage, linear, scene units.
        coverage: fraction of each pixel that actors cover.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    coverage: Float32[np.ndarray, "h w"]

    def part(self, window: Window) -> ActorLayer:
        """Return a window of the layer."""
        return ActorLayer(self.radiance[window], self.coverage[window])

    def over(
        self,
        background: Float32[np.ndarray, "h w 3"],
        blur_noise: CameraBlurNoise,
        gain: Float32[np.ndarray, "3"],
    ) -> Float32[np.ndarray, "h w 3"]:
        """Composite the actors over a recorded image, with the edge sharpening of the camera."""
        seen = self.radiance + (1 - self.coverage[..., None]) * background
        is_shown = self.coverage > 0
        if blur_noise.spread_px2 >= 0 or not is_shown.any():
            return seen.astype(np.float32)
        part = window_around(is_shown, 1)
        behind, together = (srgb_from_linear(x[part] * gain) for x in (background, seen))
        cover = self.coverage[part][..., None]
        # The recorded background is sharpened already, so only the layer and its coverage are.
        layer = np.concatenate([together - (1 - cover) * behind, cover], axis=-1)
        layer = sharpened(layer.astype(np.float32), blur_noise)
        codes = layer[..., :3] + (1 - layer[..., 3:]) * behind
        is_near = np.asarray(ndimage.binary_dilation(is_shown[part]), dtype=bool)[..., None]
        # Pixels brighter than the camera's white keep their radiance, which codes do not represent.
        is_touched = is_near & ((codes < 1) | (together < 1))
        seen[part] = np.where(is_touched, linear_from_srgb(codes) / gain, seen[part])
        return seen.astype(np.float32)


def empty_layer(height_px: int, width_px: int) -> ActorLayer:
    """Layer without actors."""
    return ActorLayer(
        np.zeros((height_px, width_px, 3), np.float32), np.zeros((height_px, width_px), np.float32)
    )


def cut_out(
    rendered: Float32[np.ndarray, "h w 3"],
    sampled: Float32[np.ndarray, "h w"],
    coverage: Float32[np.ndarray, "h w"],
    is_rendered: Bool[np.ndarray, "h w"],
) -> ActorLayer:
    """Extract the actors of a rendered picture, without the background in mixed edge pixels.

    Args:
        sampled: fraction of samples that show actors, among the samples averaged in `rendered`. Any
            other estimate would leave background at the edges, or remove parts of the actor.
        coverage: accurate fraction of each pixel that actors cover.
        is_rendered: pixels that were rendered: those of actors, and some around them.
    """
    # Un-mixing as for the sky: rendered = fraction * actor + (1 - fraction) * background.
    behind = fill_holes(rendered, is_rendered & (sampled == 0))
    fraction = np.where(sampled > 0, sampled, 1.0)[..., None]
    own = np.maximum(rendered - (1 - fraction) * behind, 0.0) / fraction
    # Parts of an actor between all samples of a pixel have no colour: use that of their neighbours.
    actor = fill_holes(own.astype(np.float32), sampled > 0)
    return ActorLayer((coverage[..., None] * actor).astype(np.float32), coverage)


def as_recorded(
    layer: ActorLayer, blur_noise: CameraBlurNoise, motion_px: Float32[np.ndarray, "h w 2"]
) -> ActorLayer:
    """Return the layer as the camera's sensor records it: with motion blur and the lens's blur.

    Args:
        motion_px: motion (u, v) of the actors' pixels during the exposure; NaN outside actors.
    """
    is_shown = layer.coverage > 0
    if not is_shown.any():
        return layer
    is_known = np.isfinite(motion_px[..., 0])
    motion_px = fill_holes(np.nan_to_num(motion_px).astype(np.float32), is_known)
    longest_px = float(np.abs(motion_px[is_shown]).max()) if is_known.any() else 0.0
    reach = blur_reach_px(blur_noise) + int(np.ceil(longest_px / 2))
    part = window_around(is_shown, reach)
    stack = np.concatenate([layer.radiance[part], layer.coverage[part][..., None]], axis=-1)
    if longest_px >= _STILL_PX:
        stack = _moved(stack, motion_px[part], longest_px)
    stack = blurred(stack, blur_noise)
    result = empty_layer(*layer.coverage.shape)
    result.radiance[part], result.coverage[part] = stack[..., :3], stack[..., 3]
    return result


def _moved(
    image: Float32[np.ndarray, "h w c"], motion_px: Float32[np.ndarray, "h w 2"], longest_px: float
) -> Float32[np.ndarray, "h w c"]:
    """Mean over the exposure: the samples of each pixel lie along its motion."""
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
