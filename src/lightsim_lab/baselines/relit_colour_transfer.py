"""Colour transfer as a way of relighting: the picture takes over the colours of a rendered one.

The baseline of the paper (appendix, "Color Transfer"): statistics in CIE L*a*b* (Reinhard et al.
2001, doi:10.1109/38.946629) towards I_render|tgt, the twin under the target light. It knows of no
shadow: light changes everywhere alike.
"""

from __future__ import annotations

import warnings

import numpy as np
from jaxtyping import Float32

from lightsim.core.colour import linear_from_srgb, srgb_from_linear
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs

_FLAT = 1e-3
"""Of L*, a* or b* (black to white is 100): a smaller deviation is rounding, not contrast."""


def relight_colour_transfer(
    inputs: RelightInputs, config: RatioConfig
) -> Float32[np.ndarray, "h w 3"]:
    """Scene radiance of the frame with mean and deviation of L*, a* and b* of the rendered target:
    base colour x target light, the target sky behind. Linear, before camera gain, in [0, 1].

    Args:
        config: of other methods; not looked at.
    """
    lit = inputs.buffers.base_colour * inputs.target.shaded
    is_surface = inputs.buffers.has_surface[..., None]
    rendered = np.where(is_surface, lit, inputs.target_sky).astype(np.float32)
    return transfer_colours(inputs.radiance, rendered)


def transfer_colours(
    radiance: Float32[np.ndarray, "h w 3"], target: Float32[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w 3"]:
    """The first picture with the statistics of the second; both linear."""
    from skimage.color import lab2rgb, rgb2lab

    source, wanted = (rgb2lab(srgb_from_linear(x).astype(np.float64)) for x in (radiance, target))
    (from_mean, from_std), (to_mean, to_std) = (
        (lab.mean(axis=(0, 1)), lab.std(axis=(0, 1))) for lab in (source, wanted)
    )
    moved = (source - from_mean) * (to_std / np.where(from_std > _FLAT, from_std, 1.0)) + to_mean
    with warnings.catch_warnings():
        # Colours that no screen shows are clipped, and scikit-image says so.
        warnings.simplefilter("ignore", UserWarning)
        srgb = lab2rgb(moved)
    return linear_from_srgb(srgb).astype(np.float32)
