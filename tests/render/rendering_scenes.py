"""Small scenes for the rendering tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import SkyDome, Sun, add_sun
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh

Albedo = float | Sequence[float] | np.ndarray
"""Grey, one RGB colour, or one for each vertex."""


def mesh(vertices, faces, albedo: Albedo = 0.5) -> TriMesh:
    vertices = np.asarray(vertices, dtype=np.float32)
    colour = np.broadcast_to(np.asarray(albedo, dtype=np.float32), vertices.shape).copy()
    return TriMesh("world", vertices, np.asarray(faces, dtype=np.int32), colour)


def plane(half_m: float = 20.0, cells: int = 1, albedo: Albedo = 0.5, z_m: float = 0.0) -> TriMesh:
    """A level square that faces up."""
    line = np.linspace(-half_m, half_m, cells + 1)
    x, y = np.meshgrid(line, line)
    n = cells + 1
    i = (np.arange(cells)[:, None] * n + np.arange(cells)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + n], 1), np.stack([i + 1, i + n + 1, i + n], 1)])
    return mesh(np.stack([x, y, np.full_like(x, z_m)], axis=-1).reshape(-1, 3), faces, albedo)


def box(centre, size, albedo: Albedo = 0.5) -> TriMesh:
    """A box with its own vertices for every side, facing out."""
    import trimesh

    solid = trimesh.creation.box(extents=size)
    solid.apply_translation(centre)
    return mesh(solid.vertices[solid.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3), albedo)


def sphere(centre, radius_m: float, subdivisions: int = 4, albedo: Albedo = 0.5) -> TriMesh:
    import trimesh

    solid = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius_m)
    return mesh(solid.vertices + np.asarray(centre), solid.faces, albedo)


def street() -> list[TriMesh]:
    """A ground with two boxes."""
    return [
        plane(15.0, 30, 0.4),
        box((-2.0, 1.0, 1.0), (2, 2, 2), (0.8, 0.3, 0.2)),
        box((2.5, 2.0, 2.0), (1, 3, 4), (0.2, 0.5, 0.7)),
    ]


def look_at(eye, target, up=(0.0, 0.0, 1.0)) -> RigidTransform:
    forward = np.asarray(target, float) - np.asarray(eye, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return RigidTransform.from_rotation("world", "camera", rotation, np.asarray(eye, float))


def camera(width: int = 64, height: int = 48, focal_px: float = 50.0) -> PinholeCamera:
    return PinholeCamera("test", width, height, focal_px, focal_px, width / 2, height / 2)


def constant_sky(radiance=(0.3, 0.5, 0.9), rows: int = 32) -> SkyDome:
    image = np.broadcast_to(np.asarray(radiance, dtype=np.float32), (rows, 2 * rows, 3)).copy()
    return SkyDome(image, None)


def sun_sky(azimuth_rad: float, elevation_deg: float, sky: float = 0.0, rows: int = 256) -> SkyDome:
    """A sun of irradiance pi (azimuth counter-clockwise from world +x) in a constant sky."""
    elevation = np.radians(elevation_deg)
    direction = np.array(
        [
            np.cos(azimuth_rad) * np.cos(elevation),
            np.sin(azimuth_rad) * np.cos(elevation),
            np.sin(elevation),
        ]
    )
    sun = Sun(direction, np.full(3, np.pi, np.float32))
    return add_sun(np.full((rows, 2 * rows, 3), sky, np.float32), sun)


def random_sky(rng: np.random.Generator, rows: int = 16) -> SkyDome:
    return SkyDome(rng.uniform(0, 1, (rows, 2 * rows, 3)).astype(np.float32), None)
