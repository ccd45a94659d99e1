"""Sun on surface points: irradiance by the cosine law, and the visible fraction of its disc."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Int64

from lightsim.core.casting import RayCaster
from lightsim.core.colour import luminance
from lightsim.core.dome import Sun, disc_directions
from lightsim.render.casters.embree import offset_origins
from lightsim.render.scene import FrameScene
from lightsim.render.transport.faces import TILE_RAYS, TransportConfig, hashed_shifts

# Rotations of the sample pattern on the disc, one of which each pixel uses; more than needed to
# avoid visible repetition. Sensitivity not measured.
PATTERNS = 64
# Approximate exponent from light to 8-bit pixel values (sRGB curve, IEC 61966-2-1).
_CODE_POWER = 1 / 2.2


def unshadowed_sun(normals_world: Float[np.ndarray, "n 3"], sun: Sun) -> Float32[np.ndarray, "n 3"]:
    """Return irradiance / pi of the sun by the cosine law, without visibility."""
    direction = sun.direction_world / np.linalg.norm(sun.direction_world)
    cosine = np.maximum(normals_world @ direction.astype(np.float32), 0.0)
    return (cosine[:, None] * (sun.irradiance / np.pi)).astype(np.float32)


def sun_visibility(
    caster: RayCaster,
    points_world: Float32[np.ndarray, "n 3"],
    normals_world: Float32[np.ndarray, "n 3"],
    sun: Sun,
    config: TransportConfig,
) -> Float32[np.ndarray, " n"]:
    """Return the visible fraction of the solar disc of each point; 0 if it faces away from the sun.

    The disc is sampled at `sun_rays` points, rotated by a fixed pseudo-random angle per point:
    neighbouring pixels differ, and frames of a sequence do not flicker.
    """
    direction = (sun.direction_world / np.linalg.norm(sun.direction_world)).astype(np.float32)
    # Points that face away from the sun's centre are in their own shadow and need no rays.
    facing = np.flatnonzero(normals_world @ direction > 0)
    patterns = disc_patterns(sun, config.sun_rays)
    visible = np.zeros(len(points_world), dtype=np.float32)
    tile = max(1, TILE_RAYS // config.sun_rays)
    for start in range(0, len(facing), tile):
        rows = facing[start : start + tile]
        chosen = pattern_numbers(rows)
        origins = offset_origins(points_world[rows], normals_world[rows])
        occluded = caster.is_occluded(
            np.repeat(origins, config.sun_rays, axis=0), patterns[chosen].reshape(-1, 3)
        )
        visible[rows] = 1 - occluded.reshape(-1, config.sun_rays).mean(axis=1, dtype=np.float32)
    return visible


def sun_in_scene(
    scene: FrameScene,
    points_world: Float32[np.ndarray, "n 3"],
    normals_world: Float32[np.ndarray, "n 3"],
    sun: Sun,
    config: TransportConfig,
    shade: Float32[np.ndarray, " n"] | None = None,
) -> Float32[np.ndarray, " n"]:
    """Return `sun_visibility` in a scene whose roofs may be uncertain.

    Args:
        shade: luminance of all other light on the points, for `visibility_of_expected_code`; None:
            the mean light is returned.
    """
    caster, roofs = scene.certain_sun_occluders(sun)
    visible = sun_visibility(caster, points_world, normals_world, sun, config)
    if roofs is not None:
        rows = np.flatnonzero(visible > 0)
        chance = roofs.open_fraction(offset_origins(points_world[rows], normals_world[rows]), sun)
        if shade is not None:
            sunlight = luminance(unshadowed_sun(normals_world[rows], sun)) * visible[rows]
            chance = visibility_of_expected_code(chance, shade[rows], sunlight)
        visible[rows] *= chance
    return visible


def visibility_of_expected_code(
    chance: Float32[np.ndarray, " n"],
    shade: Float32[np.ndarray, " n"],
    sunlight: Float32[np.ndarray, " n"],
) -> Float32[np.ndarray, " n"]:
    """Return the sun visibility at which a pixel has its expected 8-bit value.

    Images are evaluated by 8-bit codes, which change quickly in the dark: a tenth of a low sun's
    light more than doubles the code of a shaded pixel. The code of the mean light would therefore
    be far from the mean code.

    Args:
        chance: probability that the sun is visible.
        shade, sunlight: luminances of other light, and of the sun's.
    """
    # Pixel values relative to full light, averaged with the probability, and converted back to
    # light.
    total = np.maximum(shade + sunlight, 1e-12)
    dark = (shade / total) ** _CODE_POWER
    mean = (dark + (1 - dark) * chance) ** (1 / _CODE_POWER)
    return np.clip((mean * total - shade) / np.maximum(sunlight, 1e-12), 0, 1).astype(np.float32)


def pattern_numbers(numbers: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Return the pattern of `disc_patterns` that each pixel uses, by a hash of its number."""
    return (hashed_shifts(numbers, 7)[:, 0] * PATTERNS).astype(np.int64)


def disc_patterns(sun: Sun, count: int) -> Float32[np.ndarray, "p k 3"]:
    """Return sample directions on the solar disc, rotated about its centre by PATTERNS angles."""
    axis = sun.direction_world / np.linalg.norm(sun.direction_world)
    disc = disc_directions(axis, sun.angular_radius_deg, count)
    # Rodrigues' rotation about the sun's axis.
    along = (disc @ axis)[:, None] * axis
    across = disc - along
    angle = (np.arange(PATTERNS) / PATTERNS * 2 * np.pi)[:, None, None]
    turned = along + np.cos(angle) * across + np.sin(angle) * np.cross(axis, across)
    return turned.astype(np.float32)
