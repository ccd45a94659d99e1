"""Common parts of all sky networks: batches as tensors, predictions, sun lobes and loss terms."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from lightsim.core.colour import LUMINANCE_WEIGHTS
from lightsim.lighting.sky.panorama_layers import direction_map

# Length of the sky latent (paper: z_sky).
LATENT = 64
# Radiance added before logarithms, as a fraction of the clipping value: darker differences are
# invisible. Sensitivity not measured.
_LOG_FLOOR = 0.02


@dataclass(frozen=True, eq=False)
class SkyTensors:
    """Lighting batch as tensors, channels first; see `lighting.sample.LightingBatch`.

    Args:
        panorama: sRGB in [0, 1]; where `seen` is 0, values of a completion.
        seen: 1 where the cameras observed the panorama.
        front: picture of one camera.
        sky: linear radiance of the upper half.
        sun_direction: unit vectors.
        log_peak: log of the luminance of the brightest pixel.
        is_sunny: 1 or 0.
    """

    panorama: Float[Tensor, "n 3 h w"]
    seen: Float[Tensor, "n 1 h w"]
    front: Float[Tensor, "n 3 a b"]
    sky: Float[Tensor, "n 3 h/2 w"]
    sun_direction: Float[Tensor, "n 3"]
    log_peak: Float[Tensor, " n"]
    is_sunny: Float[Tensor, " n"]

    @property
    def ldr_sky(self) -> Float[Tensor, "n 3 r w"]:
        """The upper half of the panorama."""
        return self.panorama[:, :, : self.panorama.shape[2] // 2]

    def shown(self, panorama: Tensor, seen: Tensor) -> SkyTensors:
        """Return the batch with another panorama and mask."""
        return replace(self, panorama=panorama, seen=seen)


Draw = Callable[[bool], SkyTensors]
"""Function that returns the batch of a training step: from all skies (False) or from skies with a
clear sun only (True)."""


@dataclass(frozen=True, eq=False)
class SkyEncoding:
    """Output of an encoder for each panorama.

    Args:
        direction: unit vectors towards the sun.
        log_concentration: log of the concentration of the von Mises-Fisher density around them;
            None if the network does not predict it.
        log_peak: log of the luminance of the brightest pixel.
        log_peak_scale: log of the expected mean absolute error of log_peak; None if not predicted.
        sunny_logit: logit of the probability that the sun casts shadows; None if not predicted.
        latent: appearance of the sky.
    """

    direction: Float[Tensor, "n 3"]
    log_concentration: Float[Tensor, " n"] | None
    log_peak: Float[Tensor, " n"]
    log_peak_scale: Float[Tensor, " n"] | None
    sunny_logit: Float[Tensor, " n"] | None
    latent: Float[Tensor, "n v"]


def luminance_of(radiance: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 1 h w"]:
    """Relative luminance of linear sRGB (weights of ITU-R BT.709), with one channel."""
    weights = torch.tensor(LUMINANCE_WEIGHTS, device=radiance.device)[None, :, None, None]
    return (radiance * weights).sum(dim=1, keepdim=True)


def cosine_map(direction: Float[Tensor, "n 3"], rows: int) -> Float[Tensor, "n 1 r w"]:
    """Cosine between each pixel of the upper half and a direction."""
    directions = direction_map(2 * rows, rows, direction.device)[0]
    return torch.einsum("chw,nc->nhw", directions, direction)[:, None]


def sun_lobe(
    direction: Float[Tensor, "n 3"], rows: int, width_px: float = 0.35
) -> Float[Tensor, "n 1 r w"]:
    """Gaussian lobe around a direction, 1 at its brightest pixel; its centroid is the direction.

    `width_px` is its standard deviation. The squared angle is approximated by 2 (1 - cosine),
    accurate and smooth over a few pixels.
    """
    sigma = width_px * math.pi / (2 * rows)
    exponent = (cosine_map(direction, rows) - 1.0) / sigma**2
    return torch.exp(exponent - exponent.amax(dim=(2, 3), keepdim=True))


def sun_maps(
    direction: Float[Tensor, "n 3"], log_peak: Float[Tensor, " n"], rows: int
) -> Float[Tensor, "n 4 r w"]:
    """Encode direction and intensity of the sun as four maps: a spherical Gaussian lobe, the
    cosine, the sun's pixels, and the intensity in them (paper: explicitly encoded
    representations)."""
    cosine = cosine_map(direction, rows)
    lobe = torch.exp(100.0 * (cosine - 1.0))
    pixel = (sun_lobe(direction, rows) > 0.5).to(cosine)
    return torch.cat([lobe, cosine, pixel, pixel * log_peak[:, None, None, None] / 4.0], dim=1)


def row_weights(rows: int, device: torch.device) -> Float[Tensor, "1 1 r 1"]:
    """Solid angle of the pixels of the upper half, normalised to a mean of 1."""
    polar = (torch.arange(rows, device=device) + 0.5) * math.pi / (2 * rows)
    weight = torch.sin(polar)
    return (weight / weight.mean())[None, None, :, None]


def log_radiance(radiance: Tensor) -> Tensor:
    """Logarithm of radiance plus 2 % of the clipping value."""
    return torch.log(radiance.clamp_min(0.0) + _LOG_FLOOR)


def radiance_of_log(value: Tensor) -> Tensor:
    """Inverse of `log_radiance`; never negative, and bounded so that no exponential overflows."""
    return (torch.exp(value.clamp(-6.0, 14.0)) - _LOG_FLOOR).clamp_min(0.0)


def log_sky_error(
    predicted: Float[Tensor, "n 3 r w"], truth: Float[Tensor, "n 3 r w"]
) -> Float[Tensor, ""]:
    """Mean squared error of log radiance, weighted by solid angle."""
    square = (log_radiance(predicted) - log_radiance(truth)) ** 2
    return (square * row_weights(truth.shape[2], truth.device)).mean()


def angles(a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Angles in radians, with a finite gradient at angle 0."""
    cross = torch.linalg.cross(a, b)
    return torch.atan2(torch.sqrt((cross * cross).sum(dim=1) + 1e-12), (a * b).sum(dim=1))


