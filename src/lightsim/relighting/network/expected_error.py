"""How far off a corrected picture is expected to be: what the network says, and what it shows."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from lightsim.relighting.network.features import Batch, modelled, srgb_of
from lightsim.relighting.network.model import Correction

_REACH_PX = 2
"""Of a pixel of the working size: contrast is the range of codes so far around."""
_FLOOR = 0.02
"""Of codes: added before the log."""
POWERS = (0.63, 0.06, 0.14, 0.74)
_CONSTANT = -0.67
"""Fitted on streets that the shipped network had not seen (`benchmarks/expected_error_fit.py`)."""


def expected_error(found: Correction, working: Batch) -> Float[Tensor, "n 1 p q"]:
    """Mean absolute error expected of the picture's sRGB codes, at half of the working size.

    The network knows what kind of surface tends to be wrong. Whatever is displaced, blurred or
    wrongly cut shows where the picture has contrast, what nobody knows where the picture and the
    twin's own rendering disagree, and shadows that are guesses where the sun is half seen; a
    product of powers takes them together.

    Args:
        found: by the network.
        working: the planes that it saw, at the working size.
    """
    powers = found.log_error.new_tensor(POWERS)[:, None, None]
    log_error = (powers * error_cues(found, working)).sum(1, keepdim=True)
    return torch.exp(log_error + _CONSTANT).clamp_max(1.0)


def error_cues(found: Correction, working: Batch) -> Float[Tensor, "n 4 p q"]:
    """Logs of what the expected error is a product of powers of."""
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
        # Between 1 and 3: most where half of the disc, or of the guesses, is open.
        torch.log1p(8 * _small(sun * (1 - sun), found)),
    )
    return torch.cat([found.log_error, *shown], dim=1)


def _small(cue: Float[Tensor, "n 1 h w"], found: Correction) -> Float[Tensor, "n 1 p q"]:
    return functional.interpolate(cue, found.log_error.shape[-2:], mode="area")
