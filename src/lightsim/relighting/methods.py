"""The ways of relighting a frame, by the names that users give."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from lightsim.relighting.colour_transfer import relight_colour_transfer
from lightsim.relighting.options import Method
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs, relight_physical

Relight = Callable[[RelightInputs, RatioConfig], Float32[np.ndarray, "h w 3"]]
"""(inputs of a frame, settings) -> radiance under the target sky."""


def relight_by(method: Method, weights: Path | None = None) -> Relight:
    """A way of relighting; `nerf-osr` needs the field of its street (`baselines.relight`).

    Args:
        weights: of a network; None: those of the package.

    Raises:
        InputError, ArtefactError: the weights are missing or damaged, or another network's.
    """
    if method == "physical":
        return relight_physical
    if method == "colour-transfer":
        return relight_colour_transfer
    # They bring torch, which the others do without.
    from lightsim.relighting.baselines.relight import baseline_network, shown_by
    from lightsim.relighting.network import relight as networks

    if method in ("self-osr", "epe"):
        return partial(shown_by, baseline_network(method, weights))
    if method == "network":
        return partial(networks.relit_by, networks.correcting_network(weights))
    return partial(networks.painted_by, networks.painting_network(weights))
