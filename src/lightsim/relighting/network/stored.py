"""Relighting networks by the kind that their weights carry."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from lightsim.errors import InputError
from lightsim.networks.stored import load_stored, stored_config, stored_tensors
from lightsim.relighting.baselines.epe import EpeConfig, EpeNet
from lightsim.relighting.baselines.self_osr import SelfOsrConfig, SelfOsrNet
from lightsim.relighting.network.model import RelitNet, RelitNetConfig
from lightsim.relighting.network.paper_model import PaperNet, PaperNetConfig

Network = RelitNet | PaperNet | SelfOsrNet | EpeNet
NetworkConfig = RelitNetConfig | PaperNetConfig | SelfOsrConfig | EpeConfig
_KIND = {
    RelitNetConfig: "relight network",
    PaperNetConfig: "relight paper",
    SelfOsrConfig: "relight self-osr",
    EpeConfig: "relight epe",
}


def make_network(config: NetworkConfig) -> Network:
    """With first weights."""
    match config:
        case RelitNetConfig():
            return RelitNet(config)
        case PaperNetConfig():
            return PaperNet(config)
        case SelfOsrConfig():
            return SelfOsrNet(config)
        case EpeConfig():
            return EpeNet(config)


def tensors_of_network(network: Network) -> dict[str, Tensor]:
    """What a weights file of a network holds."""
    return stored_tensors(network, network.config, _KIND[type(network.config)])


def network_of(tensors: Mapping[str, Tensor]) -> Network:
    """The network of stored tensors, ready to be used.

    Raises:
        InputError: they are those of another network.
    """
    kind, values = stored_config(tensors)
    by_kind = {name: config for config, name in _KIND.items()}
    if kind not in by_kind:
        raise InputError(
            "these are weights of another network", got=kind, expected=", ".join(by_kind)
        )
    network = make_network(by_kind[kind](**values))
    load_stored(network, tensors)
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
