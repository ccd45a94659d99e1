"""What stands behind the street of an HDR panorama: its sky, and nothing of its own place."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import SkyDome, Sun, add_sun, split_sun
from lightsim.core.equirect import pixel_directions
from lightsim.core.frames import RigidTransform
from lightsim.core.solar import direction_enu
from lightsim.lighting.scenery import without_scenery
from lightsim.lighting.sky.clear_sky import clear_sky

ROWS = 128


def refused(*_: object) -> np.ndarray:
    raise AssertionError("nobody looks for scenery in a sky alone")


def place() -> tuple[SkyDome, np.ndarray, np.ndarray]:
    """A sky with structure over a rough skyline, a pole and rough ground; where scenery is, and the
    sky without it."""
    rng = np.random.default_rng(0)
    directions = pixel_directions(ROWS)
    azimuth = np.arctan2(directions[..., 1], directions[..., 0])
    elevation = np.degrees(np.arcsin(directions[..., 2]))
    sky = (0.5 + 0.2 * directions[..., 2] + 0.05 * np.sin(8 * azimuth))[..., None]
    sky = (sky * np.array([0.8, 0.9, 1.2])).astype(np.float32)
    scenery = elevation < 8.0 + 6.0 * np.sin(3 * azimuth)
    rough = rng.uniform(0.02, 0.15, (ROWS, 2 * ROWS, 1)).astype(np.float32)
    sun = Sun(direction_enu(40.0, 50.0), np.full(3, 3.0, np.float32))
    return add_sun(np.where(scenery[..., None], rough, sky), sun), scenery, sky


def matte_of(scenery: np.ndarray):
    """A matte that knows the truth."""

    def matte(picture: np.ndarray, camera: PinholeCamera, pose: RigidTransform) -> np.ndarray:
        rays = pose.rotate(camera.directions(camera.pixel_centres()))
        row = (np.arccos(np.clip(rays[..., 2], -1, 1)) / np.pi * ROWS).astype(int)
        turn = 0.5 - np.arctan2(rays[..., 1], rays[..., 0]) / (2 * np.pi)
        column = (turn * 2 * ROWS).astype(int) % (2 * ROWS)
        return (~scenery[np.minimum(row, ROWS - 1), column]).astype(np.float32)

    return matte


@pytest.mark.parametrize("turbidity", [2.0, 8.0])
def test_a_sky_alone_comes_back_unchanged(turbidity: float) -> None:
    dome = clear_sky(direction_enu(120.0, 20.0), turbidity, height_px=ROWS)
    behind, hidden = without_scenery(dome, refused)
    assert behind is dome
    assert hidden == 0.0


def test_a_place_goes_and_its_sky_stays_sharp() -> None:
    dome, scenery, sky = place()
    behind, hidden = without_scenery(dome, matte_of(scenery))
    assert hidden == pytest.approx(scenery[: ROWS // 2].mean(), abs=1e-5)
    directions = pixel_directions(ROWS)
    is_open = np.degrees(np.arcsin(directions[..., 2])) > 20.0
    np.testing.assert_array_equal(behind.radiance[is_open], dome.radiance[is_open])
    assert behind.sun is dome.sun
    # Down to the horizon it is the sky that the scenery hid, as smooth as it continues.
    rest = split_sun(behind)[0][: ROWS // 2]
    np.testing.assert_allclose(rest, sky[: ROWS // 2], rtol=0.2)
    assert np.abs(rest / sky[: ROWS // 2] - 1).mean() < 0.005


def test_a_pole_that_the_matte_misses_goes_with_what_it_stands_on() -> None:
    dome, scenery, sky = place()
    radiance = dome.radiance.copy()
    pole = np.zeros(scenery.shape, bool)
    pole[44:62, 100] = True
    lone = np.zeros(scenery.shape, bool)
    lone[10:20, 160] = True
    radiance[pole | lone] = 2.0
    behind, _ = without_scenery(SkyDome(radiance, dome.sun), matte_of(scenery))
    np.testing.assert_allclose(behind.radiance[pole], sky[pole], rtol=0.15)
    np.testing.assert_array_equal(behind.radiance[lone], radiance[lone])


def test_a_place_without_sky_is_left_as_it_is() -> None:
    dome, scenery, _ = place()
    behind, hidden = without_scenery(dome, matte_of(np.ones_like(scenery)))
    assert behind is dome
    assert hidden == 1.0
