"""A closed-form scene: textured level ground and a wall under a sun and a uniform sky."""

from __future__ import annotations

import numpy as np

from lightsim.core.buffers import BACKGROUND, NO_SURFACE, GBuffers, ShadowBuffers
from lightsim.core.dome import Sun

HEIGHT_PX, WIDTH_PX = 96, 128
SKY_ROWS, WALL_ROWS = 16, 48
"""Rows above 16 see the sky, rows 16 to 47 a wall, rows from 48 on the ground."""


def sun_towards(azimuth_deg: float, elevation_deg: float, strength: float = 4.0) -> Sun:
    """Azimuth counter-clockwise from world x, warm light."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    direction = np.array(
        [
            np.cos(azimuth) * np.cos(elevation),
            np.sin(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ]
    )
    irradiance = np.array([1.0, 0.93, 0.8], np.float32) * np.float32(strength)
    return Sun(direction, irradiance)


def geometry(rng: np.random.Generator) -> GBuffers:
    """5 cm pixels; the wall faces world -x."""
    size = (HEIGHT_PX, WIDTH_PX)
    row, column = np.mgrid[:HEIGHT_PX, :WIDTH_PX].astype(np.float32)
    is_sky, is_wall = row < SKY_ROWS, (row >= SKY_ROWS) & (row < WALL_ROWS)
    position = np.zeros((*size, 3), np.float32)
    position[..., 0] = np.where(is_wall, 10.0, 10.0 - 0.05 * (row - WALL_ROWS))
    position[..., 1] = -0.05 * column
    position[..., 2] = np.where(is_wall, 0.05 * (WALL_ROWS - row), 0.0)
    normal = np.where(is_wall[..., None], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]).astype(np.float32)
    coarse = rng.uniform(0.15, 0.6, (HEIGHT_PX // 4, WIDTH_PX // 4, 3))
    colour = coarse.repeat(4, axis=0).repeat(4, axis=1).astype(np.float32)
    for array in (position, normal, colour):
        array[is_sky] = 0
    return GBuffers(
        depth_z_m=np.where(is_sky, np.inf, 12.0).astype(np.float32),
        position_world=position,
        normal_world=normal,
        base_colour=colour,
        ambient_occlusion=np.ones(size, np.float32),
        actor_index=np.where(is_sky, NO_SURFACE, BACKGROUND).astype(np.int32),
    )


def light(buffers: GBuffers, sun: Sun | None, sky: float, visibility: np.ndarray) -> ShadowBuffers:
    """Irradiance over pi of a bluish uniform sky and a sun."""
    blue = np.array([0.7, 0.85, 1.2], np.float32) * np.float32(sky)
    fraction = 0.5 * (1 + buffers.normal_world[..., 2:])
    from_sky = np.where(buffers.has_surface[..., None], fraction * blue, 0.0).astype(np.float32)
    open_sun = np.zeros_like(from_sky)
    if sun is not None:
        cosine = np.maximum(buffers.normal_world @ sun.direction_world.astype(np.float32), 0)
        open_sun = (cosine[..., None] * sun.irradiance / np.float32(np.pi)).astype(np.float32)
    visibility = np.where(buffers.has_surface, visibility, 0.0).astype(np.float32)
    direct = (open_sun * visibility[..., None]).astype(np.float32)
    return ShadowBuffers(
        sun_visibility=visibility,
        direct_sun=direct,
        sky=from_sky,
        bounce=np.zeros_like(direct),
        shaded=direct + from_sky,
        unshadowed=open_sun + from_sky,
    )


def everywhere_lit() -> np.ndarray:
    return np.ones((HEIGHT_PX, WIDTH_PX), np.float32)


def shadow_right_of(column: float) -> np.ndarray:
    """A vertical shadow edge in the picture."""
    return np.broadcast_to(
        (np.arange(WIDTH_PX) < column).astype(np.float32), (HEIGHT_PX, WIDTH_PX)
    ).copy()
