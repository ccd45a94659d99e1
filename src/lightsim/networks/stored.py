"""Storage of networks as named tensors that include the network's kind and config."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor, nn

_CONFIG = "config_json"
"""Name of the tensor of UTF-8 bytes; half precision represents integers up to 2048 exactly."""


def stored_tensors(network: nn.Module, config: Any, kind: str) -> dict[str, Tensor]:
    """Return all weights, and kind and config (a dataclass of numbers and tuples) as bytes."""
    text = json.dumps({"kind": kind, **asdict(config)}).encode()
    return {**network.state_dict(), _CONFIG: torch.tensor(list(text), dtype=torch.float32)}


def stored_config(tensors: Mapping[str, Tensor]) -> tuple[str, dict[str, Any]]:
    """Return the kind and the config from the result of `stored_tensors`."""
    values = json.loads(bytes(int(code) for code in tensors[_CONFIG].tolist()))
    kind = values.pop("kind")
    return kind, _with_tuples(values)


def _with_tuples(value: Any) -> Any:
    """Replace JSON's lists by tuples, at every depth."""
    if isinstance(value, dict):
        return {name: _with_tuples(one) for name, one in value.items()}
    return tuple(map(_with_tuples, value)) if isinstance(value, list) else value


def is_stored(tensors: Mapping[str, Tensor]) -> bool:
    """Return True if the tensors are a result of `stored_tensors`."""
    return _CONFIG in tensors


def load_stored(network: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    """Load weights of any precision into a network of their config, in evaluation mode."""
    weights = {k: v.to(torch.float32) for k, v in tensors.items() if k != _CONFIG}
    network.load_state_dict(weights)
    network.eval()
