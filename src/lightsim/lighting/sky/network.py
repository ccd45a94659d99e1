"""The sky dome estimator: three encoders, and a decoder with explicit inputs for sun and latent.

Paper Sec. 3.2 "Generating HDR sky domes" and appendix "Sky dome estimator architecture".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lightsim.lighting.sky.panorama_layers import (
    Merge,
    Pyramid,
    UNet,
    direction_map,
    filled,
    pooled,
    upsampled,
)
from lightsim.lighting.sky.sky_terms import (
    LATENT,
    SkyEncoding,
    SkyTensors,
    compose_sun,
    cosine_map,
    log_radiance,
    luminance_of,
    radiance_of_log,
    sun_maps,
)
from lightsim.networks.stored import stored_tensors

KIND = "lightsim"

# Channels of `_position`.
_POSITION = 2
# Angle around the old and the new position of a moved sun within which the decoder ignores the LDR
# sky, in degrees. Sensitivity not measured.
MOVED_SUN_DEG = 30.0
# A sun that moves by less, in degrees, leaves the observed sky unchanged. Sensitivity not measured.
UNMOVED_SUN_DEG = 6.0


@dataclass(frozen=True)
class SkyNetworkConfig:
    """Size of the network; the defaults are for the CPU, `full` for a GPU."""

    widths: tuple[int, ...] = (16, 32, 64, 96)
    """Channels of the encoders at strides 2, 4, 8, 16."""
    decoder_widths: tuple[int, ...] = (8, 16, 32, 64)
    """Channels of the decoder at strides 1, 2, 4, 8."""
    height_px: int = 64
    """Rows of the panoramas it is trained on; others are resized to it."""

    @classmethod
    def full(cls) -> SkyNetworkConfig:
        """About three times the channels, for panoramas twice as high."""
        return cls(widths=(48, 96, 192, 256), decoder_widths=(24, 48, 96, 192), height_px=128)


# Largest correction of the log concentration: densities over pixels have concentrations up to some
# thousands, errors on unseen skies correspond to ten.
_MAX_CORRECTION = 6.0


class HeatHead(nn.Module):
    """Density over the pixels of the upper half, with its mean direction and concentration."""

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.merge = Merge(widths)
        self.exit = nn.Conv2d(widths[0], 1, 1)
        self.spread = nn.Linear(2 * widths[-1] + 1, 1)

    def forward(self, features: list[Tensor], rows: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the log density over the pixels (sums to 1), the directions and their log
        concentration."""
        logits = upsampled(self.exit(functional.silu(self.merge(features))))[:, 0, :rows]
        polar = (torch.arange(rows, device=logits.device) + 0.5) * math.pi / (2 * rows)
        # Solid angle of each row: equal logits then mean a uniform density on the sphere, without
        # a maximum at the zenith.
        logits = logits + torch.log(torch.sin(polar))[None, :, None]
        log_density = torch.log_softmax(logits.flatten(1), dim=1).view_as(logits)
        directions = direction_map(2 * rows, rows, logits.device)[0]
        mean = torch.einsum("nhw,chw->nc", log_density.exp(), directions)
        length = mean.norm(dim=1).clamp(1e-4, 1 - 1e-5)
        # Banerjee et al. 2005, eq. 4.4: concentration of a sample whose mean has this length.
        log_kappa = torch.log(length * (3 - length**2) / (1 - length**2)).detach()
        context = torch.cat([log_kappa[:, None], pooled(features[-1]).detach()], dim=1)
        correction = self.bounded(self.spread(context)[:, 0])
        return log_density, functional.normalize(mean, dim=1), log_kappa + correction

    @staticmethod
    def bounded(correction: Tensor) -> Tensor:
        """Return a correction of the log concentration, smoothly limited to `_MAX_CORRECTION`."""
        return _MAX_CORRECTION * torch.tanh(correction / _MAX_CORRECTION)


