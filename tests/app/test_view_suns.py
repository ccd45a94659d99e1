"""The sun of a state, and the sky after its sun was dragged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.render.rendering_scenes import constant_sky, sun_sky

from lightsim.app.suns import direction_of, position_of, sun_of, turbidity_of, with_dragged_sun
from lightsim.core.dome import SkyDome
from lightsim.core.frames import RigidTransform
from lightsim.core.log import GeoReference
from lightsim.core.sky_choice import SkyChoice
from lightsim.core.solar import SolarPosition
from lightsim.core.twin import SkyEstimate


def turned(north_deg: float) -> GeoReference:
    """A log whose axis +x points `north_deg` counter-clockwise of east."""
    c, s = np.cos(np.radians(north_deg)), np.sin(np.radians(north_deg))
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    north = RigidTransform.from_rotation("enu", "world", rotation, np.zeros(3))
    return GeoReference(None, None, north, "given", None)


def estimate(dome: SkyDome) -> SkyEstimate:
    return SkyEstimate(dome, None, 0.0, "image", 0.0, 0.0, np.zeros(3, np.float32), 0.0)


@given(
    azimuth_deg=st.floats(0.0, 359.9),
    elevation_deg=st.floats(1.0, 89.0),
    north=st.floats(-180, 180),
)
def test_direction_and_position_are_inverse(
    azimuth_deg: float, elevation_deg: float, north: float
) -> None:
    for geo in (None, turned(north)):
        direction = direction_of(SolarPosition(azimuth_deg, elevation_deg), geo)
        assert np.linalg.norm(direction) == pytest.approx(1.0)
        found = position_of(direction, geo)
        turn = (found.azimuth_deg - azimuth_deg + 180.0) % 360.0 - 180.0
        assert turn == pytest.approx(0.0, abs=1e-6)
        assert found.elevation_deg == pytest.approx(elevation_deg, abs=1e-6)


def test_azimuth_is_clockwise_from_true_north() -> None:
    east = direction_of(SolarPosition(90.0, 0.0), None)
    np.testing.assert_allclose(east, [1.0, 0.0, 0.0], atol=1e-12)
    # The axis +x of this log points to the north.
    north = direction_of(SolarPosition(0.0, 0.0), turned(90.0))
    np.testing.assert_allclose(north, [1.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("sky", "dragged"),
    [
        # The recorded sky and a time become a clear sky; a clear sky keeps its words.
        (SkyChoice("source"), SkyChoice("sun:200.0,30.0,4")),
        (SkyChoice("time:2026-06-21T12:00:00Z"), SkyChoice("sun:200.0,30.0,4")),
        (SkyChoice("sun:10,20,2.5"), SkyChoice("sun:200.0,30.0,4")),
        (SkyChoice("source", move_sun="10,20"), SkyChoice("sun:200.0,30.0,4")),
        (SkyChoice("sun:10,20", sun_factor=0.5), SkyChoice("sun:200.0,30.0,4", sun_factor=0.5)),
        # The sun of a file moves in the file.
        (SkyChoice("noon.hdr", yaw_deg=5.0), SkyChoice("noon.hdr", 5.0, move_sun="200.0,30.0")),
    ],
)
def test_dragging_moves_the_sun_of_a_file_and_makes_other_skies_clear(
    sky: SkyChoice, dragged: SkyChoice
) -> None:
    assert with_dragged_sun(sky, SolarPosition(200.0, 30.0), 4.0) == dragged


@pytest.mark.parametrize("sky", ["source", "noon.hdr"])
def test_the_shown_sun_is_where_it_was_dragged(sky: str) -> None:
    recorded = estimate(sun_sky(0.3, 50.0))
    dragged = with_dragged_sun(SkyChoice(sky), SolarPosition(361.26, 30.04), 3.0)
    found = sun_of(dragged, None, recorded)
    assert found is not None
    assert found.azimuth_deg == pytest.approx(1.3)
    assert found.elevation_deg == pytest.approx(30.0)


@pytest.mark.parametrize(("elevation_deg", "words"), [(-20.0, "1.0"), (95.0, "90.0")])
def test_the_dragged_sun_stays_above_the_horizon(elevation_deg: float, words: str) -> None:
    sky = with_dragged_sun(SkyChoice("source"), SolarPosition(10.0, elevation_deg), 3.0)
    assert sky.sky == f"sun:10.0,{words},3"


def test_the_recorded_sun_is_that_of_the_estimated_sky() -> None:
    found = sun_of(SkyChoice("source"), None, estimate(sun_sky(0.0, 40.0)))
    assert found is not None
    assert found.azimuth_deg == pytest.approx(90.0)  # world +x is assumed to be east
    assert found.elevation_deg == pytest.approx(40.0)
    assert sun_of(SkyChoice("source"), None, estimate(constant_sky())) is None


def test_the_sun_of_a_file_is_unknown_until_it_is_moved() -> None:
    source, file = estimate(sun_sky(0.0, 40.0)), SkyChoice("noon.hdr")
    assert sun_of(file, None, source) is None
    moved = sun_of(replace(file, move_sun="10,20"), None, source)
    assert moved == SolarPosition(10.0, 20.0)


def test_turbidity_is_that_of_the_words() -> None:
    assert turbidity_of(SkyChoice("sun:10,20,2.5")) == 2.5
    assert turbidity_of(SkyChoice("source")) == turbidity_of(SkyChoice("sun:10,20")) == 3.0
