"""Relighting networks by the kind that their weights files store."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from lightsim.errors import InputError
from lightsim.networks.stored import load_stored, stored_config, stored_tensors
from lightsim.relighting.network.channels import LIGHT, OF_SKIES, SCENE, TARGET
from lightsim.relighting.network.model import RelitNet, RelitNetConfig
from lightsim.relighting.network.paper_model import PaperNet, PaperNetConfig
from lightsim.store.weights import WEIGHTS_FOLDER, load_weights, read_weights

Kinds = Mapping[str, tuple[type[Any], type[Any]]]
"""Class of the network and class of its config, by the name of the method."""
KINDS: Kinds = MappingProxyType(
    {"network": (RelitNet, RelitNetConfig), "paper": (PaperNet, PaperNetConfig)}
)
AnyNetwork = TypeVar("AnyNetwork", bound=nn.Module)
_KIND = "relight {}"
"""Kind that a weights file stores, by method."""


def make_network(config: Any, kinds: Kinds = KINDS) -> Any:
    """Return an untrained network of a config."""
    return next(net(config) for net, of in kinds.values() if isinstance(config, of))


def tensors_of_network(network: Any, kinds: Kinds = KINDS) -> dict[str, Tensor]:
    """Return the tensors that a weights file of the network holds."""
    method = _method_of(type(network), kinds)
    return stored_tensors(network, network.config, _KIND.format(method))


def network_of(tensors: Mapping[str, Tensor], kinds: Kinds = KINDS) -> Any:
    """Return the network of stored tensors, ready to be used.

    Raises:
        InputError: the tensors belong to a network of another kind.
    """
    kind, values = stored_config(tensors)
    configs = {_KIND.format(method): config for method, (_, config) in kinds.items()}
    if kind not in configs:
        raise InputError(
            "the weights belong to another network", got=kind, expected=", ".join(configs)
        )
    partners = tuple(RelitNetConfig(**one) for one in values.pop("partners", ()))
    config = configs[kind](**values)
    network = make_network(replace(config, partners=partners) if partners else config, kinds)
    load_stored(network, tensors)
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def probe(network: RelitNet) -> float:
    """Mean output of the network for fixed planes of noise, a check of the code that computes its
    inputs.

    Weights store it in their record. Code that computes or uses planes differently from training
    returns another value.
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


def network_for(
    kind: type[AnyNetwork],
    weights: Path | None,
    kinds: Kinds = KINDS,
    folder: Path = WEIGHTS_FOLDER,
) -> AnyNetwork:
    """Return a network of a weights file, or with the shipped weights.

    Args:
        kind: class of the network.
        weights: file; None selects the shipped weights of the method.
        folder: folder of the shipped weights.

    Raises:
        InputError, ArtefactError: the weights are missing, damaged or those of another network.
    """
    method = _method_of(kind, kinds)
    shipped = f"relight-{method}"
    tensors = load_weights(shipped, folder) if weights is None else read_weights(weights)
    network = network_of(tensors, kinds)
    if isinstance(network, kind):
        return network
    raise InputError(
        "the weights belong to another network",
        where=weights,
        got=f"a {type(network).__name__}",
        expected=f"weights from lightsim train relight --network {method}",
    )


def _method_of(kind: type[Any], kinds: Kinds) -> str:
    return next(method for method, (net, _) in kinds.items() if net is kind)
