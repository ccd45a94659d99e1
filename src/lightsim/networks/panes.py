"""Classifier of glass in facade cells: dilated convolutions without down-sampling, with a receptive
field of 4 m of wall around each cell (Yu and Koltun 2016, arXiv:1511.07122)."""

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
    """Size of the network."""

    planes: int = 8
    """Features of each cell (`geometry.completion.facade_cells.FEATURES`)."""
    channels: int = 16
    """Channels of each hidden layer."""
    dilations: tuple[int, ...] = (1, 2, 4, 8, 1)
    """Dilation of each 3 x 3 convolution, in cells."""


class PaneNetwork(nn.Module):
    """Network from the features of facade cells to log-odds of glass."""

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
        """Return the log-odds of glass of each cell."""
        return self.layers(planes)[:, 0]

    @classmethod
    def stored(cls, tensors: Mapping[str, Tensor]) -> PaneNetwork:
        """Return the network stored by `networks.stored.stored_tensors`."""
        kind, values = stored_config(tensors)
        assert kind == KIND
        network = cls(PaneNetworkConfig(**values))
        load_stored(network, tensors)
        return network

    @torch.no_grad()
    def log_odds(self, planes: Float32[np.ndarray, "p s z"]) -> Float32[np.ndarray, "s z"]:
        """Return the log-odds of glass of the cells of one wall, on the CPU."""
        return self(torch.from_numpy(planes)[None])[0].numpy()
