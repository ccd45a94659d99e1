"""Volume rendering of whole frames from the neural field (paper Sec. 3.1)."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import UInt8

from lightsim.core.log import DrivingLog
from lightsim.core.sensors import CameraFrame
from lightsim.networks.devices import device_of
from lightsim.reconstruct.field.ray_pool import Guide, pixel_rays
from lightsim.reconstruct.field.sampling import place_samples
from lightsim.reconstruct.field.sdf_field import SceneField
from lightsim.reconstruct.field.train import batch_of
from lightsim.reconstruct.field.volume_rendering import composite, opacities

# Pixels rendered together, to limit memory.
_CHUNK = 16_384


def render_frame(
    field: SceneField, log: DrivingLog, frame: CameraFrame, guide: Guide
) -> UInt8[np.ndarray, "h w 3"]:
    """Render the image of a frame's camera, 8-bit sRGB.

    Samples are placed as in training, with random numbers that are equal in every call.
    """
    camera = log.cameras[frame.camera_name]
    device = device_of(field)
    generator = torch.Generator().manual_seed(0)
    parts = []
    for start in range(0, camera.width_px * camera.height_px, _CHUNK):
        pixel = np.arange(start, min(start + _CHUNK, camera.width_px * camera.height_px))
        rays = batch_of(pixel_rays(log, frame, pixel, guide), device)
        with torch.no_grad():
            t = place_samples(rays, generator)
            sdf, colour, _, _ = field(*rays.points(t))
            weights = composite(
                opacities(sdf.reshape(t.shape), field.beta, field.config.conversion)
            )
            seen = weights.mean(colour.reshape(*t.shape, 3))
            seen += weights.transmittance[:, None] * field.sky(rays.direction)
            seen = field.pixel_colour(seen, rays.camera.to(torch.int64))
        parts.append(seen.clamp(0.0, 1.0).cpu().numpy())
    image = np.concatenate(parts).reshape(camera.height_px, camera.width_px, 3)
    return np.round(image * 255).astype(np.uint8)
