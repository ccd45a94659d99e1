"""Pixels, equirectangular directions, domes and solar azimuths agree with CONVENTIONS."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import linear_from_srgb8, srgb8_from_linear
from lightsim.core.dome import SkyDome, Sun, add_sun, find_sun, irradiance, resized, split_sun
from lightsim.core.equirect import (
    directions_from_uv,
    pixel_directions,
    sample_bilinear,
    solid_angles_sr,
    uv_from_directions,
)
from lightsim.core.solar import (
    angle_between_deg,
    azimuth_elevation,
    direction_enu,
    solar_position,
)
from lightsim.errors import InputError

CAMERA = PinholeCamera("front", 1920, 1080, 930.0, 931.0, 965.5, 463.5)


def test_project_inverts_directions() -> None:
    uv = CAMERA.pixel_centres()[::97, ::89].reshape(-1, 2)
    back, inside = CAMERA.project(CAMERA.directions(uv) * 7.0)
    np.testing.assert_allclose(back, uv, atol=1e-9)
    assert inside.all()


def test_points_behind_are_outside() -> None:
    uv, inside = CAMERA.project(np.array([[0.0, 0.0, -1.0]]))
    assert not inside.any()
    assert np.isnan(uv).all()


def test_scaling_keeps_directions() -> None:
    half = CAMERA.scaled(0.5)
    uv = np.array([[100.5, 700.25]])
    np.testing.assert_allclose(half.directions(uv / 2), CAMERA.directions(uv), atol=1e-12)


def test_all_srgb_codes_round_trip() -> None:
    codes = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(srgb8_from_linear(linear_from_srgb8(codes)), codes)


@given(st.floats(0.001, 0.999), st.floats(0.01, 0.99))
def test_equirect_round_trip(u: float, v: float) -> None:
    uv = np.array([[u, v]])
    np.testing.assert_allclose(uv_from_directions(directions_from_uv(uv)), uv, atol=1e-9)


def test_equirect_convention() -> None:
    """Centre column looks along +x; columns grow clockwise seen from above; row 0 is up."""
    np.testing.assert_allclose(directions_from_uv(np.array([0.5, 0.5])), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(directions_from_uv(np.array([0.75, 0.5])), [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(directions_from_uv(np.array([0.3, 0.0])), [0, 0, 1], atol=1e-12)


def test_solid_angles_cover_the_sphere() -> None:
    assert float(solid_angles_sr(64).sum() * 128) == pytest.approx(4 * np.pi)


def test_bilinear_reproduces_pixel_centres(rng: np.random.Generator) -> None:
    image = rng.random((8, 16, 3)).astype(np.float32)
    np.testing.assert_allclose(sample_bilinear(image, pixel_directions(8)), image, atol=1e-5)


def test_uniform_dome_gives_pi() -> None:
    dome = SkyDome(np.ones((64, 128, 3), np.float32), None)
    np.testing.assert_allclose(dome.horizontal_irradiance(), np.pi, rtol=1e-3)


def make_sunny(direction: np.ndarray, height: int = 128) -> SkyDome:
    sky = np.full((height, 2 * height, 3), 0.3, np.float32)
    return add_sun(sky, Sun(direction, np.array([4.0, 3.5, 3.0], np.float32)))


@pytest.mark.parametrize("height", [32, 128, 512])
def test_sun_energy_does_not_depend_on_resolution(height: int) -> None:
    direction = direction_enu(140.0, 35.0)
    dome = make_sunny(direction, height)
    rest, sun = split_sun(dome)
    assert sun is not None
    np.testing.assert_allclose(sun.irradiance, [4.0, 3.5, 3.0], rtol=1e-4)
    np.testing.assert_allclose(rest, 0.3, atol=1e-6)
    facing = irradiance(dome.radiance, direction) - irradiance(rest, direction)
    np.testing.assert_allclose(facing, [4.0, 3.5, 3.0], rtol=2e-3)


@given(st.floats(0, 359), st.floats(5, 80))
def test_a_sun_is_found_where_it_was_put(azimuth: float, elevation: float) -> None:
    direction = direction_enu(azimuth, elevation)
    found = find_sun(make_sunny(direction).radiance)
    assert found is not None
    assert angle_between_deg(found.direction_world, direction) < 0.8


def test_no_sun_in_an_overcast_sky() -> None:
    v = np.linspace(3, 1, 64, dtype=np.float32)[:, None, None]
    assert find_sun(np.broadcast_to(v, (64, 128, 3)).astype(np.float32)) is None


@given(st.floats(-720, 720))
def test_turning_keeps_energy_and_moves_the_sun(yaw: float) -> None:
    direction = direction_enu(140.0, 35.0)
    dome = make_sunny(direction, 64)
    turned = dome.rotated(yaw)
    np.testing.assert_allclose(
        turned.horizontal_irradiance(), dome.horizontal_irradiance(), rtol=1e-3
    )
    expected = direction_enu(140.0 - yaw, 35.0)
    assert turned.sun is not None
    assert angle_between_deg(turned.sun.direction_world, expected) < 1e-6
    found = find_sun(turned.radiance)
    assert found is not None
    assert angle_between_deg(found.direction_world, expected) < 1.5


@pytest.mark.parametrize("height", [40, 64, 300])
def test_resizing_keeps_energy(height: int) -> None:
    dome = make_sunny(direction_enu(20.0, 50.0))
    again = resized(dome, height)
    total, before = (
        (d.radiance * solid_angles_sr(d.height_px)[..., None]).sum((0, 1)) for d in (again, dome)
    )
    np.testing.assert_allclose(total, before, rtol=1e-3)
    assert again.radiance.shape == (height, 2 * height, 3)


@pytest.mark.parametrize("value", [-1.0, np.inf, np.nan])
def test_impossible_radiance_is_refused(value: float) -> None:
    radiance = np.ones((4, 8, 3), np.float32)
    radiance[1, 1] = value
    with pytest.raises(InputError, match="radiance"):
        SkyDome(radiance, None)


def test_sun_of_the_real_log_by_ephemeris() -> None:
    """San Francisco, 2019-05-11 01:59:16 UTC: azimuth 283.25, elevation 12.07 degrees."""
    position = solar_position(37.776, -122.399, 1557539956_500000000)
    assert position.azimuth_deg == pytest.approx(283.25, abs=0.05)
    assert position.elevation_deg == pytest.approx(12.07, abs=0.12)


@given(st.floats(0, 359.9), st.floats(-80, 80))
def test_azimuth_round_trip(azimuth: float, elevation: float) -> None:
    back = azimuth_elevation(direction_enu(azimuth, elevation))
    assert back.azimuth_deg == pytest.approx(azimuth, abs=1e-6)
    assert back.elevation_deg == pytest.approx(elevation, abs=1e-6)
