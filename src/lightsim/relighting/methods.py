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

    Networks run on CUDA where torch finds it.

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
    from lightsim.networks.devices import choose_device
    from lightsim.relighting.baselines.epe import EpeNet
    from lightsim.relighting.baselines.relight import shown_by
    from lightsim.relighting.baselines.self_osr import SelfOsrNet
    from lightsim.relighting.network.model import RelitNet
    from lightsim.relighting.network.paper_model import PaperNet
    from lightsim.relighting.network.relight import painted_by, relit_by
    from lightsim.relighting.network.stored import network_for

    device = choose_device("auto")
    if method == "self-osr":
        return partial(shown_by, network_for(SelfOsrNet, weights).to(device))
    if method == "epe":
        return partial(shown_by, network_for(EpeNet, weights).to(device))
    if method == "paper":
        return partial(painted_by, network_for(PaperNet, weights).to(device))
    return partial(relit_by, network_for(RelitNet, weights).to(device))
