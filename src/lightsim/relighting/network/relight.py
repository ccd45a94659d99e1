"""`--method network` and `--method paper`: frames as the shipped networks show them."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float32

from lightsim.errors import InputError
from lightsim.relighting.network.channels import scene_planes, shrunk, target_planes
from lightsim.relighting.network.features import linear_of, tensors_of
from lightsim.relighting.network.model import RelitNet
from lightsim.relighting.network.paper_model import PaperNet
from lightsim.relighting.network.stored import shipped_network
from lightsim.relighting.physical.ratio import (
    Circumstances,
    RatioConfig,
    RelightInputs,
    relight_physical,
)

NETWORK_WEIGHTS, PAPER_WEIGHTS = "relight-network", "relight-paper"


def relight_network(inputs: RelightInputs, config: RatioConfig) -> Float32[np.ndarray, "h w 3"]:
    """`relit_by` the shipped network.

    Raises:
        InputError: its weights are missing or damaged, or as `relit_by`.
    """
    network = shipped_network(NETWORK_WEIGHTS)
    assert isinstance(network, RelitNet)
    return relit_by(network, inputs, config)


def relight_paper(inputs: RelightInputs, _: RatioConfig) -> Float32[np.ndarray, "h w 3"]:
    """`painted_by` the shipped network of the paper's form; raises as `relight_network`."""
    network = shipped_network(PAPER_WEIGHTS)
    assert isinstance(network, PaperNet)
    return painted_by(network, inputs)


def relit_by(
    network: RelitNet, inputs: RelightInputs, config: RatioConfig
) -> Float32[np.ndarray, "h w 3"]:
    """Scene radiance of the frame under the target sky, linear, before camera gain: the physical
    estimate, corrected.

    Raises:
        InputError: the inputs do not tell of camera and skies.
    """
    seen = _circumstances(inputs)
    physical = relight_physical(inputs, config)
    planes = scene_planes(inputs, seen) | target_planes(inputs, seen, physical)
    working = shrunk(planes, network.config.working_columns)
    with torch.inference_mode():
        batch = tensors_of(planes)
        found = network(batch, None if working is planes else tensors_of(working))
    picture = found.picture[0].permute(1, 2, 0).numpy()
    # Sky and what the network leaves alone keep their radiance to the bit.
    is_same = inputs.sky_matte[..., None] >= 1
    return np.where(is_same, physical, picture / seen.gain).astype(np.float32)


def painted_by(network: PaperNet, inputs: RelightInputs) -> Float32[np.ndarray, "h w 3"]:
    """Scene radiance whose picture the network painted, sky and all; at most the camera's white.

    Raises:
        InputError: the inputs do not tell of camera and skies.
    """
    seen = _circumstances(inputs)
    planes = scene_planes(inputs, seen) | target_planes(inputs, seen, inputs.target_sky)
    with torch.inference_mode():
        picture = linear_of(network(tensors_of(planes)))[0].permute(1, 2, 0).numpy()
    return (picture / seen.gain).astype(np.float32)


def _circumstances(inputs: RelightInputs) -> Circumstances:
    if inputs.circumstances is None:
        raise InputError(
            "relighting networks look at camera and skies",
            got="neither",
            expected="inputs with circumstances",
        )
    return inputs.circumstances
