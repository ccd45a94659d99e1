"""Calibration of the concentration of the sun's density on held-out skies.

Predicted concentrations on unseen skies are up to a hundred times too large, and the validation
side has too few suns for individual corrections. After training, one common concentration is fitted
to them by maximum likelihood. Directions do not change.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from lightsim.lighting.sample import LightingBatch
from lightsim.lighting.sky.network import SkyNetwork
from lightsim.lighting.sky.sky_terms import fisher_loss
from lightsim_lab.training.sky import sky_tensors

# Range of the log of the common concentration: from a hemisphere to a cone of 3 degrees.
_LOG_RANGE = (-2.0, 6.0)


def calibrate_concentration(network: SkyNetwork, views: Sequence[LightingBatch]) -> None:
    """Replace the concentrations by a common one, fitted to the suns of `views`.

    Args:
        network: changed in place; in evaluation mode, on the CPU.
        views: batches of the validation side; only views under a clear sun count. Without one, the
            network is unchanged.
    """
    head = network.direction_head
    contexts, errors = _contexts_and_errors(network, views)
    if not len(errors):
        return
    cosine = torch.from_numpy(np.cos(errors))
    # Any two unit vectors at the angle of the error: the likelihood depends on nothing else.
    towards = torch.stack([cosine, torch.sqrt(1 - cosine**2), torch.zeros_like(cosine)], dim=1)
    truth = torch.tensor([1.0, 0.0, 0.0]).expand_as(towards).double()

    def loss(common: float) -> float:
        log_kappa = contexts + head.bounded(common - contexts)
        return float(fisher_loss(towards, log_kappa, truth).mean())

    best: Any = minimize_scalar(loss, bounds=_LOG_RANGE, method="bounded")
    with torch.no_grad():
        head.spread.weight.zero_()
        # The correction is the difference to the common value.
        head.spread.weight[0, 0] = -1.0
        head.spread.bias.fill_(float(best.x))


def _contexts_and_errors(
    network: SkyNetwork, views: Sequence[LightingBatch]
) -> tuple[torch.Tensor, Float[np.ndarray, " n"]]:
    """Return uncorrected log concentrations and errors of direction, radians, of clear suns."""
    found: list[torch.Tensor] = []
    # The head's linear layer receives the uncorrected log concentration first.
    hook = network.direction_head.spread.register_forward_pre_hook(
        lambda _, inputs: found.append(inputs[0][:, 0])
    )
    errors: list[torch.Tensor] = []
    are_sunny: list[torch.Tensor] = []
    with torch.no_grad():
        for view in views:
            is_whole = np.zeros(len(view.log_peak), bool)
            batch = sky_tensors(view, is_whole, None, torch.device("cpu"))
            image = network.encoder_input(network.shown(batch))
            direction = network.direct(image, batch.sky.shape[2])[1].double()
            cosine = (direction * batch.sun_direction.double()).sum(dim=1)
            errors.append(torch.arccos(cosine.clamp(-1, 1)))
            are_sunny.append(batch.is_sunny > 0.5)
    hook.remove()
    is_sunny = torch.cat(are_sunny)
    return torch.cat(found).double()[is_sunny], torch.cat(errors)[is_sunny].numpy()
