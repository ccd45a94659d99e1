"""The sky dome estimator as published: three encoders, five maps and a U-Net that decodes the dome.

Paper Sec. 3.2 "Generating HDR sky domes", Sec. 3.3 and appendix "Sky dome estimator architecture".
Choices that the paper leaves open are marked "open" below.
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
    SkyEncoding,
    SkyTensors,
    cosine_map,
    radiance_of_log,
)

PAPER_KIND = "lightsim_paper"
"""Kind that weights of this network store."""
# Rows and columns to which the encoder's features are averaged before its fully connected layers
# (open).
_POOLED_SIZE = (2, 8)
# Channels of `sun_encoding`, the paper's "five intermediate representations" of sun and intensity.
MAPS = 5


@dataclass(frozen=True)
class PaperSkyConfig:
    """Widths of the networks and size of the panoramas (open)."""

    widths: tuple[int, ...] = (16, 32, 64, 96)
    """Channels of the encoders at strides 2, 4, 8, 16."""
    decoder_widths: tuple[int, ...] = (8, 16, 32, 64)
    """Channels of the decoder at strides 1, 2, 4, 8."""
    height_px: int = 64
    """Rows of the panoramas."""

    @classmethod
    def full(cls) -> PaperSkyConfig:
        """About three times the channels, for panoramas twice as high."""
        return cls((48, 96, 192, 256), (24, 48, 96, 192), 128)


class SkyEncoder(nn.Module):
    """Encoder from the upper half of the LDR panorama and the directions of its pixels to `outputs`
    numbers.

    Open: the layers; here a convolutional pyramid and two fully connected layers.
    """

    def __init__(self, widths: tuple[int, ...], outputs: int) -> None:
        super().__init__()
        self.pyramid = Pyramid(6, widths)
        flat = widths[-1] * _POOLED_SIZE[0] * _POOLED_SIZE[1]
        self.head = nn.Sequential(nn.Linear(flat, 128), nn.SiLU(), nn.Linear(128, outputs))

    def forward(self, image: Float[Tensor, "n 6 r w"]) -> Float[Tensor, "n v"]:
        """Return one vector for each image."""
        features = functional.adaptive_avg_pool2d(self.pyramid(image)[-1], _POOLED_SIZE)
        return self.head(features.flatten(1))


class PaperSkyNetwork(nn.Module):
    """Completed LDR panorama -> z_sky, f_int, f_dir -> HDR sky dome.

    The decoder does not receive the panorama; z_sky, f_int and f_dir determine the dome.
    """

    composes_sun = False

    def __init__(self, config: PaperSkyConfig, seed: int = 0) -> None:
        super().__init__()
        self.config = config
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.direction_encoder = SkyEncoder(config.widths, 3)
            self.intensity_encoder = SkyEncoder(config.widths, 1)
            self.latent_encoder = SkyEncoder(config.widths, LATENT)
            self.decoder = UNet(MAPS, 3, config.decoder_widths, LATENT)

    def encode(self, batch: SkyTensors) -> SkyEncoding:
        """Predict f_dir, f_int (a logarithm) and z_sky; without uncertainties and without a
        clear-sun probability."""
        image = encoder_input(batch)
        return SkyEncoding(
            self.direct(image), None, self.measure(image), None, None, self.latent_encoder(image)
        )

    def direct(self, image: Float[Tensor, "n 6 r w"]) -> Float[Tensor, "n 3"]:
        """Return f_dir, unit vectors, from an `encoder_input`."""
        return functional.normalize(self.direction_encoder(image), dim=1)

    def measure(self, image: Float[Tensor, "n 6 r w"]) -> Float[Tensor, " n"]:
        """Predict f_int, the log luminance of the brightest pixel, from an `encoder_input`."""
        return 4.0 + 2.0 * self.intensity_encoder(image)[:, 0]

    def decode(
        self,
        direction: Float[Tensor, "n 3"],
        log_peak: Float[Tensor, " n"],
        latent: Float[Tensor, "n v"],
        rows: int,
    ) -> Float[Tensor, "n 3 r w"]:
        """Return the HDR radiance of the upper half from f_dir, f_int and z_sky (paper, Eq. 2)."""
        return radiance_of_log(self.decoder(sun_encoding(direction, log_peak, rows), latent)[0])

    def dome(
        self, batch: SkyTensors, encoding: SkyEncoding, direction: Tensor, log_peak: Tensor
    ) -> Float[Tensor, "n 3 r w"]:
        """Return the upper half at the panorama's size under any sun."""
        return self.decode(direction, log_peak, encoding.latent, batch.ldr_sky.shape[2])


def encoder_input(batch: SkyTensors) -> Float[Tensor, "n 6 r w"]:
    """Concatenate the upper half of the panorama and the unit vector of each pixel, as channels."""
    sky = batch.ldr_sky * 2 - 1
    position = direction_map(2 * sky.shape[2], sky.shape[2], sky.device)
    return torch.cat([sky, position.expand(len(sky), -1, -1, -1)], dim=1)


def sun_encoding(
    direction: Float[Tensor, "n 3"], log_peak: Float[Tensor, " n"], rows: int
) -> Float[Tensor, "n 5 r w"]:
    """Encode f_dir and f_int as five maps of the LDR sky's size.

    Open: the choice of the five. They are those of NLFE, which the paper follows (Wang et al. 2022,
    doi:10.1007/978-3-031-20086-1_22, Sec. 3.1), with one channel of intensity: the unit vector of
    each pixel (3), a spherical Gaussian lobe exp(100 (cos - 1)) around the sun (1), and the
    intensity where that lobe exceeds 0.9 of its largest value (1).
    """
    position = direction_map(2 * rows, rows, direction.device).expand(len(direction), -1, -1, -1)
    lobe = torch.exp(100.0 * (cosine_map(direction, rows) - 1.0))
    intensity = (
        (lobe > 0.9 * lobe.amax(dim=(2, 3), keepdim=True)) * log_peak[:, None, None, None] / 4.0
    )
    return torch.cat([position, lobe, intensity], dim=1)
