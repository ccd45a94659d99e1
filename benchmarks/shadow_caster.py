"""Light on the ground around a ball: what an error of a sky does to a shadow."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from lightsim.core.dome import SkyDome, disc_directions, resized, split_sun
from lightsim.core.equirect import pixel_directions, solid_angles_sr

_BALL_RADIUS_M = 1.0
_PATCH_HALF_M = 4.0
_PATCH_POINTS = 33
_SKY_ROWS = 64
_DISC_POINTS = 64


def ground_points() -> Float[np.ndarray, "n 3"]:
    """A square patch of level ground, metres; a ball of 1 m radius rests on its middle."""
    line = np.linspace(-_PATCH_HALF_M, _PATCH_HALF_M, _PATCH_POINTS)
    x, y = np.meshgrid(line, line)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def caster_radiance(dome: SkyDome) -> Float[np.ndarray, "n 3"]:
    """Outgoing radiance of white ground (irradiance over pi) at `ground_points`, the ball black.

    The sun is a disc of its own, so that its shadow has a penumbra and no pixels.
    """
    sky, sun = split_sun(dome)
    sky = resized(SkyDome(sky, None), _SKY_ROWS).radiance if len(sky) != _SKY_ROWS else sky
    rows = _SKY_ROWS // 2
    directions = pixel_directions(_SKY_ROWS)[:rows].reshape(-1, 3)
    solid = np.repeat(solid_angles_sr(_SKY_ROWS)[:rows], 2 * _SKY_ROWS, axis=0)
    points = ground_points()
    open_fraction = ~_is_shadowed(points, directions) * directions[:, 2]
    total = open_fraction @ (sky[:rows].reshape(-1, 3).astype(np.float64) * solid)
    if sun is not None and sun.direction_world[2] > 0:
        disc = disc_directions(sun.direction_world, sun.angular_radius_deg, _DISC_POINTS)
        lit = (~_is_shadowed(points, disc)).mean(axis=1)
        total += lit[:, None] * sun.direction_world[2] * sun.irradiance
    return total / np.pi


def caster_rmse(predicted: SkyDome, truth: SkyDome, *, is_scale_free: bool = False) -> float:
    """RMSE of `caster_radiance` over the RMS of the truth; with the best common factor if
    scale-free."""
    a, b = caster_radiance(predicted), caster_radiance(truth)
    scale = float((a * b).sum() / max((a * a).sum(), 1e-12)) if is_scale_free else 1.0
    return float(np.sqrt(((scale * a - b) ** 2).sum() / (b * b).sum()))


def _is_shadowed(
    points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "m 3"]
) -> Bool[np.ndarray, "n m"]:
    """Which rays from the ground meet the ball."""
    centre = np.array([0.0, 0.0, _BALL_RADIUS_M]) - points
    along = centre @ directions.T
    squared = (centre**2).sum(axis=1)[:, None] - along**2
    return (along > 0) & (squared < _BALL_RADIUS_M**2)
