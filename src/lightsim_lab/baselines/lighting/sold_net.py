"""Global lighting of SOLD-Net, re-implemented: a latent sky code and a classified sun direction.

Tang et al. 2022, Estimating Spatially-Varying Lighting in Urban Scenes with Disentangled
Representation, ECCV, without local lighting. Its two stages (sky autoencoder, then the encoder of
pictures) are trained simultaneously here; no gradient flows from the second stage into the code.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lightsim.lighting.sky.panorama_layers import Pyramid, UNet, direction_map, pooled
from lightsim.lighting.sky.sky_terms import (
    Draw,
    SkyEncoding,
    SkyTensors,
    compose_sun,
    log_radiance,
    log_sky_error,
    radiance_of_log,
    sunny_loss,
)
from lightsim_lab.baselines.lighting.nlfe import POOLED_SIZE

# Rows of the grid of sun positions over the upper hemisphere; 8 x 32 cells as in the paper.
_ROWS = 8
# Columns of the same grid: cells are square in an equirectangular map.
_COLUMNS = 4 * _ROWS
# Upper limit of radiance that removes the sun from a sky, in scene units. Sensitivity not measured.
_SUNLESS = 4.0


@dataclass(frozen=True)
class SoldNetConfig:
    """Architecture of the network."""

    widths: tuple[int, ...] = (16, 32, 64, 96)
    """Channels of the encoders at strides 2, 4, 8, 16."""
    decoder_widths: tuple[int, ...] = (8, 16, 32, 64)
    """Channels of the sky decoder at strides 1, 2, 4, 8."""
    code: int = 16
    """Length of a sky code."""


class SoldNet(nn.Module):
    """Estimator of sky code, sun cell (one of 256), sun visibility and intensity."""

    composes_sun = True

    def __init__(self, config: SoldNetConfig, seed: int = 0) -> None:
        super().__init__()
        self.config = config
        top = config.widths[-1]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.sky_encoder = Pyramid(6, config.widths)
            self.sky_code = nn.Linear(2 * top, config.code)
            self.sky_decoder = UNet(3, 3, config.decoder_widths, config.code)
            self.encoder = Pyramid(3, config.widths, wraps=False)
            self.head = nn.Sequential(
                nn.Linear(top * POOLED_SIZE[0] * POOLED_SIZE[1], 256),
                nn.SiLU(),
                nn.Linear(256, _ROWS * _COLUMNS + config.code + 2),
            )

    def read(self, front: Float[Tensor, "n 3 a b"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return logits of the sun cell, sky code, log peak, and the logit of a visible sun."""
        features = functional.adaptive_avg_pool2d(self.encoder(front * 2 - 1)[-1], POOLED_SIZE)
        value = self.head(features.flatten(1))
        cells, code, rest = value.split([_ROWS * _COLUMNS, self.config.code, 2], dim=1)
        return cells, code, 4.0 + 2.0 * rest[:, 0], rest[:, 1]

    def encode(self, batch: SkyTensors) -> SkyEncoding:
        """Estimate sun, log peak and sky code; the sun is the centre of its most probable cell."""
        cells, code, log_peak, sunny = self.read(batch.front)
        centres = direction_map(2 * _ROWS, _ROWS, cells.device)[0].flatten(1).T
        return SkyEncoding(centres[cells.argmax(dim=1)], None, log_peak, None, sunny, code)

    def sky_of(self, code: Float[Tensor, "n v"], rows: int) -> Float[Tensor, "n 3 r w"]:
        """Decode the upper half of a sky without its sun."""
        position = direction_map(2 * rows, rows, code.device).expand(len(code), -1, -1, -1)
        return radiance_of_log(self.sky_decoder(position, code)[0] - 1.0)

    def code_of(self, sky: Float[Tensor, "n 3 r w"]) -> Float[Tensor, "n v"]:
        """Encode the upper half of a true sky without its sun."""
        position = direction_map(2 * sky.shape[2], sky.shape[2], sky.device)
        image = torch.cat([log_radiance(sky), position.expand(len(sky), -1, -1, -1)], dim=1)
        return self.sky_code(pooled(self.sky_encoder(image)[-1]))

    def dome(
        self, batch: SkyTensors, encoding: SkyEncoding, direction: Tensor, log_peak: Tensor
    ) -> Float[Tensor, "n 3 r w"]:
        """Return the decoded sky with a white sun."""
        sky = self.sky_of(encoding.latent, batch.ldr_sky.shape[2])
        return compose_sun(sky, torch.ones_like(direction), direction, log_peak)


def sold_net_loss(
    network: SoldNet, draw: Draw, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the sum of the loss terms, and the terms by name."""
    batch = draw(False)
    sunless = batch.sky.clamp_max(_SUNLESS)
    code = network.code_of(sunless)
    cells, found, log_peak, sunny = network.read(batch.front)
    terms = {
        "sky": log_sky_error(network.sky_of(code, sunless.shape[2]), sunless),
        # Detached: the picture encoder imitates the code and must not simplify it.
        "code": functional.mse_loss(found, code.detach()),
        # A weak prior on the size of the code fixes its arbitrary scale factor.
        "small": 1e-3 * (code**2).mean(),
        "cell": functional.cross_entropy(cells, cell_of(batch.sun_direction)),
        "peak": (log_peak - batch.log_peak).abs().mean(),
        "sunny": sunny_loss(sunny, batch.is_sunny),
    }
    return torch.stack(list(terms.values())).sum(), terms


def cell_of(direction: Float[Tensor, "n 3"]) -> Tensor:
    """Return the index of the cell of the upper half, 8 rows of 32, that contains a direction."""
    # Equirectangular convention of CONVENTIONS.md: the centre column is world +x.
    u = (0.5 - torch.atan2(direction[:, 1], direction[:, 0]) / (2 * torch.pi)) % 1.0
    v = torch.acos(direction[:, 2].clamp(0.0, 1.0)) / torch.pi
    row = (v * 2 * _ROWS).long().clamp_max(_ROWS - 1)
    column = (u * _COLUMNS).long().clamp_max(_COLUMNS - 1)
    return row * _COLUMNS + column
