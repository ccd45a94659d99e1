"""Application of the shipped networks to frames: `--method network` and `--method paper`."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from lightsim.errors import InputError
from lightsim.networks.devices import device_of
from lightsim.relighting.estimate import Estimate
from lightsim.relighting.network.channels import scene_planes, target_planes
from lightsim.relighting.network.expected_error import expected_error
from lightsim.relighting.network.features import Batch, downsampled, linear_of, tensors_of
from lightsim.relighting.network.model import RelitNet
from lightsim.relighting.network.paper_model import PaperNet
from lightsim.relighting.network.tiles import predicted_in_tiles
from lightsim.relighting.physical.ratio import (
    CameraAndSkies,
    RatioConfig,
    RelightInputs,
    relight_physical,
)


def relit_by_network(network: RelitNet, inputs: RelightInputs, config: RatioConfig) -> Estimate:
    """Return the corrected physical estimate and its expected error.

    Raises:
        InputError: the inputs have no camera and skies (`camera_and_skies`).
    """
    seen = camera_and_skies_of(inputs)
    physical = relight_physical(inputs, config)
    with torch.inference_mode():
        known, small = inputs.cached_for_source(_scene, network)
        target = tensors_of(target_planes(inputs, seen, physical), device_of(network))
        batch = working = known | target
        if small is not known:
            working = {**small, **downsampled(target, network.config.working_columns)}
        found = network(batch, working)
        error = expected_error(found, working)
    picture = found.picture[0].permute(1, 2, 0).cpu().numpy()
    # Sky pixels keep their radiance bit for bit.
    is_same = inputs.sky_matte[..., None] >= 1
    radiance = np.where(is_same, physical, picture / seen.gain).astype(np.float32)
    error = functional.interpolate(error, picture.shape[:2], mode="bilinear")
    return Estimate(radiance, error[0, 0].cpu().numpy())


def _scene(inputs: RelightInputs, network: RelitNet) -> tuple[dict[str, Tensor], Batch]:
    """Planes of the frame under its source sky, at the size of the picture and at the working
    size."""
    planes = scene_planes(inputs, camera_and_skies_of(inputs))
    known = tensors_of(planes, device_of(network))
    return known, downsampled(known, network.config.working_columns)


def relit_by_paper_network(
    network: PaperNet, inputs: RelightInputs, config: RatioConfig
) -> Estimate:
    """Return the radiance of the picture that the network predicts, sky included; at most the
    camera's white.

    Args:
        config: unused; settings of other methods.

    Raises:
        InputError: the inputs have no camera and skies (`camera_and_skies`).
    """
    seen = camera_and_skies_of(inputs)
    planes = scene_planes(inputs, seen) | target_planes(inputs, seen, inputs.target_sky)
    with torch.inference_mode():
        batch = tensors_of(planes, device_of(network))
        picture = linear_of(predicted_in_tiles(network, batch, network.config.tile_px))[0]
        picture = picture.permute(1, 2, 0).cpu().numpy()
    return Estimate((picture / seen.gain).astype(np.float32))


def camera_and_skies_of(inputs: RelightInputs) -> CameraAndSkies:
    """Return camera and skies of a frame.

    Raises:
        InputError: the inputs do not have them.
    """
    if inputs.camera_and_skies is None:
        raise InputError(
            "relighting networks require camera and skies",
            where="camera_and_skies",
            got="None",
            expected="inputs with the camera's gain and pose and both sky domes",
        )
    return inputs.camera_and_skies
