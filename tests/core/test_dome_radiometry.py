"""Light of sky domes: where the sun's energy lies, and what turning and resizing keep."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lightsim.core.dome import SkyDome, Sun, add_sun, find_sun, irradiance, resized, split_sun
from lightsim.core.equirect import cosine_weights_sr, pixel_directions, solid_angles_sr
from lightsim.core.resample import resize_sphere

UP = np.array([0.0, 0.0, 1.0])
ENERGY = np.array([5.0, 4.5, 3.5], np.float32)
HEIGHTS = [16, 32, 37, 100, 128, 512]
azimuths = st.floats(-np.pi, np.pi)
heights_z = st.floats(-0.999, 0.999)


def direction(azimuth: float, z: float) -> np.ndarray:
    level = np.sqrt(1 - z * z)
    return np.array([level * np.cos(azimuth), level * np.sin(azimuth), z])


def smooth_sky(height: int) -> np.ndarray:
    """Bright towards +x and the horizon, with a dark ground: exactly the case of a street."""
    way = pixel_directions(height)
    sky = 0.4 + 0.3 * way[..., :1] + 0.3 * (1 - way[..., 2:3]) * np.array([1.0, 0.8, 0.5])
    return np.where(way[..., 2:3] > 0, sky, 0.05).astype(np.float32)


def sunny(azimuth: float, z: float, height: int = 64) -> SkyDome:
    return add_sun(smooth_sky(height), Sun(direction(azimuth, z), ENERGY))


def energy_of(dome: SkyDome) -> np.ndarray:
    weight = solid_angles_sr(dome.height_px)[..., None]
    return (dome.radiance.astype(np.float64) * weight).sum((0, 1))


@pytest.mark.parametrize("height", [1, 2, 15, 16, 127, 128, 300])
def test_an_even_sky_gives_pi_at_any_height(height: int) -> None:
    """Both for a surface that looks up and for a tilted one."""
    assert cosine_weights_sr(height, UP).sum() == pytest.approx(np.pi, rel=2e-4)
    assert cosine_weights_sr(height, direction(0.3, 0.4)).sum() == pytest.approx(np.pi, rel=2e-4)


@settings(deadline=None)
@given(azimuths, st.floats(0.02, 0.98), azimuths, heights_z)
def test_a_known_sun_shines_from_its_own_direction(
    azimuth: float, z: float, normal_azimuth: float, normal_z: float
) -> None:
    normal = direction(normal_azimuth, normal_z)
    for height in (16, 128):
        dome = sunny(azimuth, z, height)
        cosine = max(0.0, float(direction(azimuth, z) @ normal))
        expected = irradiance(smooth_sky(height), normal) + cosine * ENERGY
        assert_allclose(dome.irradiance(normal), expected, rtol=1e-4, atol=1e-4)


@given(azimuths, st.floats(0.05, 0.98), azimuths, heights_z, st.floats(-400, 400))
def test_turning_turns_the_irradiance_of_every_normal(
    azimuth: float, z: float, normal_azimuth: float, normal_z: float, yaw_deg: float
) -> None:
    dome = sunny(azimuth, z)
    turned = dome.rotated(yaw_deg)
    before = dome.irradiance(direction(normal_azimuth, normal_z))
    after = turned.irradiance(direction(normal_azimuth + np.radians(yaw_deg), normal_z))
    assert_allclose(after, before, rtol=1e-3, atol=1e-3)
    assert_allclose(energy_of(turned), energy_of(dome), rtol=1e-5)


def test_no_turn_leaves_every_pixel() -> None:
    dome = sunny(0.3, 0.5)
    for yaw_deg in (0.0, 360.0, -1e-12):
        np.testing.assert_array_equal(dome.rotated(yaw_deg).radiance, dome.radiance)


@given(azimuths, st.floats(0.05, 0.98), st.floats(-400, 400))
@example(0.0, 0.05078125, 90.0)
def test_turning_does_not_smear_the_disc(azimuth: float, z: float, yaw_deg: float) -> None:
    """The turned dome equals the one whose sun was put at the turned azimuth at once."""
    even = np.full((64, 128, 3), 0.3, np.float32)
    turned = add_sun(even, Sun(direction(azimuth, z), ENERGY)).rotated(yaw_deg)
    assert turned.sun is not None
    at_once = add_sun(even, turned.sun)
    wanted = direction(azimuth + np.radians(yaw_deg), z)
    assert_allclose(turned.sun.direction_world, wanted, atol=1e-12)
    # The spiral of points in the disc turns differently near the pole: a few change pixels.
    difference = (turned.radiance - at_once.radiance) * solid_angles_sr(64)[..., None]
    assert np.abs(difference).sum() < 0.02 * ENERGY.sum()


@given(azimuths, st.floats(0.1, 0.95))
def test_sun_and_sky_add_up_to_the_dome(azimuth: float, z: float) -> None:
    dome = sunny(azimuth, z)
    sky, sun = split_sun(dome)
    assert sun is not None
    assert_allclose(energy_of(SkyDome(sky, None)) + sun.irradiance, energy_of(dome), rtol=1e-6)
    assert_allclose(sun.irradiance, ENERGY, rtol=0.01)
    level = irradiance(sky, UP) + sun.irradiance * z
    assert_allclose(level, dome.horizontal_irradiance(), rtol=1e-3)


@settings(max_examples=10, deadline=None)
@given(azimuths, st.floats(0.1, 0.95))
def test_resizing_keeps_level_light_energy_and_the_sun(azimuth: float, z: float) -> None:
    dome = sunny(azimuth, z, 128)
    for height in HEIGHTS:
        again = resized(dome, height)
        assert_allclose(again.horizontal_irradiance(), dome.horizontal_irradiance(), rtol=1e-3)
        assert_allclose(again.irradiance(-UP), dome.irradiance(-UP), rtol=1e-3)
        assert_allclose(energy_of(again), energy_of(dome), rtol=1e-4)
        assert again.sun is not None
        assert_allclose(again.sun.direction_world, direction(azimuth, z), atol=1e-9)


def test_resizing_keeps_the_light_of_a_sun_that_nobody_named() -> None:
    dome = SkyDome(sunny(0.7, 0.5, 128).radiance, None)
    for height in HEIGHTS:
        again = resized(dome, height)
        for normal in (UP, direction(0.7, 0.0), direction(-2.0, 0.3)):
            assert_allclose(again.irradiance(normal), dome.irradiance(normal), rtol=5e-3)
        found = find_sun(again.radiance)
        assert found is not None
        assert_allclose(found.irradiance, ENERGY, rtol=0.1)


@pytest.mark.parametrize("height", [7, 16, 33, 64])
def test_shrinking_keeps_the_energy_of_regions(height: int, rng: np.random.Generator) -> None:
    """Noise, because only exact areas keep its sums."""
    noise = rng.random((64, 128, 3)).astype(np.float32)
    small = resize_sphere(noise, height)
    assert small.shape == (height, 2 * height, 3)
    sums = [(x * solid_angles_sr(len(x))[..., None]).sum((0, 1)) for x in (noise, small)]
    assert_allclose(sums[1], sums[0], rtol=1e-6)
    assert small.min() >= noise.min()
    assert small.max() <= noise.max()
