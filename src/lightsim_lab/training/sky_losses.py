"""Losses of the sky dome estimators (paper Sec. 3.3 "Training sky dome estimator")."""

from __future__ import annotations

import torch
from torch import Tensor

from lightsim.lighting.sky.network import SkyNetwork, random_ldr_sky_weight
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

# Fraction of the samples whose decoder gets the true sun instead of the predicted one. The paper
# does not publish it. Sensitivity not measured.
TEACHER_FORCING = 0.5


def sky_loss(
    network: SkyNetwork, draw: Draw, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the estimator's loss: angle and peak (L1), log HDR (L2), and likelihoods.

    Intensity, latent and decoder train on all skies, the direction on clear suns alone.

    Args:
        network: network in training mode.
        draw: function that returns the step's batch, of all skies (False) or clear suns (True).
        generator: random generator of teacher forcing and of the decoder's visible pixels.
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
    # Detached: the error of the dome must not change the encoders' estimate of the sun.
    used_direction = torch.where(forced[:, None], batch.sun_direction, direction)
    used_peak = torch.where(forced, batch.log_peak, log_peak.detach())
    kept = random_ldr_sky_weight(batch.sun_direction, batch.sky.shape[2], generator)
    latent = network.latent(image)
    dome = network.decode(shown, used_direction, used_peak, latent, kept)
    terms["hdr"] = log_sky_error(dome, batch.sky)
    # Weak regularisation, which keeps the latent code near the origin.
    terms["latent"] = 1e-3 * (latent**2).mean()
    loss = torch.stack(list(terms.values())).sum()
    terms["peak_l1"] = (log_peak - batch.log_peak).abs().mean()
    return loss, terms


def direction_loss(
    network: SkyNetwork, draw: Draw, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the part of `sky_loss` of the direction encoder, which has no weights in common."""
    sunny = draw(True)
    image = network.encoder_input(network.shown(sunny))
    log_density, direction, log_kappa = network.direct(image, sunny.sky.shape[2])
    # Detached: this likelihood trains the concentration alone; the direction has its own losses.
    likelihood = fisher_loss(direction.detach(), log_kappa, sunny.sun_direction)
    terms = {
        "angle": angles(direction, sunny.sun_direction).mean(),
        "fisher": 0.2 * likelihood.mean(),
        "heat": heat_loss(log_density, sunny.sun_direction).mean(),
    }
    return torch.stack(list(terms.values())).sum(), terms


def paper_sky_loss(
    network: PaperSkyNetwork, draw: Draw, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the paper's loss: angle (L1), peak intensity (L1), log HDR (L2), with teacher forcing.

    The direction encoder trains on clear suns, the two other encoders on all skies (appendix,
    "Training details").

    Args:
        network: network in training mode.
        draw: function that returns the step's batch, of all skies (False) or clear suns (True).
        generator: random generator of teacher forcing.
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
