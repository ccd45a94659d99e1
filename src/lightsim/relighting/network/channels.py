"""Inputs of the relighting networks for a frame: named planes and the two skies.

Radiances and lights are linear and multiplied by the camera's gain, so that 1 is the white of its
pictures, whatever the unit of the scene. Vectors and domes are in the camera's level frame: right,
forward, up.
"""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.buffers import ShadowBuffers
from lightsim.core.colour import srgb_from_linear
from lightsim.core.dome import SkyDome
from lightsim.core.frames import RigidTransform
from lightsim.core.resample import resize_area
from lightsim.relighting.physical.ratio import CameraAndSkies, RelightInputs

Planes = dict[str, Float[np.ndarray, "_ _ _"]]
"""Arrays of the picture's size by name; domes (`OF_SKIES`) have another size."""

# Rows of the domes that networks receive: enough for the sun's position, little memory.
DOME_ROWS = 32
OF_SKIES = "_dome"
"""Suffix of the names of domes, whose pixels are not those of the picture."""
SCENE = MappingProxyType(
    {
        "source": 3,  # The recorded picture, sRGB in [0, 1].
        "clipped": 1,
        "matte": 1,  # Fraction of the pixel that is sky.
        "surface": 1,  # 1 where the ray meets a mesh; the planes below are 0 elsewhere.
        "depth": 1,  # Metres along the optical axis.
        "position": 3,  # Metres from the camera.
        "normal": 3,
        "base_colour": 3,
        "openness": 1,  # Ambient occlusion: 1 is open.
        "actor": 1,  # 1 on actors.
        "found": 1,  # Visibility of the recorded sun, estimated from pictures; -1 where unknown.
    }
)
"""Planes of a frame, with their channels."""
LIGHT = MappingProxyType(
    {
        "shaded": 3,  # Radiance of a white Lambert surface.
        "ratio": 3,  # Shadow ratio S (paper, Sec. 4).
        "sun": 1,  # Visible fraction of the solar disc.
        "reflected": 3,
    }
)
"""Planes of a frame under one sky; named `source_shaded` and so on."""
BUFFERS = ("openness", "normal", "depth", "position")
"""Planes of the paper's I_buffer."""
TARGET = MappingProxyType({"physical": 3, "sky": 3})
"""Planes of one target sky: the physical estimate, and the sky along the camera's rays."""


def scene_planes(inputs: RelightInputs, camera_and_skies: CameraAndSkies) -> Planes:
    """Return the planes of `SCENE`, and those of `LIGHT` under the source sky."""
    buffers = inputs.buffers
    is_there = buffers.has_surface
    found = inputs.found_visibility
    if found is None:
        found = np.full(is_there.shape, np.nan, np.float32)
    axes = _level_axes(camera_and_skies.world_from_camera)
    from_camera = buffers.position_world - camera_and_skies.world_from_camera.translation_m.astype(
        np.float32
    )
    planes = {
        "source": srgb_from_linear(np.clip(inputs.radiance * camera_and_skies.gain, 0, 1)),
        "clipped": inputs.is_clipped,
        "matte": inputs.sky_matte,
        "surface": is_there,
        "depth": np.where(is_there, buffers.depth_z_m, 0),
        "position": np.where(is_there[..., None], from_camera, 0) @ axes,
        "normal": buffers.normal_world @ axes,
        "base_colour": buffers.base_colour,
        "openness": np.where(is_there, buffers.ambient_occlusion, 0),
        "actor": buffers.actor_index >= 0,
        "found": np.where(np.isfinite(found), found, -1),
    }
    light = _light_planes(inputs.source, camera_and_skies.gain) | {
        "dome": _dome(camera_and_skies.source_sky, camera_and_skies.gain, axes)
    }
    own = {f"source_{name}": value for name, value in light.items()}
    return {name: _plane(value) for name, value in {**planes, **own}.items()}


def target_planes(
    inputs: RelightInputs, camera_and_skies: CameraAndSkies, physical: Float32[np.ndarray, "h w 3"]
) -> Planes:
    """Return the planes of `LIGHT` under the target sky, and those of `TARGET`.

    Args:
        physical: scene radiance of physical relighting.
    """
    planes = {
        "physical": physical * camera_and_skies.gain,
        "sky": inputs.target_sky * camera_and_skies.gain,
        **_light_planes(inputs.target, camera_and_skies.gain),
        "dome": _dome(
            camera_and_skies.target_sky,
            camera_and_skies.gain,
            _level_axes(camera_and_skies.world_from_camera),
        ),
    }
    return {f"target_{name}": _plane(value) for name, value in planes.items()}


def _light_planes(light: ShadowBuffers, gain: Float32[np.ndarray, "3"]) -> dict[str, np.ndarray]:
    return {
        "shaded": light.shaded * gain,
        "ratio": light.ratio,
        "sun": light.sun_visibility,
        "reflected": light.reflected * gain,
    }


def _level_axes(world_from_camera: RigidTransform) -> Float32[np.ndarray, "3 3"]:
    """Level right, forward and up axes of the camera, as columns in frame `world`.

    A camera that looks straight up or down has the top of its picture as forward.
    """
    axis, top = world_from_camera.rotation[:, 2], -world_from_camera.rotation[:, 1]
    x, y = axis[:2] if np.hypot(*axis[:2]) > 1e-3 else top[:2]
    length = np.hypot(x, y)
    return np.array([[y, x, 0], [-x, y, 0], [0, 0, length]], np.float32) / np.float32(length)


def _dome(
    dome: SkyDome, gain: Float32[np.ndarray, "3"], axes: Float32[np.ndarray, "3 3"]
) -> Float32[np.ndarray, "r c 3"]:
    """Reduced dome times the camera's gain, with its centre column along the camera's forward
    axis."""
    small = resize_area(dome.radiance, DOME_ROWS, 2 * DOME_ROWS)
    azimuth_deg = float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1])))
    return SkyDome(small * gain, None).rotated(-azimuth_deg).radiance


def _plane(values: np.ndarray) -> Float32[np.ndarray, "c h w"]:
    values = np.asarray(values, dtype=np.float32)
    stacked = values[None] if values.ndim == 2 else np.moveaxis(values, -1, 0)
    return np.ascontiguousarray(stacked)
