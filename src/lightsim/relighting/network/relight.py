"""`--method network` and `--method paper`: frames as the shipped networks show them."""

from __future__ import annotations

import numpy as np
import torch
from torch.nn import functional

from lightsim.errors import InputError
from lightsim.networks.devices import device_of
from lightsim.relighting.estimate import Estimate
from lightsim.relighting.network.channels import scene_planes, target_planes
from lightsim.relighting.network.expected_error import expected_error
from lightsim.relighting.network.features import linear_of, shrunk, tensors_of
from lightsim.relighting.network.model import RelitNet
from lightsim.relighting.network.paper_model import PaperNet
from lightsim.relighting.physical.ratio import (
    Circumstances,
    RatioConfig,
    RelightInputs,
    relight_physical,
)


def relit_by(network: RelitNet, inputs: RelightInputs, config: RatioConfig) -> Estimate:
    """The physical estimate, corrected, and the error that is expected of it.

    Raises:
        InputError: the inputs do not tell of camera and skies.
    """
    seen = circumstances_of(inputs)
    physical = relight_physical(inputs, config)
    planes = scene_planes(inputs, seen) | target_planes(inputs, seen, physical)
    with torch.inference_mode():
        batch = tensors_of(planes, device_of(network))
        working = shrunk(batch, network.config.working_columns)
        found = network(batch, working)
        error = expected_error(found, working)
    picture = found.picture[0].permute(1, 2, 0).cpu().numpy()
    # Sky and what the network leaves alone keep their radiance to the bit.
    is_same = inputs.sky_matte[..., None] >= 1
    radiance = np.where(is_same, physical, picture / seen.gain).astype(np.float32)
    error = functional.interpolate(error, picture.shape[:2], mode="bilinear")
    return Estimate(radiance, error[0, 0].cpu().numpy())


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
        picture = linear_of(network(tensors_of(planes, device_of(network))))[0]
        picture = picture.permute(1, 2, 0).cpu().numpy()
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
