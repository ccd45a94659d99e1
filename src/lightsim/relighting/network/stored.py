"""Relighting networks by the kind that their weights carry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from lightsim.errors import InputError
from lightsim.networks.stored import load_stored, stored_config, stored_tensors
from lightsim.relighting.baselines.epe import EpeConfig, EpeNet
from lightsim.relighting.baselines.self_osr import SelfOsrConfig, SelfOsrNet
from lightsim.relighting.network.channels import LIGHT, OF_SKIES, SCENE, TARGET
from lightsim.relighting.network.model import RelitNet, RelitNetConfig
from lightsim.relighting.network.paper_model import PaperNet, PaperNetConfig
from lightsim.relighting.options import SHIPPED, Method
from lightsim.store.weights import load_weights, read_weights

Network = RelitNet | PaperNet | SelfOsrNet | EpeNet
NetworkConfig = RelitNetConfig | PaperNetConfig | SelfOsrConfig | EpeConfig
AnyNetwork = TypeVar("AnyNetwork", RelitNet, PaperNet, SelfOsrNet, EpeNet)
_OF_METHOD: Mapping[Method, tuple[type[Any], type[Any]]] = {
    "network": (RelitNet, RelitNetConfig),
    "paper": (PaperNet, PaperNetConfig),
    "self-osr": (SelfOsrNet, SelfOsrConfig),
    "epe": (EpeNet, EpeConfig),
}
_KIND = "relight {}"
"""What a file says, by method."""


def make_network(config: NetworkConfig) -> Network:
    """With first weights."""
    return next(net(config) for net, of in _OF_METHOD.values() if isinstance(config, of))


def tensors_of_network(network: Network) -> dict[str, Tensor]:
    """What a weights file of a network holds."""
    return stored_tensors(network, network.config, _KIND.format(_method_of(type(network))))


def network_of(tensors: Mapping[str, Tensor]) -> Network:
    """The network of stored tensors, ready to be used.

    Raises:
        InputError: they are those of another network.
    """
    kind, values = stored_config(tensors)
    configs = {_KIND.format(method): config for method, (_, config) in _OF_METHOD.items()}
    if kind not in configs:
        raise InputError(
            "these are weights of another network", got=kind, expected=", ".join(configs)
        )
    partners = tuple(RelitNetConfig(**one) for one in values.pop("partners", ()))
    config = configs[kind](**values)
    network = make_network(replace(config, partners=partners) if partners else config)
    load_stored(network, tensors)
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def probe(network: RelitNet) -> float:
    """Mean of what a network makes of planes of noise, which is the same for every network.

    Weights carry it in their record: code that shows or uses planes in another way than they were
    trained with makes another one.
    """
    noise = torch.Generator().manual_seed(0)
    channels = dict(SCENE) | {f"target_{name}": count for name, count in TARGET.items()}
    for which in ("source", "target"):
        channels |= {f"{which}_{name}": count for name, count in LIGHT.items()}
    batch = {name: torch.rand((1, n, 16, 16), generator=noise) for name, n in channels.items()}
    batch |= {f"{which}{OF_SKIES}": torch.ones(1, 3, 2, 4) for which in ("source", "target")}
    was_training = network.training
    network.eval()
    with torch.inference_mode():
        made = network(batch).picture.mean()
    network.train(was_training)
    return float(made)


def network_for(kind: type[AnyNetwork], weights: Path | None) -> AnyNetwork:
    """A network of a file, or the package's.

    Raises:
        InputError, ArtefactError: the weights are missing or damaged, or another network's.
    """
    method = _method_of(kind)
    network = network_of(
        load_weights(SHIPPED[method]) if weights is None else read_weights(weights)
    )
    if isinstance(network, kind):
        return network
    raise InputError(
        "these are the weights of another network",
        where=weights,
        expected=f"those of lightsim train relight --network {method}",
    )


def _method_of(kind: type[Network]) -> Method:
    return next(method for method, (net, _) in _OF_METHOD.items() if net is kind)
