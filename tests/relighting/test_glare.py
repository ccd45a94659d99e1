"""Sunlight that a lens scatters."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.dome import Sun
from lightsim.core.equirect import pixel_directions, solid_angles_sr
from lightsim.relighting.physical.glare import veiling_glare

FORWARD = np.array([1.0, 0.0, 0.0])


def sun_at(degrees: float) -> Sun:
    angle = np.radians(degrees)
    direction = np.array([np.cos(angle), 0.0, np.sin(angle)])
    return Sun(direction, np.array([3.0, 2.0, 1.0], np.float32))


def test_the_lens_scatters_the_fraction_that_is_asked_for() -> None:
    rays = pixel_directions(720)
    veil = veiling_glare(rays, FORWARD, sun_at(0.0), 0.5, 0.02)
    seen = (veil * solid_angles_sr(720)[..., None])[rays[..., 0] > 0].sum(0)
    np.testing.assert_allclose(seen, [0.03, 0.02, 0.01], rtol=0.02)


def test_it_is_strongest_at_the_sun_and_falls_with_the_angle_squared() -> None:
    angles = np.radians([0.0, 10.0, 20.0])
    rays = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=-1)[None]
    at, near, far = veiling_glare(rays, FORWARD, sun_at(0.0), 1.0, 0.02)[0, :, 0]
    assert near / far == pytest.approx(4, rel=0.01)
    assert at / near > 300


@pytest.mark.parametrize(("degrees", "visible"), [(91.0, 1.0), (180.0, 1.0), (10.0, 0.0)])
def test_a_sun_that_the_lens_does_not_see_scatters_nothing(degrees: float, visible: float) -> None:
    rays = pixel_directions(8)
    assert not veiling_glare(rays, FORWARD, sun_at(degrees), visible, 0.02).any()
