"""The sky dome estimator as published: three encoders, five maps, a U-Net that draws the dome.

Paper Sec. 3.2 "Generating HDR sky domes", Sec. 3.3 and appendix "Sky dome estimator architecture".
What the paper leaves open is marked "open" below.
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

_FLAT = (2, 8)
MAPS = 5
"""The paper's "five intermediate representations" of sun and intensity; see `sun_encoding`."""


@dataclass(frozen=True)
class PaperSkyConfig:
    """How wide the networks are; open in the paper, as is the size of the panoramas."""

    widths: tuple[int, ...] = (16, 32, 64, 96)
    """Channels of the encoders at strides 2, 4, 8, 16."""
    decoder_widths: tuple[int, ...] = (8, 16, 32, 64)
    """Channels of the decoder at strides 1, 2, 4, 8."""
    height_px: int = 64
    """Of the panoramas."""

    @classmethod
    def full(cls) -> PaperSkyConfig:
        """About three times the channels, for panoramas twice as high."""
        return cls((48, 96, 192, 256), (24, 48, 96, 192), 128)


class SkyEncoder(nn.Module):
    """Upper half of the LDR panorama and directions of its pixels -> `outputs` numbers.

    Open: the layers; here a convolutional pyramid and two fully connected ones.
    """

    def __init__(self, widths: tuple[int, ...], outputs: int) -> None:
        super().__init__()
        self.pyramid = Pyramid(6, widths)
        flat = widths[-1] * _FLAT[0] * _FLAT[1]
        self.head = nn.Sequential(nn.Linear(flat, 128), nn.SiLU(), nn.Linear(128, outputs))

    def forward(self, image: Float[Tensor, "n 6 r w"]) -> Float[Tensor, "n v"]:
        """One vector for each image."""
        features = functional.adaptive_avg_pool2d(self.pyramid(image)[-1], _FLAT)
        return self.head(features.flatten(1))


class PaperSkyNetwork(nn.Module):
    """Completed LDR panorama -> z_sky, f_int, f_dir -> HDR sky dome.

    The decoder sees nothing of the panorama: the dome is drawn from the three alone.
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
        """f_dir, f_int (a logarithm) and z_sky; neither spread nor whether the sun is clear."""
        image = encoder_input(batch)
        return SkyEncoding(
            self.direct(image), None, self.measure(image), None, None, self.latent_encoder(image)
        )

    def direct(self, image: Float[Tensor, "n 6 r w"]) -> Float[Tensor, "n 3"]:
        """f_dir: unit vectors, from an `encoder_input`."""
        return functional.normalize(self.direction_encoder(image), dim=1)

    def measure(self, image: Float[Tensor, "n 6 r w"]) -> Float[Tensor, " n"]:
        """f_int: log of the luminance of the brightest pixel, from an `encoder_input`."""
        return 4.0 + 2.0 * self.intensity_encoder(image)[:, 0]

    def decode(
        self,
        direction: Float[Tensor, "n 3"],
        log_peak: Float[Tensor, " n"],
        latent: Float[Tensor, "n v"],
        rows: int,
    ) -> Float[Tensor, "n 3 r w"]:
        """HDR radiance of the upper half from f_dir, f_int and z_sky (paper, Eq. 2)."""
        return radiance_of_log(self.decoder(sun_encoding(direction, log_peak, rows), latent)[0])

    def dome(
        self, batch: SkyTensors, encoding: SkyEncoding, direction: Tensor, log_peak: Tensor
    ) -> Float[Tensor, "n 3 r w"]:
        """The upper half of a panorama's size under any sun."""
        return self.decode(direction, log_peak, encoding.latent, batch.ldr_sky.shape[2])


def encoder_input(batch: SkyTensors) -> Float[Tensor, "n 6 r w"]:
    """The upper half of the panorama and, channel by channel, the unit vector of each pixel."""
    sky = batch.ldr_sky * 2 - 1
    position = direction_map(2 * sky.shape[2], sky.shape[2], sky.device)
    return torch.cat([sky, position.expand(len(sky), -1, -1, -1)], dim=1)


def sun_encoding(
    direction: Float[Tensor, "n 3"], log_peak: Float[Tensor, " n"], rows: int
) -> Float[Tensor, "n 5 r w"]:
    """f_dir and f_int as five maps of the LDR sky's size.

    Open: which five. Taken as those of NLFE, which the paper follows (Wang et al. 2022,
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
