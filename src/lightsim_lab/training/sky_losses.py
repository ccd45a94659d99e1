"""The losses of the sky dome estimators (paper Sec. 3.3 "Training sky dome estimator")."""

from __future__ import annotations

import torch
from torch import Tensor

from lightsim.lighting.sky.network import SkyNetwork, random_kept
from lightsim.lighting.sky.paper_network import PaperSkyNetwork, encoder_input
from lightsim.lighting.sky.sky_terms import (
    Draw,
    angles,
    fisher_loss,
    heat_loss,
    laplace_loss,
    log_radiance,
    log_sky_error,
    sunny_loss,
)

TEACHER_FORCING = 0.5
"""Fraction of the samples whose decoder is given the true sun."""


def sky_loss(
    network: SkyNetwork, draw: Draw, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """L1 angular, L1 peak, L2 log HDR, and the likelihoods that make uncertainty honest.

    Intensity, latent and decoder learn from all skies, the direction from clear suns.

    Args:
        network: in training.
        draw: gives the step's batch, of all skies or of clear suns alone.
        generator: of teacher forcing and of what the decoder may see.
    """
    batch = draw(False)
    shown = network.shown(batch)
    image = network.encoder_input(shown)
    with torch.no_grad():
        direction = network.direct(image, batch.sky.shape[2])[1]
    _, terms = direction_loss(network, draw, generator)
    log_peak, log_scale, logit = network.measure(image)
    terms["peak"] = laplace_loss(log_peak, log_scale, batch.log_peak).mean()
    terms["sunny"] = sunny_loss(logit, batch.is_sunny)
    forced = torch.rand(len(image), generator=generator).to(image) < TEACHER_FORCING
    # Detached: the dome's error must not pull the sun away from where the encoders see it.
    used_direction = torch.where(forced[:, None], batch.sun_direction, direction)
    used_peak = torch.where(forced, batch.log_peak, log_peak.detach())
    kept = random_kept(batch.sun_direction, batch.sky.shape[2], generator)
    latent = network.latent(image)
    dome = network.decode(shown, used_direction, used_peak, latent, kept)
    terms["hdr"] = log_sky_error(dome, batch.sky)
    terms["latent"] = 1e-3 * (latent**2).mean()
    loss = torch.stack(list(terms.values())).sum()
    terms["peak_l1"] = (log_peak - batch.log_peak).abs().mean()
    return loss, terms


def direction_loss(
    network: SkyNetwork, draw: Draw, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """The part of `sky_loss` that moves the encoder of the direction; it shares no weight."""
    sunny = draw(True)
    image = network.encoder_input(network.shown(sunny))
    log_density, direction, log_kappa = network.direct(image, sunny.sky.shape[2])
    # The direction has its own losses: here it stands still, and only the spread learns.
    spread = fisher_loss(direction.detach(), log_kappa, sunny.sun_direction)
    terms = {
        "angle": angles(direction, sunny.sun_direction).mean(),
        "fisher": 0.2 * spread.mean(),
        "heat": heat_loss(log_density, sunny.sun_direction).mean(),
    }
    return torch.stack(list(terms.values())).sum(), terms


def paper_sky_loss(
    network: PaperSkyNetwork, draw: Draw, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """The published loss: L1 angular, L1 peak intensity, L2 HDR in the log space, teacher forcing.

    The direction's encoder is trained on clear suns, the two others on all skies (appendix,
    "Training details").

    Args:
        network: in training.
        draw: gives the step's batch, of all skies or of clear suns alone.
        generator: of teacher forcing.
    """
    batch, sunny = draw(False), draw(True)
    image = encoder_input(batch)
    with torch.no_grad():
        direction = network.direct(image)
    log_peak, latent = network.measure(image), network.latent_encoder(image)
    forced = torch.rand(len(image), generator=generator).to(image) < TEACHER_FORCING
    dome = network.decode(
        torch.where(forced[:, None], batch.sun_direction, direction),
        torch.where(forced, batch.log_peak, log_peak),
        latent,
        batch.sky.shape[2],
    )
    terms = {
        "angle": angles(network.direct(encoder_input(sunny)), sunny.sun_direction).mean(),
        "peak": (log_peak - batch.log_peak).abs().mean(),
        "hdr": (log_radiance(dome) - log_radiance(batch.sky)).square().mean(),
    }
    return torch.stack(list(terms.values())).sum(), terms
