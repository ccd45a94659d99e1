"""Relighting methods by name: those of this package, and those that other packages register."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType

from lightsim.core.extensions import LABORATORY, METHODS, load_extension, registered
from lightsim.errors import InputError
from lightsim.relighting.estimate import Estimate, Relight
from lightsim.store.weights import WEIGHTS_FOLDER, list_weights

LABORATORY_METHODS = ("colour-transfer", "self-osr", "epe", "nerf-osr")
"""Methods that the laboratory registers; named here for the error when it is not installed."""


@dataclass(frozen=True)
class Method:
    """A relighting method.

    Args:
        make: returns the method's function for a weights file; None selects the shipped weights.
            Called once per command; heavy packages are imported inside.
        weights_name: name of the shipped weights in the manifest of `weights_folder`; empty for a
            method without shipped weights.
        weights_folder: folder with manifest.json and the weights.
        weights_in_work: path of weights that are trained per log, relative to its work folder;
            empty for other methods.
        train_command: command that makes `weights_in_work`; the work folder follows it.
    """

    make: Callable[[Path | None], Relight]
    weights_name: str = ""
    weights_folder: Path = WEIGHTS_FOLDER
    weights_in_work: str = ""
    train_command: str = ""

    def shipped_file(self) -> Path | None:
        """Return the file of the shipped weights; None for a method without shipped weights."""
        if not self.weights_name:
            return None
        files = list_weights(self.weights_folder)[self.weights_name]
        return self.weights_folder / next(iter(files))

    @property
    def has_weights(self) -> bool:
        """True if the option --weights applies to the method."""
        return bool(self.weights_name or self.weights_in_work)


def _physical(weights: Path | None) -> Relight:
    from lightsim.relighting.physical.ratio import relight_physical

    return lambda inputs, config: Estimate(relight_physical(inputs, config))


def _network(weights: Path | None) -> Relight:
    from lightsim.networks.devices import choose_device
    from lightsim.relighting.network.model import RelitNet
    from lightsim.relighting.network.relight import relit_by_network
    from lightsim.relighting.network.stored import network_for

    return partial(relit_by_network, network_for(RelitNet, weights).to(choose_device("auto")))


def _paper(weights: Path | None) -> Relight:
    from lightsim.networks.devices import choose_device
    from lightsim.relighting.network.paper_model import PaperNet
    from lightsim.relighting.network.relight import relit_by_paper_network
    from lightsim.relighting.network.stored import network_for

    return partial(relit_by_paper_network, network_for(PaperNet, weights).to(choose_device("auto")))


OWN_METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "network": Method(_network, "relight-network"),
        "physical": Method(_physical),
        "paper": Method(_paper, "relight-paper"),
    }
)


def method_names() -> tuple[str, ...]:
    """Return the names that --method accepts; extensions are not imported."""
    return (*OWN_METHODS, *(name for name in registered(METHODS) if name not in OWN_METHODS))


def check_method(name: str) -> None:
    """Raise InputError unless a method of this name is installed."""
    if name in method_names():
        return
    is_of_laboratory = name in LABORATORY_METHODS
    raise InputError(
        f"the method '{name}' belongs to the laboratory, which is not installed"
        if is_of_laboratory
        else "the relighting method is unknown",
        where="--method",
        got=name,
        expected=f"one of {', '.join(method_names())}",
        remedy=f"pip install {LABORATORY}" if is_of_laboratory else None,
    )


def find_method(name: str) -> Method:
    """Return the method of a name.

    Raises:
        InputError: no such method is installed, or its package is broken.
    """
    check_method(name)
    return OWN_METHODS[name] if name in OWN_METHODS else load_extension(METHODS, name)


def module_of_method(name: str) -> str:
    """Return the dotted name of the module that defines a method; raises as `check_method`."""
    check_method(name)
    return __name__ if name in OWN_METHODS else registered(METHODS)[name].module


def relight_by(name: str, weights: Path | None = None) -> Relight:
    """Return the function of a method by name; networks run on CUDA where torch finds it.

    Args:
        name: name of the method.
        weights: weights file of its network; None selects the shipped weights.

    Raises:
        InputError, ArtefactError: no such method, or its weights are missing, damaged or those of
            another network.
    """
    return find_method(name).make(weights)
