"""The ball's shadow falls away from the sun; closed forms of light on the ground."""

from __future__ import annotations

import numpy as np
from benchmarks.shadow_caster import caster_radiance, caster_rmse, ground_points

from lightsim.core.dome import SkyDome, Sun, add_sun


def sun_towards(azimuth_rad: float, elevation_rad: float) -> Sun:
    flat = np.cos(elevation_rad)
    direction = np.array(
        [flat * np.cos(azimuth_rad), flat * np.sin(azimuth_rad), np.sin(elevation_rad)]
    )
    return Sun(direction, np.full(3, 2.0, dtype=np.float32))


def black() -> np.ndarray:
    return np.zeros((64, 128, 3), dtype=np.float32)


def test_the_shadow_falls_at_the_suns_azimuth_plus_180_degrees() -> None:
    elevation = np.radians(40.0)
    for azimuth in np.radians([0.0, 77.0, 200.0]):
        light = caster_radiance(add_sun(black(), sun_towards(float(azimuth), float(elevation))))
        points = ground_points()
        dark = points[light[:, 0] < 0.5 * light[:, 0].max()].mean(axis=0)
        # The ball's centre, 1 m up, casts its shadow 1 / tan(elevation) away.
        expected = -np.array([np.cos(azimuth), np.sin(azimuth)]) / np.tan(elevation)
        np.testing.assert_allclose(dark[:2], expected, atol=0.1)
        np.testing.assert_allclose(light.max(), 2.0 * np.sin(elevation) / np.pi, rtol=1e-6)


def test_under_an_even_sky_far_ground_is_as_bright_as_the_sky() -> None:
    even = SkyDome(np.ones((64, 128, 3), dtype=np.float32), None)
    light = caster_radiance(even)[:, 0]
    points = ground_points()
    far = np.linalg.norm(points, axis=1) > 5.0
    # A ball of radius r whose centre is at distance d hides sin^2 = r^2 / d^2 of the sphere of
    # cosine-weighted directions, times the cosine towards it.
    distance = np.linalg.norm(np.array([0.0, 0.0, 1.0]) - points[far], axis=1)
    hidden = (1.0 / distance) ** 2 * (1.0 / distance)
    np.testing.assert_allclose(light[far], 1.0 - hidden, atol=0.01)


def test_errors_know_scale() -> None:
    truth = add_sun(np.full((64, 128, 3), 0.1, dtype=np.float32), sun_towards(1.0, 0.6))
    assert caster_rmse(truth, truth) == 0.0
    double = truth.scaled(2.0)
    np.testing.assert_allclose(caster_rmse(double, truth), 1.0, rtol=1e-5)
    assert caster_rmse(double, truth, is_scale_free=True) < 1e-6
