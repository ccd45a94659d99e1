"""Relighting by colour transfer from a rendering of the twin under the target light.

Baseline of the paper (appendix, "Color Transfer"): mean and standard deviation in CIE L*a*b*
(Reinhard et al. 2001, doi:10.1109/38.946629) are set to those of I_render|tgt. The change of colour
is global, so shadows stay where they were.
"""

from __future__ import annotations

import warnings

import numpy as np
from jaxtyping import Float32

from lightsim.core.colour import linear_from_srgb, srgb_from_linear
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs

# Standard deviation of L*, a* or b* (black to white is 100) below which a channel is constant up to
# rounding and is not scaled.
_FLAT = 1e-3


def relight_colour_transfer(
    inputs: RelightInputs, config: RatioConfig
) -> Float32[np.ndarray, "h w 3"]:
    """Return the frame's linear radiance, before camera gain, in [0, 1], with the mean and standard
    deviation of L*, a* and b* of the rendered target (base colour x target light, target sky).

    Args:
        config: unused; part of the interface of all methods.
    """
    lit = inputs.buffers.base_colour * inputs.target.shaded
    is_surface = inputs.buffers.has_surface[..., None]
    rendered = np.where(is_surface, lit, inputs.target_sky).astype(np.float32)
    return transfer_colours(inputs.radiance, rendered)


def transfer_colours(
    radiance: Float32[np.ndarray, "h w 3"], target: Float32[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return the first picture with the statistics of the second; both are linear."""
    from skimage.color import lab2rgb, rgb2lab

    source, wanted = (rgb2lab(srgb_from_linear(x).astype(np.float64)) for x in (radiance, target))
    (from_mean, from_std), (to_mean, to_std) = (
        (lab.mean(axis=(0, 1)), lab.std(axis=(0, 1))) for lab in (source, wanted)
    )
    moved = (source - from_mean) * (to_std / np.where(from_std > _FLAT, from_std, 1.0)) + to_mean
    with warnings.catch_warnings():
        # scikit-image warns of colours outside the sRGB gamut, which it clips as intended here.
        warnings.simplefilter("ignore", UserWarning)
        srgb = lab2rgb(moved)
    return linear_from_srgb(srgb).astype(np.float32)
