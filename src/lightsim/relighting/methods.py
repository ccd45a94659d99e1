"""The ways of relighting a frame, by the names that users give."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from lightsim.relighting.colour_transfer import relight_colour_transfer
from lightsim.relighting.estimate import Estimate, Relight
from lightsim.relighting.options import Method
from lightsim.relighting.physical.ratio import relight_physical


def relight_by(method: Method, weights: Path | None = None) -> Relight:
    """A way of relighting; `nerf-osr` needs the field of its street (`baselines.relight`).

    Args:
        weights: of a network; None: those of the package.

    Raises:
        InputError, ArtefactError: the weights are missing or damaged, or another network's.
    """
    if method == "physical":
        return lambda inputs, config: Estimate(relight_physical(inputs, config))
    if method == "colour-transfer":
        return lambda inputs, config: Estimate(relight_colour_transfer(inputs, config))
    # They bring torch, which the others do without.
    from lightsim.relighting.baselines.relight import baseline_network, shown_by
    from lightsim.relighting.network import relight as networks

    if method in ("self-osr", "epe"):
        return partial(shown_by, baseline_network(method, weights))
    if method == "network":
        return partial(networks.relit_by, networks.correcting_network(weights))
    return partial(networks.painted_by, networks.painting_network(weights))
