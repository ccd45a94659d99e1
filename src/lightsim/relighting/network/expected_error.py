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
_OF_CONTRAST, _OF_DISAGREEMENT = 0.5, 0.25
_CONSTANT = 1.43
"""These four were chosen on street 0 (`benchmarks/expected_error.py`)."""


def expected_error(found: Correction, working: Batch) -> Float[Tensor, "n 1 p q"]:
    """Mean absolute error expected of the picture's sRGB codes, at half of the working size.

    The network knows what kind of surface tends to be wrong. Whatever is displaced, blurred or
    wrongly cut shows where the picture has contrast, and what nobody knows where the picture and
    the twin's own rendering disagree; a product of powers takes them together.

    Args:
        found: by the network.
        working: the planes that it saw, at the working size.
    """
    code = srgb_of(found.picture).clamp(0, 1)
    code = functional.interpolate(code, working["source"].shape[-2:], mode="area")
    rendered = srgb_of(modelled(working, "target")).clamp(0, 1)
    light = code.mean(1, keepdim=True)
    width = 2 * _REACH_PX + 1
    darkest, brightest = (
        sign * functional.max_pool2d(sign * light, width, 1, _REACH_PX) for sign in (-1, 1)
    )
    cues = brightest - darkest, (rendered - code).abs().mean(1, keepdim=True)
    contrast, disagreement = (
        torch.log(functional.interpolate(cue, found.log_error.shape[-2:], mode="area") + _FLOOR)
        for cue in cues
    )
    log_error = found.log_error + _OF_CONTRAST * contrast + _OF_DISAGREEMENT * disagreement
    return torch.exp(log_error + _CONSTANT).clamp_max(1.0)
