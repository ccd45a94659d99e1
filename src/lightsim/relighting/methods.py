"""The ways of relighting a frame, by the names that users give."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float32

from lightsim.relighting.colour_transfer import relight_colour_transfer
from lightsim.relighting.options import Method
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs, relight_physical

METHODS: Mapping[Method, Callable[[RelightInputs, RatioConfig], Float32[np.ndarray, "h w 3"]]] = {
    "physical": relight_physical,
    "colour-transfer": relight_colour_transfer,
}
"""(inputs of a frame, settings) -> radiance under the target sky."""
