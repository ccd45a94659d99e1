"""The loss of the sky dome estimator (paper Sec. 3.3 "Training sky dome estimator")."""

from __future__ import annotations

import torch
from torch import Tensor

from lightsim.lighting.sky.network import SkyNetwork, random_kept
from lightsim.networks.sky_terms import (
    Draw,
    SkyTensors,
    angles,
    fisher_loss,
    heat_loss,
    laplace_loss,
    log_sky_error,
    sunny_loss,
)

TEACHER_FORCING = 0.5
"""Fraction of the samples whose decoder is given the true sun."""


def sky_loss(
    network: SkyNetwork, draw: Draw, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """L1 angular, L1 peak, L2 log HDR, and the likelihoods that make uncertainty honest.

    Intensity, latent and decoder learn from all skies, the direction (with `config.dual`) from
    clear suns.

    Args:
        network: in training.
        draw: gives the step's batch, of all skies or of clear suns alone.
        generator: of teacher forcing and of what the decoder may see.
    """
    batch = draw(False)
    shown = network.shown(batch)
    image = network.encoder_input(shown)
    terms, direction = _direction_terms(network, batch, draw, image)
    log_peak, log_scale, logit = network.measure(image)
    terms["peak"] = laplace_loss(log_peak, log_scale, batch.log_peak).mean()
    terms["sunny"] = sunny_loss(logit, batch.is_sunny)
    forced = torch.rand(len(image), generator=generator).to(image) < TEACHER_FORCING
    # Detached: the dome's error must not pull the sun away from where the encoders see it.
    used_direction = torch.where(forced[:, None], batch.sun_direction, direction.detach())
    used_peak = torch.where(forced, batch.log_peak, log_peak.detach())
    kept = random_kept(batch.sun_direction, batch.sky.shape[2], generator)
    latent = network.latent(image)
    dome = network.decode(shown, used_direction, used_peak, latent, kept)
    terms["hdr"] = log_sky_error(dome, batch.sky)
    terms["latent"] = 1e-3 * (latent**2).mean()
    loss = torch.stack(list(terms.values())).sum()
    terms["peak_l1"] = (log_peak - batch.log_peak).abs().mean()
    return loss, terms


def _direction_terms(
    network: SkyNetwork, batch: SkyTensors, draw: Draw, image: Tensor
) -> tuple[dict[str, Tensor], Tensor]:
    """Terms of the direction, and the directions of `batch`."""
    rows = batch.sky.shape[2]
    if not network.config.dual:
        predicted = network.direct(image, rows)
        return _terms_of(predicted, batch.sun_direction), predicted[1]
    with torch.no_grad():
        direction = network.direct(image, rows)[1]
    sunny = draw(True)
    predicted = network.direct(network.encoder_input(network.shown(sunny)), rows)
    return _terms_of(predicted, sunny.sun_direction), direction


def _terms_of(predicted: tuple[Tensor | None, Tensor, Tensor], truth: Tensor) -> dict[str, Tensor]:
    """Terms of one batch's density (or None), directions and log concentrations."""
    log_density, direction, log_kappa = predicted
    # The direction has its own losses: here it stands still, and only the spread learns.
    spread = fisher_loss(direction.detach(), log_kappa, truth)
    terms = {"angle": angles(direction, truth).mean(), "fisher": 0.2 * spread.mean()}
    if log_density is not None:
        terms["heat"] = heat_loss(log_density, truth).mean()
    return terms
