"""The shipped lighting networks: what must hold for any good weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lightsim.core.colour import luminance, srgb_from_linear
from lightsim.core.dome import find_sun
from lightsim.core.equirect import pixel_directions
from lightsim.core.solar import angle_between_deg, azimuth_elevation, direction_enu
from lightsim.core.twin import Panorama
from lightsim.lighting.sky import predict
from lightsim.lighting.sky.clear_sky import clear_sky
from lightsim.lighting.sky.estimate import SkyConfig
from lightsim.lighting.sky.image_sky import (
    edited_sky,
    estimate_from_picture,
    panorama_from_image,
)
from lightsim.lighting.sky.predict import decoded_dome, decoded_sky, predict_sky
from lightsim.lighting.sun.direction import SunDirection

HEIGHT_PX = 64


def clear_picture(sun_azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """8-bit picture of a clear sky over grey ground."""
    direction = direction_enu(sun_azimuth_deg, elevation_deg)
    dome = clear_sky(direction, height_px=HEIGHT_PX)
    level = np.median(dome.radiance[: HEIGHT_PX // 2])
    ldr = srgb_from_linear(np.clip(0.4 * dome.radiance / level, 0.0, 1.0).astype(np.float32))
    ldr[HEIGHT_PX // 2 :] = 0.4
    return np.round(ldr * 255).astype(np.uint8)


def seen_by_cameras() -> np.ndarray:
    elevation = np.degrees(np.arcsin(pixel_directions(HEIGHT_PX)[..., 2]))
    return elevation < 40.0


@pytest.fixture(scope="module")
def panorama() -> Panorama:
    return panorama_from_image(clear_picture(20.0, 25.0), seen_by_cameras(), HEIGHT_PX)


def test_visible_sun_is_found_and_turns_with_the_picture(panorama: Panorama) -> None:
    predicted = predict_sky(panorama)
    towards = predicted.sun_direction.astype(np.float64)
    assert predicted.sunny_probability > 0.5
    found = azimuth_elevation(towards).azimuth_deg
    assert abs(found - 20.0) < 15.0
    quarter = panorama_from_image(
        np.roll(clear_picture(20.0, 25.0), 32, axis=1), seen_by_cameras(), HEIGHT_PX
    )
    turned = predict_sky(quarter).sun_direction.astype(np.float64)
    # Rolling the columns by a quarter turns the world clockwise: (x, y) -> (y, -x).
    assert angle_between_deg(turned, np.array([towards[1], -towards[0], towards[2]])) < 0.5


def test_the_prediction_depends_on_what_was_seen_alone(
    panorama: Panorama, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise AssertionError("inpainting is no part of the estimate")

    monkeypatch.setattr(predict, "completed_ldr", refused)
    unseen = ~panorama.is_seen
    assert unseen.any()
    radiance = panorama.radiance + np.float32(5) * unseen[..., None]
    other = replace(panorama, radiance=radiance.astype(np.float32))
    a, b = predict_sky(panorama), predict_sky(other)
    assert (a.sun_direction == b.sun_direction).all()
    assert a.log_peak == b.log_peak


def test_the_decoded_sky_has_a_moved_sun(panorama: Panorama) -> None:
    there = direction_enu(140.0, 35.0)
    dome = decoded_dome(panorama, sun_direction=there)
    found = find_sun(dome.radiance)
    assert found is not None
    assert dome.sun is not None
    # Half the diagonal of a pixel of 2.8 degrees.
    assert angle_between_deg(found.direction_world, there) < 2.0


def test_the_decoders_sky_has_the_sun_that_gps_tells(panorama: Panorama) -> None:
    towards = direction_enu(60.0, 30.0)
    sun = SunDirection(towards, 60.0, 30.0, "gps+time", 0.1)
    prediction = predict_sky(panorama)
    sky = decoded_sky(panorama, sun, prediction, 128)
    assert sky.dome.sun is not None
    assert angle_between_deg(sky.dome.sun.direction_world, towards) < 1e-3
    brightest = np.unravel_index(sky.dome.radiance.sum(axis=2).argmax(), (128, 256))
    assert angle_between_deg(pixel_directions(128)[brightest], towards) < 2.0
    level = sky.sky_irradiance + 0.5 * sky.dome.sun.irradiance
    np.testing.assert_allclose(level, sky.dome.horizontal_irradiance(), rtol=0.02)
    # f_int: the peak that the encoder read off, times the solid angle of its pixel of 64 rows.
    peak = luminance(decoded_dome(panorama, sun_direction=towards).radiance).max()
    assert np.log(peak) == pytest.approx(prediction.log_peak, abs=0.05)
    assert "sky-small" in sky.notes[-1]


def test_edits_of_an_estimated_picture(panorama: Panorama) -> None:
    picture, seen = clear_picture(20.0, 25.0), seen_by_cameras()
    estimate = estimate_from_picture(
        panorama_from_image(picture, seen),
        None,
        SkyConfig(height_px=HEIGHT_PX),
        predict_sky(panorama),
    )
    moved = edited_sky(estimate, (300.0, 50.0), 1.0, 120.0)
    assert (moved.sun_azimuth_deg, moved.sun_elevation_deg) == (300.0, 50.0)
    assert moved.dome.sun is not None
    # 180 degrees clockwise from the centre column, which looks along +x.
    expected = direction_enu(90.0 + 180.0, 50.0)
    assert angle_between_deg(moved.dome.sun.direction_world, expected) < 1e-3
    level = moved.sky_irradiance + moved.dome.sun.irradiance * np.sin(np.radians(50.0))
    np.testing.assert_allclose(level, moved.dome.horizontal_irradiance(), rtol=1e-3)
