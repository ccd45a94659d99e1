"""Heading from GPS: exact on exact data, honest where the log says too little."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.frames import Trajectory
from lightsim.core.solar import azimuth_elevation
from lightsim.datasets.geo import GpsTrack, east_north_m, fit_heading, locate


def drive(length_m: float, n: int = 20) -> Trajectory:
    matrices = np.tile(np.eye(4), (n, 1, 1))
    matrices[:, 0, 3] = np.linspace(0, length_m, n)
    matrices[:, 1, 3] = 0.1 * length_m * np.linspace(0, 1, n) ** 2
    return Trajectory("world", "ego", np.arange(n, dtype=np.int64) * 10**8, matrices)


def track_of(ego: Trajectory, yaw_deg: float, noise_m: float, rng: np.random.Generator) -> GpsTrack:
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    enu = ego.positions_m[:, :2] @ np.array([[c, s], [-s, c]])
    enu = enu + noise_m * rng.standard_normal(enu.shape)
    latitude = 37.0 + enu[:, 1] / 110_983.0
    longitude = -122.0 + enu[:, 0] / (111_412.84 * np.cos(np.radians(37.0)))
    return GpsTrack(ego.times_ns, latitude, longitude)


def test_metres_east_and_north_match_wgs84() -> None:
    """One arc second at 37 degrees north: 30.828 m north, 24.752 m east (NGA tables)."""
    arc = 1 / 3600
    enu = east_north_m(np.array([37.0, 37.0 + arc]), np.array([180.0, -180.0 + arc]))
    np.testing.assert_allclose(enu[1], [24.74, 30.83], atol=0.02)


@pytest.mark.parametrize("yaw_deg", [-170.0, -0.3, 45.0, 179.9])
def test_the_rotation_comes_back(yaw_deg: float, rng: np.random.Generator) -> None:
    path = rng.standard_normal((50, 2)) * 10
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    fit = fit_heading(path, path @ np.array([[c, s], [-s, c]]) + [3.0, -4.0])
    assert np.degrees(fit.yaw_rad) == pytest.approx(yaw_deg, abs=1e-9)
    assert fit.residual_m < 1e-9


def test_locate_finds_north_with_its_residual(rng: np.random.Generator) -> None:
    ego = drive(40.0)
    geo, notes = locate(track_of(ego, 30.0, 0.02, rng), ego, 10**9, None)
    assert geo is not None
    assert geo.enu_from_world is not None
    assert np.degrees(geo.enu_from_world.yaw_rad) == pytest.approx(30.0, abs=0.2)
    assert geo.heading_origin == "gps track"
    assert geo.heading_residual_m == pytest.approx(0.028, abs=0.01)
    assert geo.heading_residual_deg is not None
    assert abs(np.degrees(geo.enu_from_world.yaw_rad) - 30.0) < 2 * geo.heading_residual_deg
    assert not notes


def test_a_log_that_stands_still_says_so(rng: np.random.Generator) -> None:
    ego = drive(1.0)
    geo, notes = locate(track_of(ego, 30.0, 0.02, rng), ego, 0, None)
    assert geo is not None
    assert geo.enu_from_world is None
    assert geo.heading_origin == "unknown"
    assert "--heading-deg" in notes[0]


def test_a_track_of_another_drive_is_not_believed(rng: np.random.Generator) -> None:
    ego = drive(40.0)
    geo, notes = locate(track_of(ego, 30.0, 20.0, rng), ego, 0, None)
    assert geo is not None
    assert geo.enu_from_world is None
    assert "disagree" in notes[0]


def test_without_gps_there_is_no_place() -> None:
    geo, notes = locate(None, drive(40.0), 0, 90.0)
    assert geo is None
    assert "no GPS" in notes[0]


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 200.0])
def test_a_given_heading_is_the_azimuth_of_world_x(
    heading_deg: float, rng: np.random.Generator
) -> None:
    ego = drive(1.0)
    geo, _ = locate(track_of(ego, 0.0, 0.0, rng), ego, 0, heading_deg)
    assert geo is not None
    assert geo.enu_from_world is not None
    assert geo.heading_origin == "given"
    x_enu = geo.enu_from_world.rotate(np.array([1.0, 0.0, 0.0]))
    assert azimuth_elevation(x_enu).azimuth_deg == pytest.approx(heading_deg, abs=1e-9)
