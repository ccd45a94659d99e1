"""Image of an ideal camera without gain and noise: surfaces, reflections and sky."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import SkyDome
from lightsim.core.frames import points_rotated
from lightsim.core.sensors import CameraFrame


def scene_image(
    gbuffers: GBuffers, light: ShadowBuffers, sky: Float32[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return the radiance of every pixel, in the units of the sky.

    Args:
        light: from `render.transport.light`. Anti-aliased and with reflections if its matrix was
            traced with samples; otherwise base colour times light at pixel centres.
        sky: radiance of the dome along the pixels' rays.
    """
    diffuse = gbuffers.base_colour * light.shaded if light.diffuse is None else light.diffuse
    surface = diffuse if light.glossy is None else diffuse + light.glossy
    # Anti-aliased light has a fraction of surface in each pixel; the rest is sky.
    coverage = gbuffers.has_surface if light.coverage is None else light.coverage
    covered = coverage.astype(np.float32)[..., None]
    return covered * surface + (1 - covered) * sky


def sky_image(
    dome: SkyDome, camera: PinholeCamera, frame: CameraFrame
) -> Float32[np.ndarray, "h w 3"]:
    """Return the radiance of a dome along the ray of each pixel."""
    directions = camera.directions(camera.pixel_centres())
    rotation = frame.world_from_camera.rotation
    return dome.look_up(points_rotated(directions, rotation)).astype(np.float32)
