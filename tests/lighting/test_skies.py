"""Clear and overcast skies, sun directions, target forms, the picture's sky."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from lightsim.core.colour import luminance, srgb8_from_linear
from lightsim.core.dome import SkyDome, Sun, add_sun, split_sun
from lightsim.core.equirect import pixel_directions
from lightsim.core.frames import RigidTransform
from lightsim.core.log import Clock, GeoReference, Place
from lightsim.core.solar import angle_between_deg, direction_enu
from lightsim.core.twin import Panorama
from lightsim.errors import InputError
from lightsim.lighting.sky.clear_sky import clear_sky, clear_sky_parts
from lightsim.lighting.sky.estimate import SkyConfig, estimate_sky
from lightsim.lighting.sky.image_sky import estimate_from_picture, panorama_from_image
from lightsim.lighting.sun.direction import (
    SunDirection,
    find_sun_blob,
    sun_from_geo,
)
from lightsim.lighting.target_sky import dome_from_array, scale_to_source

UP = np.array([0.0, 0.0, 1.0])


def _geo(yaw_rad: float | None) -> GeoReference:
    turn = (
        None if yaw_rad is None else RigidTransform.from_yaw("enu", "world", yaw_rad, np.zeros(3))
    )
    return GeoReference(Place(37.7749, -122.4194), Clock(), turn, "given", 0.1)


def test_a_clear_sky_is_symmetric_about_the_sun_and_redder_when_low():
    forward = np.array([np.cos(0.7), 0.0, np.sin(0.7)])
    radiance, sun = clear_sky_parts(forward, 3.0, 0.2, 64)
    np.testing.assert_allclose(radiance, radiance[:, ::-1], rtol=1e-4, atol=1e-6)
    assert (radiance[:32] > 0).all()
    low = clear_sky_parts(np.array([np.cos(0.05), 0.0, np.sin(0.05)]), 3.0, 0.2, 16)[1]
    assert low.irradiance[0] / low.irradiance[1] > sun.irradiance[0] / sun.irradiance[1]
    assert low.irradiance.sum() < 0.5 * sun.irradiance.sum()


def test_scene_units_a_white_level_surface_has_luminance_one_at_45_degrees():
    dome = clear_sky(direction_enu(200.0, 45.0), height_px=128)
    assert luminance(dome.horizontal_irradiance()) / np.pi == pytest.approx(1.0, abs=0.01)
    assert dome.sun is not None
    level_sun = dome.sun.irradiance * dome.sun.direction_world[2]
    ratio = luminance(level_sun) / luminance(dome.horizontal_irradiance() - level_sun)
    assert 2.5 < ratio < 6.0


def test_turning_a_sky_keeps_its_energy():
    dome = clear_sky(direction_enu(100.0, 30.0), height_px=64)
    turned = dome.rotated(37.3)
    np.testing.assert_allclose(
        turned.horizontal_irradiance(), dome.horizontal_irradiance(), rtol=1e-4
    )


@pytest.mark.parametrize("turbidity", [0.5, 11.0])
def test_turbidity_out_of_range_is_refused(turbidity: float):
    with pytest.raises(InputError, match="turbidity"):
        clear_sky(direction_enu(0.0, 40.0), turbidity)


def test_twilight_is_refused():
    with pytest.raises(InputError, match="below the horizon"):
        clear_sky(direction_enu(0.0, -1.0))


def test_the_sun_of_log_002_and_its_turn_into_the_world():
    time_ns = int(datetime(2019, 5, 11, 1, 59, 16, tzinfo=UTC).timestamp()) * 10**9
    sun = sun_from_geo(_geo(0.0), time_ns)
    assert angle_between_deg(sun.direction_world, direction_enu(283.25, 12.07)) < 0.1
    turned = sun_from_geo(_geo(0.5), time_ns)
    back = RigidTransform.from_yaw("enu", "world", 0.5, np.zeros(3)).rotate(turned.direction_world)
    np.testing.assert_allclose(back, sun.direction_world, atol=1e-12)
    assert turned.azimuth_deg == sun.azimuth_deg
    with pytest.raises(InputError, match="--heading-deg"):
        sun_from_geo(_geo(None), time_ns)


def _picture(dome: SkyDome, height_px: int = 128) -> Panorama:
    """What ideal cameras see of a dome: its upper half, saturated at 1."""
    radiance = np.minimum(dome.radiance, 1.0)
    is_sky = pixel_directions(height_px)[..., 2] > 0
    return Panorama(radiance, np.ones_like(is_sky), is_sky, (radiance >= 1.0).any(-1) & is_sky)


def test_a_clipped_spot_is_found_across_the_seam_and_wide_clouds_are_not():
    direction = np.array([-np.cos(0.5), 0.0, np.sin(0.5)])
    cosine = pixel_directions(128) @ direction
    radiance = np.full((128, 256, 3), 0.3, np.float32)
    radiance[cosine > np.cos(np.radians(4.0))] = 1.5
    blob = find_sun_blob(_picture(SkyDome(radiance, None)))
    assert blob is not None
    assert angle_between_deg(blob.direction_world, direction) < 0.3
    assert blob.radius_deg == pytest.approx(4.0, abs=0.5)
    radiance[cosine > np.cos(np.radians(40.0))] = 1.5
    assert find_sun_blob(_picture(SkyDome(radiance, None))) is None


def test_the_dome_of_a_partly_seen_clear_sky_matches_the_truth():
    direction = direction_enu(250.0, 40.0)
    truth = clear_sky(direction, 3.0, height_px=128).scaled(0.6)
    panorama = _picture(truth)
    seen = (pixel_directions(128)[..., 2] < np.sin(np.radians(40.0))) & (
        pixel_directions(128)[..., 1] > -0.8
    )
    panorama = Panorama(
        panorama.radiance * seen[..., None],
        seen,
        panorama.is_sky & seen,
        panorama.is_clipped & seen,
    )
    sun = SunDirection(direction, 250.0, 40.0, "gps+time", 0.1)
    sky, _ = estimate_sky(panorama, sun, SkyConfig(height_px=128))
    _, true_sun = split_sun(truth)
    assert true_sun is not None
    expected = truth.horizontal_irradiance() - true_sun.irradiance * direction[2]
    np.testing.assert_allclose(sky.sky_irradiance, expected, rtol=0.08)
    assert sky.dome.sun is not None
    assert truth.sun is not None
    np.testing.assert_allclose(sky.dome.sun.irradiance, truth.sun.irradiance, rtol=0.15)
    level_sun = sky.dome.sun.irradiance * direction[2]
    np.testing.assert_allclose(
        sky.dome.horizontal_irradiance(), sky.sky_irradiance + level_sun, rtol=0.02
    )


def test_a_picture_alone_gives_a_sky():
    truth = clear_sky(direction_enu(80.0, 50.0), 3.0, height_px=64).scaled(0.5)
    picture = panorama_from_image(srgb8_from_linear(truth.radiance), None)
    sky = estimate_from_picture(picture, None, SkyConfig(height_px=64))
    assert sky.origin == "image"
    assert sky.sun_azimuth_deg is None
    assert sky.dome.sun is not None
    assert angle_between_deg(sky.dome.sun.direction_world, direction_enu(80.0, 50.0)) < 5.0


def test_scaling_to_the_source():
    source = clear_sky(direction_enu(0.0, 30.0), height_px=32).scaled(0.4)
    dome = clear_sky(direction_enu(90.0, 60.0), height_px=32)
    scaled, factor = scale_to_source(dome, source, "auto")
    assert luminance(scaled.horizontal_irradiance()) == pytest.approx(
        float(luminance(source.horizontal_irradiance())), rel=1e-4
    )
    assert scaled.sun is not None
    assert dome.sun is not None
    assert scaled.sun.irradiance[0] == pytest.approx(dome.sun.irradiance[0] * factor, rel=1e-5)
    assert scale_to_source(dome, None, "none")[1] == 1.0
    assert scale_to_source(dome, None, 2.5)[1] == 2.5
    for mode in ("auto", -1.0):
        with pytest.raises(InputError):
            scale_to_source(dome, None, mode)


def test_files_become_domes_with_their_sun():
    direction = direction_enu(33.0, 44.0)
    image = add_sun(
        np.full((64, 128, 3), 0.2, np.float32), Sun(direction, np.full(3, 5.0, np.float32))
    ).radiance
    dome = dome_from_array(image, "a.hdr")
    assert dome.sun is not None
    assert angle_between_deg(dome.sun.direction_world, direction) < 1.5
    for bad in (image[:, :100], image[:, :-1], image * np.nan, image - 1.0):
        with pytest.raises(InputError, match=r"a\.hdr"):
            dome_from_array(bad.astype(np.float32), "a.hdr")