class SkyNetwork(nn.Module):
    """LDR panorama -> (sun direction, peak intensity, latent) -> HDR sky dome."""

    composes_sun = True

    def __init__(self, config: SkyNetworkConfig, seed: int = 0) -> None:
        super().__init__()
        self.config = config
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.direction_encoder = Pyramid(4 + _POSITION, config.widths)
            self.intensity_encoder = Pyramid(4 + _POSITION, config.widths)
            self.latent_encoder = Pyramid(4 + _POSITION, config.widths)
            top = config.widths[-1]
            self.direction_head = HeatHead(config.widths)
            self.intensity_head = nn.Sequential(nn.Linear(2 * top, 64), nn.SiLU(), nn.Linear(64, 3))
            self.latent_head = nn.Linear(2 * top, LATENT)
            self.decoder = UNet(4 + _POSITION + 4, 3, config.decoder_widths, LATENT)
            self.colour_head = nn.Linear(config.decoder_widths[-1], 3)

    def shown(self, batch: SkyTensors) -> SkyTensors:
        """Return the batch with a smooth fill in unobserved pixels, the input of encoders and
        decoder.

        The content of an inpainting network is a function of the same observed pixels and adds no
        evidence, so it is not used.
        """
        return batch.shown(filled(batch.panorama, batch.seen), batch.seen)

    def encode(self, batch: SkyTensors) -> SkyEncoding:
        """Predict sun, peak and latent, each by its own encoder (paper, Sec. 3.2)."""
        image = self.encoder_input(self.shown(batch))
        _, direction, log_kappa = self.direct(image, batch.panorama.shape[2] // 2)
        peak, scale, sunny = self.measure(image)
        return SkyEncoding(direction, log_kappa, peak, scale, sunny, self.latent(image))

    def direct(self, image: Tensor, rows: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return log density over the pixels, direction and log concentration."""
        return self.direction_head(self.direction_encoder(image), rows)

    def measure(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log peak, log of its expected error, and the logit of a clear sun."""
        value = self.intensity_head(pooled(self.intensity_encoder(image)[-1]))
        # Offset and scale of the untrained output; sensitivity not measured.
        return 4.0 + 2.0 * value[:, 0], value[:, 1], value[:, 2]

    def latent(self, image: Tensor) -> Float[Tensor, "n v"]:
        """Appearance of the sky (paper: z_sky), from an `encoder_input`."""
        return self.latent_head(pooled(self.latent_encoder(image)[-1]))

    def encoder_input(self, batch: SkyTensors) -> Float[Tensor, "n c h w"]:
        """Input channels of the encoders, from a batch returned by `shown`."""
        image = torch.cat([batch.panorama * 2 - 1, batch.seen], dim=1)
        return torch.cat([image, _position(image, batch.panorama.shape[2])], dim=1)

    def decode(
        self,
        batch: SkyTensors,
        direction: Float[Tensor, "n 3"],
        log_peak: Float[Tensor, " n"],
        latent: Float[Tensor, "n v"],
        ldr_weight: Float[Tensor, "n 1 r w"] | None = None,
    ) -> Float[Tensor, "n 3 r w"]:
        """Return the HDR radiance of the upper half.

        Args:
            batch: contains the LDR sky that the dome follows; returned by `shown`.
            direction: unit vector towards the sun.
            log_peak: log of the luminance of the sun's pixel.
            latent: latent of the sky.
            ldr_weight: 1 where the dome must follow the LDR sky, 0 where the latent alone decides.
        """
        ldr = batch.ldr_sky
        ldr_weight = torch.ones_like(ldr[:, :1]) if ldr_weight is None else ldr_weight
        rows = ldr.shape[2]
        image = torch.cat(
            [
                (ldr * 2 - 1) * ldr_weight,
                ldr_weight,
                _position(ldr, 2 * rows),
                sun_maps(direction, log_peak, rows),
            ],
            dim=1,
        )
        value, mean = self.decoder(image, latent)
        # The exponent 2.2 approximates the sRGB curve. Without the LDR sky, the decoder starts
        # from a log radiance of -1.
        base = log_radiance(ldr**2.2) * ldr_weight + (1 - ldr_weight) * -1.0
        sky = radiance_of_log(base + value)
        colour = torch.exp(torch.tanh(self.colour_head(mean)))
        colour = colour / luminance_of(colour[:, :, None, None])[:, :, 0, 0]
        return compose_sun(sky, colour, direction, log_peak)

    def dome(
        self, batch: SkyTensors, encoding: SkyEncoding, direction: Tensor, log_peak: Tensor
    ) -> Float[Tensor, "n 3 r w"]:
        """Return the upper half under any sun; around the old and new position of a moved sun the
        LDR sky is ignored."""
        ldr_weight = ldr_sky_weight(encoding.direction, direction, batch.ldr_sky.shape[2])
        return self.decode(self.shown(batch), direction, log_peak, encoding.latent, ldr_weight)


def _position(image: Tensor, height: int) -> Float[Tensor, "n p r w"]:
    """Elevation of each pixel without its azimuth, so that the network is equivariant to
    rotations."""
    x, y, z = direction_map(height, image.shape[2], image.device).unbind(1)
    return torch.stack([z, torch.hypot(x, y)], dim=1).expand(len(image), -1, -1, -1)


def tensors_of(network: SkyNetwork) -> dict[str, Tensor]:
    """Return all weights and the config, the input of `forms.load_sky_network`."""
    return stored_tensors(network, network.config, KIND)


def ldr_sky_weight(
    old: Float[Tensor, "n 3"], new: Float[Tensor, "n 3"], rows: int
) -> Float[Tensor, "n 1 r w"]:
    """Weight of the LDR sky in a dome whose sun moved: 1 away from both suns, and everywhere if the
    sun hardly moved."""
    moved_deg = torch.rad2deg(torch.acos((old * new).sum(dim=1).clamp(-1, 1)))
    is_unmoved = (moved_deg <= UNMOVED_SUN_DEG)[:, None, None, None]
    return torch.maximum(_away(old, new, rows), is_unmoved.to(old))


def random_ldr_sky_weight(
    direction: Float[Tensor, "n 3"], rows: int, generator: torch.Generator
) -> Float[Tensor, "n 1 r w"]:
    """Random weight of the LDR sky in training: everywhere, nowhere, or outside discs around the
    sun and a random direction, as when a user moves the sun."""
    count = len(direction)
    draw = torch.rand(count, generator=generator).to(direction)[:, None, None, None]
    azimuth = torch.rand(count, generator=generator) * 2 * math.pi
    height = torch.rand(count, generator=generator)
    flat = torch.sqrt(1 - height**2)
    spot = torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), height], dim=1).to(direction)
    away = _away(direction, spot, rows)
    return torch.where(draw < 0.2, 0.0, torch.where(draw < 0.5, away, 1.0))


def _away(a: Tensor, b: Tensor, rows: int) -> Tensor:
    """Weight that is 1 far from both directions and 0 near one, with a smooth transition."""
    angle = torch.rad2deg(
        torch.acos(torch.maximum(cosine_map(a, rows), cosine_map(b, rows)).clamp(-1, 1))
    )
    fraction = ((angle / MOVED_SUN_DEG - 0.6) / 0.8).clamp(0.0, 1.0)
    return fraction * fraction * (3 - 2 * fraction)
