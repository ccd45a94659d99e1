"""Relighting of frames by `--method self-osr`, `epe` and `nerf-osr`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32

from lightsim.core.dome import SkyDome, resized
from lightsim.networks.devices import device_of
from lightsim.relighting.estimate import Estimate
from lightsim.relighting.network.channels import DOME_ROWS, scene_planes, target_planes
from lightsim.relighting.network.features import linear_of, tensors_of
from lightsim.relighting.network.relight import camera_and_skies_of
from lightsim.relighting.physical.matte import composite
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs
from lightsim_lab.baselines.epe import EpeNet
from lightsim_lab.baselines.self_osr import SelfOsrNet
from lightsim_lab.baselines.spherical_harmonics import project, shading_basis


def shown_by(network: SelfOsrNet | EpeNet, inputs: RelightInputs, config: RatioConfig) -> Estimate:
    """Return the radiance of the picture that the network predicts, at most the camera's white.

    Args:
        config: unused; part of the interface of all methods.

    Raises:
        InputError: the inputs lack the camera or the skies.
    """
    seen = camera_and_skies_of(inputs)
    planes = scene_planes(inputs, seen) | target_planes(inputs, seen, inputs.target_sky)
    with torch.inference_mode():
        picture = linear_of(network(tensors_of(planes, device_of(network))).clamp(0, 1))[0]
        picture = picture.permute(1, 2, 0).cpu().numpy()
    # Networks return pixel values; radiance is before the camera gain.
    return Estimate((picture / seen.gain).astype(np.float32))


@dataclass(frozen=True, eq=False)
class FieldSurface:
    """Surface attributes that a neural field renders along rays.

    Args:
        albedo: linear, in [0, 1].
        normal_world: unit vectors.
        shadow: 1 is lit, 0 dark.
    """

    albedo: Float32[np.ndarray, "n 3"]
    normal_world: Float32[np.ndarray, "n 3"]
    shadow: Float32[np.ndarray, " n"]


# Arguments: points on the twin's surface, unit directions of the rays, lighting; frame `world`.
RelightableField = Callable[
    [Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"], Float32[np.ndarray, "9 3"]],
    FieldSurface,
]


def relit_field(field: RelightableField, inputs: RelightInputs, config: RatioConfig) -> Estimate:
    """Return the radiance of a street's neural field under the order-2 target lighting, composited
    over the target sky.

    The field contains the static background. Actors have the twin's base colour and normals under
    the same lighting.

    Args:
        config: unused; part of the interface of all methods.

    Raises:
        InputError: the inputs lack the camera or the skies.
    """
    seen, buffers = camera_and_skies_of(inputs), inputs.buffers
    light = lighting_of(seen.target_sky)
    rows = np.nonzero(buffers.has_surface)
    points = buffers.position_world[rows].astype(np.float32)
    offset = points - seen.world_from_camera.translation_m.astype(np.float32)
    directions = offset / np.maximum(np.linalg.norm(offset, axis=-1, keepdims=True), 1e-6)
    shown = field(points, directions.astype(np.float32), light)
    # The field was trained without actors and is undefined inside their boxes.
    is_actor = buffers.actor_index[rows] >= 0
    normal = np.where(is_actor[:, None], buffers.normal_world[rows], shown.normal_world)
    albedo = np.where(is_actor[:, None], buffers.base_colour[rows], shown.albedo)
    shadow = np.where(is_actor, np.float32(1), shown.shadow)
    functions = shading_basis(torch.from_numpy(normal.astype(np.float32))).numpy()
    radiance = np.zeros_like(inputs.radiance)
    radiance[rows] = albedo * np.maximum(functions @ light, 0) * shadow[:, None]
    # Pixels without a surface of the twin show the sky entirely.
    is_sky = np.where(buffers.has_surface, inputs.sky_matte, 1).astype(np.float32)
    return Estimate(composite(radiance, inputs.target_sky, is_sky))


def lighting_of(sky: SkyDome) -> Float32[np.ndarray, "9 3"]:
    """Return the order-2 coefficients of a dome's radiance, sun included, frame `world`."""
    radiance = np.moveaxis(resized(sky, DOME_ROWS).radiance, -1, 0)[None]
    return project(torch.from_numpy(np.ascontiguousarray(radiance)))[0].numpy()
