"""Heading from GPS: exact on exact data, honest where the log says too little."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lightsim.core.frames import Trajectory
from lightsim.core.reading import LogReading
from lightsim.core.solar import SolarPosition, azimuth_elevation
from lightsim.datasets.geo import GpsTrack, Located, east_north_m, fit_heading, locate
from lightsim.errors import InputError

READING = LogReading(source="drive")


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
    geo, notes = locate(Located(track_of(ego, 30.0, 0.02, rng)), ego, 10**9, READING)
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
    geo, notes = locate(Located(track_of(ego, 30.0, 0.02, rng)), ego, 0, READING)
    assert geo is not None
    assert geo.enu_from_world is None
    assert geo.heading_origin == "unknown"
    assert "--heading-deg" in notes[0]


def test_a_track_of_another_drive_is_not_believed(rng: np.random.Generator) -> None:
    ego = drive(40.0)
    geo, notes = locate(Located(track_of(ego, 30.0, 20.0, rng)), ego, 0, READING)
    assert geo is not None
    assert geo.enu_from_world is None
    assert "disagree" in notes[0]


def test_without_gps_nothing_is_known() -> None:
    geo, notes = locate(Located(), drive(40.0), 0, READING)
    assert geo is None
    assert "no GPS" in notes[0]


def test_a_heading_alone_orients_a_log_without_place() -> None:
    geo, notes = locate(Located(), drive(40.0), 0, replace(READING, heading_deg=90.0))
    assert geo is not None
    assert geo.place is None
    assert geo.heading_deg == pytest.approx(90.0)
    assert geo.sun_at(0) is None
    assert any("--place" in note for note in notes)


def test_given_place_and_time_determine_the_sun() -> None:
    """The sun of log 002 (test_pandaset.py), by options alone."""
    reading = replace(READING, place="37.776,-122.399", utc="2019-05-11T01:59:16", heading_deg=90.0)
    start_ns = 5 * 10**9
    recorded = Located(clock=None)
    geo, _ = locate(recorded, drive(40.0), start_ns, reading)
    assert geo is not None
    sun = geo.sun_at(start_ns)
    assert sun is not None
    assert (sun.azimuth_deg, sun.elevation_deg) == pytest.approx((283.25, 12.07), abs=0.1)
    # World +x is east: the direction in the world is that of frame enu.
    towards = geo.direction_at(start_ns)
    assert towards is not None
    assert azimuth_elevation(towards).azimuth_deg == pytest.approx(sun.azimuth_deg)


def test_a_given_sun_overrides_place_and_time(rng: np.random.Generator) -> None:
    ego = drive(40.0)
    reading = replace(READING, sun="120,35")
    geo, _ = locate(Located(track_of(ego, 30.0, 0.02, rng)), ego, 0, reading)
    assert geo is not None
    assert geo.sun_at(0) == SolarPosition(120.0, 35.0)
    assert geo.sun_std_deg == 1.0


@pytest.mark.parametrize(
    ("option", "text"),
    [
        ("place", "37.7"),
        ("place", "91,0"),
        ("place", "a,b"),
        ("sun", "120"),
        ("sun", "120,91"),
        ("sun", "nan,3"),
        ("utc", "yesterday"),
        ("utc", "1200-01-01"),
    ],
)
def test_a_wrong_option_is_one_error(option: str, text: str) -> None:
    with pytest.raises(InputError, match=f"--{option}"):
        replace(READING, **{option: text})


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 200.0])
def test_a_given_heading_is_the_azimuth_of_world_x(
    heading_deg: float, rng: np.random.Generator
) -> None:
    ego = drive(1.0)
    reading = replace(READING, heading_deg=heading_deg)
    geo, _ = locate(Located(track_of(ego, 0.0, 0.0, rng)), ego, 0, reading)
    assert geo is not None
    assert geo.enu_from_world is not None
    assert geo.heading_origin == "given"
    x_enu = geo.enu_from_world.rotate(np.array([1.0, 0.0, 0.0]))
    assert azimuth_elevation(x_enu).azimuth_deg == pytest.approx(heading_deg, abs=1e-9)
