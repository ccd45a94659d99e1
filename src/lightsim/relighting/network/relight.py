"""`--method network` and `--method paper`: frames as the shipped networks show them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch.nn import functional

from lightsim.errors import InputError
from lightsim.relighting.estimate import Estimate
from lightsim.relighting.network.channels import scene_planes, shrunk, target_planes
from lightsim.relighting.network.features import linear_of, tensors_of
from lightsim.relighting.network.model import RelitNet
from lightsim.relighting.network.paper_model import PaperNet
from lightsim.relighting.network.stored import network_of
from lightsim.relighting.options import NETWORK_WEIGHTS
from lightsim.relighting.physical.ratio import (
    Circumstances,
    RatioConfig,
    RelightInputs,
    relight_physical,
)
from lightsim.store.weights import load_weights, read_weights


def correcting_network(weights: Path | None) -> RelitNet:
    """The network of a file, or the package's.

    Raises:
        InputError, ArtefactError: the weights are missing or damaged, or another network's.
    """
    network = network_of(
        load_weights(NETWORK_WEIGHTS) if weights is None else read_weights(weights)
    )
    if not isinstance(network, RelitNet):
        raise _other("network", weights)
    return network


def painting_network(weights: Path | None) -> PaperNet:
    """The network of the paper's form of a file; raises as `correcting_network`."""
    if weights is None:
        raise InputError(
            "the package has no weights of the paper's network",
            where="--method paper",
            remedy="Train them (lightsim train relight --network paper) and give --weights.",
        )
    network = network_of(read_weights(weights))
    if not isinstance(network, PaperNet):
        raise _other("paper", weights)
    return network


def _other(method: str, weights: Path | None) -> InputError:
    return InputError(
        "these are the weights of another network",
        where=weights,
        expected=f"those of lightsim train relight --network {method}",
    )


def relit_by(network: RelitNet, inputs: RelightInputs, config: RatioConfig) -> Estimate:
    """The physical estimate, corrected, and the error that is expected of it.

    Raises:
        InputError: the inputs do not tell of camera and skies.
    """
    seen = circumstances_of(inputs)
    physical = relight_physical(inputs, config)
    planes = scene_planes(inputs, seen) | target_planes(inputs, seen, physical)
    working = shrunk(planes, network.config.working_columns)
    with torch.inference_mode():
        batch = tensors_of(planes)
        found = network(batch, None if working is planes else tensors_of(working))
    picture = found.picture[0].permute(1, 2, 0).numpy()
    # Sky and what the network leaves alone keep their radiance to the bit.
    is_same = inputs.sky_matte[..., None] >= 1
    radiance = np.where(is_same, physical, picture / seen.gain).astype(np.float32)
    log_error = functional.interpolate(found.log_error, picture.shape[:2], mode="bilinear")
    return Estimate(radiance, log_error[0, 0].exp().numpy())


def painted_by(network: PaperNet, inputs: RelightInputs, config: RatioConfig) -> Estimate:
    """Radiance whose picture the network painted, sky and all; at most the camera's white.

    Args:
        config: of other methods; not looked at.

    Raises:
        InputError: the inputs do not tell of camera and skies.
    """
    seen = circumstances_of(inputs)
    planes = scene_planes(inputs, seen) | target_planes(inputs, seen, inputs.target_sky)
    with torch.inference_mode():
        picture = linear_of(network(tensors_of(planes)))[0].permute(1, 2, 0).numpy()
    return Estimate((picture / seen.gain).astype(np.float32))


def circumstances_of(inputs: RelightInputs) -> Circumstances:
    """Camera and skies of a frame.

    Raises:
        InputError: the inputs do not tell of them.
    """
    if inputs.circumstances is None:
        raise InputError(
            "relighting networks look at camera and skies",
            got="neither",
            expected="inputs with circumstances",
        )
    return inputs.circumstances
