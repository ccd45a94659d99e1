"""Sky branch of NLFE, re-implemented: an encoder of one sky vector and a decoder to an HDR dome.

Wang et al. 2022, Neural Light Field Estimation for Street Scenes with Differentiable Virtual Object
Insertion, Sec. 3.1, doi:10.1007/978-3-031-20086-1_22, without local lighting and object insertion.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lightsim.lighting.sky.panorama_layers import Pyramid, UNet, direction_map
from lightsim.lighting.sky.sky_terms import (
    LATENT,
    Draw,
    SkyEncoding,
    SkyTensors,
    angles,
    log_sky_error,
    radiance_of_log,
    sun_maps,
)

# Fraction of training samples whose dome is decoded from the true sun instead of the estimated one.
# Chosen as an even mixture; sensitivity not measured.
_TEACHER_FORCING = 0.5
# Rows and columns to which encoder features are pooled before the dense head. The panorama is four
# times as wide as high. Sensitivity not measured.
POOLED_SIZE = (2, 8)


@dataclass(frozen=True)
class NlfeConfig:
    """Architecture of the network."""

    from_panorama: bool = False
    """Variant NLFE*: the input is the upper half of the panorama, not the front picture."""
    widths: tuple[int, ...] = (16, 32, 64, 96)
    """Channels of the encoder at strides 2, 4, 8, 16."""
    decoder_widths: tuple[int, ...] = (8, 16, 32, 64)
    """Channels of the decoder at strides 1, 2, 4, 8."""


class Nlfe(nn.Module):
    """Estimator of peak direction, peak intensity and latent, and their decoder to an HDR dome."""

    composes_sun = False

    def __init__(self, config: NlfeConfig, seed: int = 0) -> None:
        super().__init__()
        self.config = config
        inputs = 6 if config.from_panorama else 3
        # Initial weights depend on the seed alone, and the global generator is not changed.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.encoder = Pyramid(inputs, config.widths, wraps=config.from_panorama)
            flat = config.widths[-1] * POOLED_SIZE[0] * POOLED_SIZE[1]
            self.head = nn.Sequential(nn.Linear(flat, 256), nn.SiLU(), nn.Linear(256, 4 + LATENT))
            self.decoder = UNet(7, 3, config.decoder_widths, LATENT)

    def encode(self, batch: SkyTensors) -> SkyEncoding:
        """Estimate peak direction, log peak and latent; the other terms of the encoding are None.

        The input is the front picture, or with `from_panorama` the panorama's upper half.
        """
        image = batch.front * 2 - 1
        if self.config.from_panorama:
            sky = batch.ldr_sky * 2 - 1
            position = direction_map(2 * sky.shape[2], sky.shape[2], sky.device)
            image = torch.cat([sky, position.expand(len(sky), -1, -1, -1)], dim=1)
        features = functional.adaptive_avg_pool2d(self.encoder(image)[-1], POOLED_SIZE)
        value = self.head(features.flatten(1))
        direction = functional.normalize(value[:, :3], dim=1)
        # The affine map gives the initial network plausible sun peaks: e^4 times white.
        return SkyEncoding(direction, None, 4.0 + 2.0 * value[:, 3], None, None, value[:, 4:])

    def dome(
        self, batch: SkyTensors, encoding: SkyEncoding, direction: Tensor, log_peak: Tensor
    ) -> Float[Tensor, "n 3 r w"]:
        """Decode the upper half of the dome, with the sun at the given direction and intensity."""
        rows = batch.ldr_sky.shape[2]
        position = direction_map(2 * rows, rows, direction.device).expand(
            len(direction), -1, -1, -1
        )
        maps = torch.cat([position, sun_maps(direction, log_peak, rows)], dim=1)
        # The offset starts training at a dim sky.
        return radiance_of_log(self.decoder(maps, encoding.latent)[0] - 1.0)


def nlfe_loss(
    network: Nlfe, draw: Draw, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the sum of the angular, log peak and log HDR errors, and these terms.

    Domes are decoded with random teacher forcing.
    """
    batch = draw(False)
    found = network.encode(batch)
    forced = torch.rand(len(found.log_peak), generator=generator).to(found.log_peak)
    forced = forced < _TEACHER_FORCING
    direction = torch.where(forced[:, None], batch.sun_direction, found.direction)
    log_peak = torch.where(forced, batch.log_peak, found.log_peak)
    terms = {
        "angle": angles(found.direction, batch.sun_direction).mean(),
        "peak": (found.log_peak - batch.log_peak).abs().mean(),
        "hdr": log_sky_error(network.dome(batch, found, direction, log_peak), batch.sky),
    }
    return torch.stack(list(terms.values())).sum(), terms
