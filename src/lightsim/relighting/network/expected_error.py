"""Expected error of a corrected picture, from the network's prediction and from the picture
itself."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from lightsim.relighting.network.features import Batch, modelled, srgb_of
from lightsim.relighting.network.model import Correction

# Radius of the window, in pixels of the working size, over which contrast is the range of codes.
_REACH_PX = 2
# Added to codes (in [0, 1]) before the log, so that flat regions stay finite.
_FLOOR = 0.02
# Exponents of the cues in the order of `error_cues`, fitted on streets outside the training set of
# the shipped network (`benchmarks/expected_error_fit.py`).
POWERS = (0.63, 0.06, 0.14, 0.74)
# Log of the constant factor, from the same fit.
_CONSTANT = -0.67


def expected_error(found: Correction, working: Batch) -> Float[Tensor, "n 1 p q"]:
    """Expected mean absolute error of the picture's sRGB codes, at half of the working size.

    The estimate is a product of powers of four cues: the error that the network predicts; contrast
    of the picture, where displacement, blur and wrong outlines cause errors; the difference between
    picture and rendering of the twin, where the light is wrong; and half-visible sun, where shadows
    are uncertain.

    Args:
        found: output of the network.
        working: the network's input planes, at the working size.
    """
    powers = found.log_error.new_tensor(POWERS)[:, None, None]
    log_error = (powers * error_cues(found, working)).sum(1, keepdim=True)
    return torch.exp(log_error + _CONSTANT).clamp_max(1.0)


def error_cues(found: Correction, working: Batch) -> Float[Tensor, "n 4 p q"]:
    """Logs of the four cues whose weighted sum is the log of the expected error."""
    code = srgb_of(found.picture).clamp(0, 1)
    code = functional.interpolate(code, working["source"].shape[-2:], mode="area")
    rendered = srgb_of(modelled(working, "target")).clamp(0, 1)
    light, sun = code.mean(1, keepdim=True), working["target_sun"]
    width = 2 * _REACH_PX + 1
    darkest, brightest = (
        sign * functional.max_pool2d(sign * light, width, 1, _REACH_PX) for sign in (-1, 1)
    )
    shown = (
        torch.log(_small(brightest - darkest, found) + _FLOOR),
        torch.log(_small((rendered - code).abs().mean(1, keepdim=True), found) + _FLOOR),
        # Between 1 and 3 before the log: largest where half of the solar disc is visible.
        torch.log1p(8 * _small(sun * (1 - sun), found)),
    )
    return torch.cat([found.log_error, *shown], dim=1)


def _small(cue: Float[Tensor, "n 1 h w"], found: Correction) -> Float[Tensor, "n 1 p q"]:
    return functional.interpolate(cue, found.log_error.shape[-2:], mode="area")
