"""The ways of relighting a frame, by the names that users give."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float32

from lightsim.relighting.colour_transfer import relight_colour_transfer
from lightsim.relighting.options import Method
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs, relight_physical

Radiance = Float32[np.ndarray, "h w 3"]


def _network(inputs: RelightInputs, config: RatioConfig) -> Radiance:
    # It brings torch, which physical relighting does without.
    from lightsim.relighting.network.relight import relight_network

    return relight_network(inputs, config)


def _paper(inputs: RelightInputs, config: RatioConfig) -> Radiance:
    from lightsim.relighting.network.relight import relight_paper

    return relight_paper(inputs, config)


METHODS: Mapping[Method, Callable[[RelightInputs, RatioConfig], Radiance]] = {
    "physical": relight_physical,
    "network": _network,
    "paper": _paper,
    "colour-transfer": relight_colour_transfer,
}
"""(inputs of a frame, settings) -> radiance under the target sky."""
