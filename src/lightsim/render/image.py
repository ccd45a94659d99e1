"""Image of an ideal camera without gain and noise: surfaces, reflections and sky."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import SkyDome
from lightsim.core.equirect import sample_bilinear
from lightsim.core.frames import points_rotated
from lightsim.core.sensors import CameraFrame
from lightsim.render.transport.sky import EnvironmentCells


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


def visible_sky(
    sky: EnvironmentCells, frame: CameraFrame, camera: PinholeCamera
) -> Float32[np.ndarray, "h w 3"]:
    """Return the radiance of the sky in a camera, with a sharp solar disc."""
    assert sky.behind is not None
    rays = frame.pixel_rays(camera, camera.pixel_centres().reshape(-1, 2))[1]
    radiance = sample_bilinear(sky.behind, rays).astype(np.float32)
    if sky.sun is not None:
        radius_rad = np.radians(sky.sun.angular_radius_deg)
        axis = sky.sun.direction_world / np.linalg.norm(sky.sun.direction_world)
        # The sun is absent from `sky.behind`, whose texels would blur its disc.
        in_disc = rays @ axis > np.cos(radius_rad)
        solid_angle_sr = 2 * np.pi * (1 - np.cos(radius_rad))
        radiance[in_disc] += (sky.sun.irradiance / solid_angle_sr).astype(np.float32)
    return radiance.reshape(camera.height_px, camera.width_px, 3)
