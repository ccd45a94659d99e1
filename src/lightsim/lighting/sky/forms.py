"""Sky networks by the kind that weights store: the form of this package, or the published one."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from torch import Tensor

from lightsim.errors import InputError
from lightsim.lighting.sky.network import KIND, SkyNetwork, SkyNetworkConfig
from lightsim.lighting.sky.paper_network import PAPER_KIND, PaperSkyConfig, PaperSkyNetwork
from lightsim.networks.stored import load_stored, stored_config

_FORMS: Mapping[str, tuple[type[Any], type[Any]]] = MappingProxyType(
    {KIND: (SkyNetworkConfig, SkyNetwork), PAPER_KIND: (PaperSkyConfig, PaperSkyNetwork)}
)
"""Class of the config and class of the network, by the kind that weights store."""


def load_sky_network(tensors: Mapping[str, Tensor]) -> SkyNetwork | PaperSkyNetwork:
    """Return the network of stored weights, of any precision, ready for use.

    Raises:
        InputError: the weights are of another network.
    """
    try:
        kind, values = stored_config(tensors)
        config, form = _FORMS[kind]
        network = form(config(**values))
        load_stored(network, tensors)
    # PyTorch reports tensors of other names or shapes as RuntimeError.
    except (KeyError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            "the weights are not those of a sky network",
            got=f"{type(error).__name__}: {error}"[:120],
            expected=f"the form {' or '.join(_FORMS)}",
            remedy="Give weights.safetensors of lightsim train sky.",
        ) from error
    return network
