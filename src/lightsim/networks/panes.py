"""Tells glass in the cells of facades: a small network without down-sampling, whose dilated
convolutions see 4 m of wall around each cell (Yu and Koltun 2016, arXiv:1511.07122)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from lightsim.networks.stored import load_stored, stored_config

KIND = "panes"


@dataclass(frozen=True)
class PaneNetworkConfig:
    """The network's size."""

    planes: int = 8
    """Of each cell (`geometry.completion.facade_cells.PLANES`)."""
    channels: int = 16
    """Of each layer."""
    dilations: tuple[int, ...] = (1, 2, 4, 8, 1)
    """Of the 3 x 3 convolutions."""


class PaneNetwork(nn.Module):
    """Log-odds of glass."""

    def __init__(self, config: PaneNetworkConfig) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width = config.planes
        for dilation in config.dilations:
            layer = nn.Conv2d(width, config.channels, 3, padding=dilation, dilation=dilation)
            layers += [layer, nn.ReLU()]
            width = config.channels
        self.layers = nn.Sequential(*layers, nn.Conv2d(width, 1, 1))

    def forward(self, planes: Float[Tensor, "b p s z"]) -> Float[Tensor, "b s z"]:
        """Of each cell."""
        return self.layers(planes)[:, 0]

    @classmethod
    def stored(cls, tensors: Mapping[str, Tensor]) -> PaneNetwork:
        """The network of `networks.stored.stored_tensors`."""
        kind, values = stored_config(tensors)
        assert kind == KIND
        network = cls(PaneNetworkConfig(**values))
        load_stored(network, tensors)
        return network

    @torch.no_grad()
    def odds(self, planes: Float32[np.ndarray, "p s z"]) -> Float32[np.ndarray, "s z"]:
        """Log-odds of the cells of one wall, on the CPU."""
        return self(torch.from_numpy(planes)[None])[0].numpy()
