"""Returns of a LiDAR that turns on a roof and drives along x."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from lightsim.core.mesh import TriMesh
from lightsim.render.casters.embree import EmbreeCaster


def scanned(
    scene: TriMesh,
    step_deg: float,
    highest_deg: float,
    rings: int = 40,
    noise_m: float = 0.02,
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """Origins and ends of beams from seven places 1.9 m above the ground, in rings from 25 degrees
    below the horizon up to the highest, with noise along the beam."""
    caster, rng = EmbreeCaster([scene]), np.random.default_rng(0)
    angles_deg = np.arange(0, 360, step_deg), np.linspace(-25, highest_deg, rings)
    azimuth, elevation = (np.radians(a).ravel() for a in np.meshgrid(*angles_deg))
    flat = np.cos(elevation)
    way = np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)], axis=1)
    points, origins = [], []
    for x_m in np.arange(-6.0, 7.0, 2.0):
        origin = np.tile([x_m, 0.0, 1.9], (len(way), 1))
        hits = caster.intersect(origin, way)
        count = int(hits.is_hit.sum())
        distance = hits.distance_m[hits.is_hit] + noise_m * rng.normal(size=count)
        points.append(origin[hits.is_hit] + distance[:, None] * way[hits.is_hit])
        origins.append(origin[hits.is_hit])
    return np.concatenate(origins).astype(np.float32), np.concatenate(points).astype(np.float32)