def fisher_loss(
    direction: Float[Tensor, "n 3"],
    log_concentration: Float[Tensor, " n"],
    truth: Float[Tensor, "n 3"],
) -> Float[Tensor, " n"]:
    """Negative log-likelihood of the von Mises-Fisher density on the sphere.

    Fisher 1953 (doi:10.1098/rspa.1953.0064); directions are unit vectors, one loss per sample.
    """
    kappa = log_concentration.exp()
    cosine = (direction * truth).sum(dim=1)
    # log(kappa / (2 pi (1 - exp(-2 kappa)))) + kappa (cos - 1): stable for every kappa > 0.
    log_norm = log_concentration - math.log(2 * math.pi) - torch.log(-torch.expm1(-2 * kappa))
    return -(log_norm + kappa * (cosine - 1.0))


def heat_loss(
    log_density: Float[Tensor, "n r w"], truth: Float[Tensor, "n 3"]
) -> Float[Tensor, " n"]:
    """Cross-entropy between a density over the pixels and a one-pixel spot at the true
    direction."""
    rows = log_density.shape[1]
    target = sun_lobe(truth, rows, 1.0)[:, 0] * row_weights(rows, truth.device)[:, 0]
    target = target / target.sum(dim=(1, 2), keepdim=True)
    return -(target * log_density).sum(dim=(1, 2))


def laplace_loss(
    value: Float[Tensor, " n"], log_scale: Float[Tensor, " n"], truth: Float[Tensor, " n"]
) -> Float[Tensor, " n"]:
    """Negative log-likelihood of a Laplace density with predicted scale."""
    return (value - truth).abs() * torch.exp(-log_scale) + log_scale + math.log(2.0)


def sunny_loss(logit: Float[Tensor, " n"], truth: Float[Tensor, " n"]) -> Float[Tensor, ""]:
    """Mean cross-entropy, in nats, of the prediction that the sun casts shadows (`truth` 1 or
    0)."""
    return functional.binary_cross_entropy_with_logits(logit, truth)


def compose_sun(
    sky: Float[Tensor, "n 3 r w"],
    sun_colour: Float[Tensor, "n 3"],
    direction: Float[Tensor, "n 3"],
    log_peak: Float[Tensor, " n"],
) -> Float[Tensor, "n 3 r w"]:
    """Add a sun with the given peak luminance to the sky; no other pixel is brighter.

    `sun_colour` has luminance 1. Skies brighter than the peak are dimmed to it.
    """
    peak = torch.exp(log_peak)[:, None, None, None]
    # 2 % below the peak, so that the sun's pixel is the brightest.
    sky = sky * (0.98 * peak / luminance_of(sky).clamp_min(1e-6)).clamp_max(1.0)
    lobe = sun_lobe(direction, sky.shape[2])
    return sky * (1 - lobe) + lobe * peak * sun_colour[:, :, None, None]
