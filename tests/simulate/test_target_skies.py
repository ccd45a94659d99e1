"""Target skies of a log: the source's with its sun edited, and those of other logs."""

from __future__ import annotations

import numpy as np
import pytest
from tests.render.rendering_scenes import constant_sky, sun_sky
from tests.simulate.test_moving_shadow import is_dark, overlap, recorded, relit
from tests.tiny_world import TinyWorkspace, ground_points, in_shadow, on_ground, tiny_world

from lightsim.core.dome import split_sun
from lightsim.core.equirect import pixel_directions
from lightsim.core.sky_choice import SkyChoice
from lightsim.core.solar import angle_between_deg, azimuth_elevation, direction_enu
from lightsim.errors import InputError
from lightsim.simulate.skies import made_from_sky, resolve_sky

UP = np.array([0.0, 0.0, 1.0])
SKY = 0.15


def edited(work: TinyWorkspace, position: str, factor: float = 1.0):
    return resolve_sky(SkyChoice("source", move_sun=position, sun_factor=factor), work)


@pytest.mark.parametrize("factor", [0.0, 0.5, 3.0])
def test_an_edited_sun_adds_its_own_light_to_the_rest(factor: float) -> None:
    work = tiny_world(sun_sky(np.radians(30.0), 35.0, SKY))
    rest, sun = split_sun(work.sky.dome)
    assert sun is not None
    sky = edited(work, "200,50", factor)
    added = factor * sun.irradiance * np.sin(np.radians(50.0))
    level = np.full(3, np.pi * SKY) + added
    np.testing.assert_allclose(sky.dome.horizontal_irradiance(), level, rtol=1e-4)
    np.testing.assert_allclose(sky.facts["horizontal_irradiance"], level, rtol=1e-4)
    if not factor:
        np.testing.assert_array_equal(sky.dome.radiance, rest)
        return
    brightest = np.unravel_index(sky.dome.radiance.sum(axis=2).argmax(), rest.shape[:2])
    towards = pixel_directions(len(rest))[brightest]
    assert angle_between_deg(towards, direction_enu(200.0, 50.0)) < 0.6
    assert (sky.facts["azimuth_deg"], sky.facts["elevation_deg"]) == (200.0, 50.0)


def test_a_stronger_sun_alone_stays_where_it_is() -> None:
    work = tiny_world(sun_sky(np.radians(30.0), 35.0, SKY))
    sun = edited(work, "", 2.0).dome.sun
    before = split_sun(work.sky.dome)[1]
    assert sun is not None
    assert before is not None
    np.testing.assert_array_equal(sun.direction_world, before.direction_world)
    np.testing.assert_allclose(sun.irradiance, 2.0 * before.irradiance, rtol=1e-6)


def test_the_shadow_falls_away_from_the_moved_sun() -> None:
    """A sun in the azimuth A throws shadows to A + 180; the tiny world's x is taken as east."""
    work = recorded(sun_sky(np.radians(10.0), 40.0, SKY))
    sky = edited(work, "120,35").dome
    sun = direction_enu(120.0, 35.0)
    radiance, _ = relit(work, sky, 1)
    frame = work.log.frames[1]
    shadow = is_dark(radiance, sun) & on_ground(frame)
    assert overlap(shadow, in_shadow(frame, sun) & on_ground(frame)) > 0.9
    away = ground_points(frame)[shadow].mean(axis=0)  # The box stands at the origin.
    assert azimuth_elevation(away).azimuth_deg == pytest.approx(120.0 + 180.0, abs=8.0)


@pytest.mark.parametrize(
    ("position", "factor", "named"),
    [("10,-5", 1.0, "--move-sun"), ("10,0", 1.0, "--move-sun"), ("10", 1.0, "--move-sun"),
     ("a,b", 1.0, "--move-sun"), ("nan,5", 1.0, "--move-sun"), ("10,91", 1.0, "--move-sun"),
     ("", -1.0, "--sun-factor"), ("", np.nan, "--sun-factor"), ("", np.inf, "--sun-factor")],
)  # fmt: skip
def test_suns_that_cannot_be_are_named(position: str, factor: float, named: str) -> None:
    with pytest.raises(InputError, match=rf"{named}.*expected"):
        SkyChoice("source", move_sun=position, sun_factor=factor)


def test_a_sky_without_a_sun_has_none_to_move() -> None:
    work = tiny_world(constant_sky())
    with pytest.raises(InputError, match=r"--move-sun.*no sun"):
        edited(work, "120,35")


def test_an_edit_is_another_sky_to_artefacts() -> None:
    made = [
        made_from_sky(SkyChoice("source", move_sun=position, sun_factor=factor))
        for position in ("", "10,20", "10,21")
        for factor in (1.0, 2.0)
    ]
    assert all(a != b for i, a in enumerate(made) for b in made[:i])
