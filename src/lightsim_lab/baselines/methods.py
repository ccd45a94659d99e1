"""Relighting methods of the laboratory: entry points of the group `lightsim.methods`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightsim.relighting.estimate import Estimate, Relight
from lightsim.relighting.methods import OWN_METHODS, Method
from lightsim_lab.weights import FIELD_WEIGHTS, LAB_WEIGHTS_FOLDER

if TYPE_CHECKING:
    from lightsim.relighting.network.stored import Kinds

FIELD_METHOD = "nerf-osr"


def all_kinds() -> Kinds:
    """Return the network classes of all methods, the product's and the laboratory's."""
    from lightsim.relighting.network.stored import KINDS
    from lightsim_lab.baselines.epe import EpeConfig, EpeNet
    from lightsim_lab.baselines.self_osr import SelfOsrConfig, SelfOsrNet

    return {**KINDS, "self-osr": (SelfOsrNet, SelfOsrConfig), "epe": (EpeNet, EpeConfig)}


def _shown_by(method: str, weights: Path | None) -> Relight:
    from lightsim.networks.devices import choose_device
    from lightsim.relighting.network.stored import network_for
    from lightsim_lab.baselines.relight import shown_by

    kinds = all_kinds()
    # The two networks have no common type beyond nn.Module.
    network: Any = network_for(kinds[method][0], weights, kinds, LAB_WEIGHTS_FOLDER)
    return partial(shown_by, network.to(choose_device("auto")))


def _colour_transfer(weights: Path | None) -> Relight:
    from lightsim_lab.baselines.relit_colour_transfer import relight_colour_transfer

    return lambda inputs, config: Estimate(relight_colour_transfer(inputs, config))


def _by_field(weights: Path | None) -> Relight:
    from lightsim_lab.baselines.nerf_osr.nerf_osr import relight_by_field

    assert weights is not None, "weights of one log are given as a file"
    return relight_by_field(weights)


COLOUR_TRANSFER = Method(_colour_transfer)
SELF_OSR = Method(partial(_shown_by, "self-osr"), "relight-self-osr", LAB_WEIGHTS_FOLDER)
EPE = Method(partial(_shown_by, "epe"), "relight-epe", LAB_WEIGHTS_FOLDER)
NERF_OSR = Method(_by_field, weights_in_work=FIELD_WEIGHTS, train_command="lightsim train nerf-osr")
LAB_METHODS = {
    "colour-transfer": COLOUR_TRANSFER,
    "self-osr": SELF_OSR,
    "epe": EPE,
    FIELD_METHOD: NERF_OSR,
}
ALL_METHODS = {**OWN_METHODS, **LAB_METHODS}
# Names of the methods that accept `--weights`.
NETWORKS = tuple(name for name, method in ALL_METHODS.items() if method.has_weights)
