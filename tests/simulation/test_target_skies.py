"""Target skies of a log: the source's with its sun edited, and those of other logs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from tests.lighting.test_night import street_of_lamps
from tests.render.rendering_scenes import constant_sky, sun_sky
from tests.simulation.test_moving_shadow import is_dark, recorded, relit
from tests.tiny_world import (
    TinyWorkspace,
    ground_points,
    in_shadow,
    on_ground,
    overlap,
    tiny_world,
)

from lightsim.core import dome as dome_module
from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome, split_sun
from lightsim.core.equirect import pixel_directions
from lightsim.core.frames import RigidTransform
from lightsim.core.log import Clock, GeoReference, Place
from lightsim.core.sky_choice import SkyChoice
from lightsim.core.solar import angle_between_deg, azimuth_elevation, direction_enu
from lightsim.errors import InputError
from lightsim.simulation.scene_luminance import SceneLuminance
from lightsim.simulation.skies import made_from_sky, parse_sky, resolve_sky, sky_without_log
from lightsim.store.images import write_exr
from lightsim.store.sky import write_sky

UP = np.array([0.0, 0.0, 1.0])
SKY = 0.15


def facing(work: TinyWorkspace, heading_deg: float | None) -> TinyWorkspace:
    """The same log with its world's +x at an azimuth, or nobody knows where."""
    if heading_deg is None:
        return work
    turn = RigidTransform.from_yaw("enu", "world", np.radians(90.0 - heading_deg), np.zeros(3))
    geo = GeoReference(Place(48.0, 11.0), Clock(), turn, "given", None)
    work.__dict__["log"] = replace(work.log, geo=geo)
    return work


def write(work: TinyWorkspace, dome: SkyDome, folder: Path) -> Path:
    """The dome as a build of the log would write it."""
    geo = work.log.geo
    write_sky(folder, replace(work.sky, dome=dome), None if geo is None else geo.heading_deg)
    return folder / "source.exr"


def edited(work: TinyWorkspace, position: str, factor: float = 1.0):
    return resolve_sky(SkyChoice("source", move_sun=position, sun_factor=factor), work)


def at(latitude_deg: float, longitude_deg: float, yaw_rad: float) -> TinyWorkspace:
    """A log at a place on Earth."""
    work = tiny_world(constant_sky())
    turn = RigidTransform.from_yaw("enu", "world", yaw_rad, np.zeros(3))
    geo = GeoReference(Place(latitude_deg, longitude_deg), Clock(), turn, "given", None)
    work.__dict__["log"] = replace(work.log, geo=geo)
    return work


def test_forms_place_the_sun() -> None:
    work = at(-33.9, 18.4, 0.3)
    sky = resolve_sky(SkyChoice("sun:120,35", scale="none"), work)
    assert sky.sun is not None
    assert sky.facts.turbidity == 3.0
    assert work.log.geo is not None
    assert work.log.geo.enu_from_world is not None
    in_enu = work.log.geo.enu_from_world.rotate(sky.sun.direction_world)
    assert angle_between_deg(in_enu, direction_enu(120.0, 35.0)) < 1e-3
    assert "heading" in str(sky_without_log(SkyChoice("sun:10,20,5")).facts.assumed)


def test_a_time_after_sunset_is_refused_by_its_name() -> None:
    work = at(37.0, -122.0, 0.0)
    with pytest.raises(InputError, match=r"time:2019-05-11T08:00:00Z.*below the horizon"):
        resolve_sky(SkyChoice("time:2019-05-11T08:00:00Z", scale="none"), work)
    sky = resolve_sky(SkyChoice("time:2019-05-11T20:00:00Z", scale="none"), work)
    assert sky.facts.elevation_deg is not None
    assert sky.facts.elevation_deg > 60
    assert sky.dome.sun is not None


@pytest.mark.parametrize(
    "words",
    ["noon", "sun:", "sun:1", "sun:a,b", "sun:1,nan", "sun:1,-5", "sun:1,95", "sun:1,2,3,4"]
    + ["sun:10,0", "time:soon", "time:2019-05-11T01:59:16Z", "source", "sun:10,20,40"],
)
def test_bad_forms_are_refused(words: str) -> None:
    with pytest.raises(InputError):
        sky_without_log(SkyChoice(words))


def test_the_sun_of_a_dome_is_searched_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[int] = []
    search = dome_module._sun_direction

    def counted(radiance: np.ndarray) -> np.ndarray | None:
        searched.append(len(radiance))
        return search(radiance)

    monkeypatch.setattr(dome_module, "_sun_direction", counted)
    dome = SkyDome(sun_sky(np.radians(30.0), 35.0, SKY).radiance, None)
    work = tiny_world(dome)
    sky = resolve_sky(SkyChoice("source", scale="none"), work)
    assert split_sun(sky.dome)[1] is split_sun(sky.dome)[1] is sky.sun
    assert sky.record["sun_irradiance"] is not None
    assert searched == [256]


@pytest.mark.parametrize("factor", [0.0, 0.5, 3.0])
def test_an_edited_sun_adds_its_own_light_to_the_rest(factor: float) -> None:
    work = tiny_world(sun_sky(np.radians(30.0), 35.0, SKY))
    rest, sun = split_sun(work.sky.dome)
    assert sun is not None
    sky = edited(work, "200,50", factor)
    added = factor * sun.irradiance * np.sin(np.radians(50.0))
    level = np.full(3, np.pi * SKY) + added
    np.testing.assert_allclose(sky.dome.horizontal_irradiance(), level, rtol=1e-4)
    np.testing.assert_allclose(sky.record["horizontal_irradiance"], level, rtol=1e-4)
    if not factor:
        np.testing.assert_array_equal(sky.dome.radiance, rest)
        return
    brightest = np.unravel_index(sky.dome.radiance.sum(axis=2).argmax(), rest.shape[:2])
    towards = pixel_directions(len(rest))[brightest]
    assert angle_between_deg(towards, direction_enu(200.0, 50.0)) < 0.6
    assert (sky.facts.azimuth_deg, sky.facts.elevation_deg) == (200.0, 50.0)


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
        parse_sky(SkyChoice("source", move_sun=position, sun_factor=factor))


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


def test_the_sky_of_another_log_keeps_its_north(tmp_path: Path) -> None:
    """To a log that lies turned and back: the sun at its azimuth, the sky as it was. Files tell
    their sun to a quarter of a pixel of 0.7 degrees."""
    dome = sun_sky(np.radians(30.0), 35.0, SKY)
    around = 1.5 + 0.5 * np.cos(np.arange(512, dtype=np.float32) * np.pi / 256)
    dome = SkyDome(dome.radiance * around[:, None], dome.sun)
    here, there = (facing(tiny_world(dome), heading) for heading in (90.0, 210.0))
    moved = resolve_sky(SkyChoice(str(write(here, dome, tmp_path)), scale="none"), there).dome
    assert moved.sun is not None
    assert there.log.geo is not None
    assert there.log.geo.enu_from_world is not None
    in_enu = there.log.geo.enu_from_world.rotate(moved.sun.direction_world)
    assert azimuth_elevation(in_enu).azimuth_deg == pytest.approx(60.0, abs=0.2)
    back = resolve_sky(SkyChoice(str(write(there, moved, tmp_path)), scale="none"), here)
    assert back.dome.sun is not None
    assert angle_between_deg(back.dome.sun.direction_world, direction_enu(60.0, 35.0)) < 0.2
    far = pixel_directions(256) @ direction_enu(60.0, 35.0) < 0.99
    np.testing.assert_allclose(back.dome.radiance[far], dome.radiance[far], rtol=0.01)
    assert "turned by -120.00 degrees" in back.facts.notes[-1]
    same = resolve_sky(SkyChoice(str(write(here, dome, tmp_path)), scale="none"), here).dome
    np.testing.assert_array_equal(same.radiance, dome.radiance)


class LevelLight(SceneLuminance):
    """Light of white level ground, in the place of a log's surfaces."""

    def mean_luminance(self, dome: SkyDome) -> float:
        return float(luminance(dome.horizontal_irradiance()))


@pytest.mark.parametrize("is_night", [False, True])
def test_the_factor_of_automatic_scaling_is_noted(
    is_night: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A warning where it makes a night as bright as the recording."""
    dome = sun_sky(np.radians(30.0), 35.0, SKY)
    sky = SkyDome(street_of_lamps(64), None) if is_night else dome
    path = tmp_path / "a.exr"
    write_exr(path, sky.radiance)
    caplog.set_level("INFO")
    work = facing(tiny_world(dome), 0.0)
    found = resolve_sky(SkyChoice(str(path)), work, LevelLight(work))
    note = found.facts.notes[-1]
    assert f"multiplied by {found.facts.scale_factor:.3g}," in note
    assert "--sky-scale none keeps the file's own level" in note
    assert ("looks like a night panorama" in note) == is_night
    (record,) = [r for r in caplog.records if note in r.message]
    assert record.levelname == ("WARNING" if is_night else "INFO")
    own = resolve_sky(SkyChoice(str(path), scale="none"), work)
    assert not any("multiplied" in text for text in own.facts.notes)


def test_a_layer_is_a_sky_of_its_own(tmp_path: Path) -> None:
    dome = sun_sky(np.radians(30.0), 35.0, SKY)
    layers = {
        f"{layer}.{c}": np.ascontiguousarray(dome.radiance[..., i] * factor)
        for layer, factor in (("Combined", 1), ("Env", 2))
        for i, c in enumerate("RGB")
    }
    path = tmp_path / "a#1.exr"
    OpenEXR.File({"type": OpenEXR.scanlineimage}, layers).write(str(path))
    combined, env = SkyChoice(str(path)), SkyChoice(f"{path}#Env")
    assert (parse_sky(combined).name, parse_sky(env).name) == ("a_1", "a_1_Env")
    assert made_from_sky(combined) != made_from_sky(env)
    np.testing.assert_array_equal(
        sky_without_log(env).dome.radiance, 2 * sky_without_log(combined).dome.radiance
    )
    # A file that exists is taken by its whole name.
    (tmp_path / "a#1.exr#Env").write_bytes(b"no picture")
    with pytest.raises(InputError, match="not an HDR picture"):
        sky_without_log(env)


@pytest.mark.parametrize(("file_deg", "log_deg"), [(90.0, 90.01), (359.995, 0.005)])
def test_a_turn_that_only_blurs_is_not_made(
    file_deg: float, log_deg: float, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """True skies beside a synthetic log: its north is found to millidegrees."""
    dome = sun_sky(np.radians(30.0), 35.0, SKY)
    path = write(facing(tiny_world(dome), file_deg), dome, tmp_path)
    sky = resolve_sky(SkyChoice(str(path), scale="none"), facing(tiny_world(dome), log_deg))
    np.testing.assert_array_equal(sky.dome.radiance, dome.radiance)
    assert not caplog.messages
    assert not sky.facts.notes


@pytest.mark.parametrize(
    ("file_deg", "log_deg", "named"), [(None, 90.0, "the file"), (90.0, None, "the log")]
)
def test_an_unknown_north_is_told_and_turns_nothing(
    file_deg: float | None,
    log_deg: float | None,
    named: str,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    dome = sun_sky(np.radians(30.0), 35.0, SKY)
    path = write(facing(tiny_world(dome), file_deg), dome, tmp_path)
    sky = resolve_sky(SkyChoice(str(path), scale="none"), facing(tiny_world(dome), log_deg))
    np.testing.assert_array_equal(sky.dome.radiance, dome.radiance)
    (warning,) = caplog.messages
    assert f"{named} has no north" in warning
    assert sky.facts.notes[-1] in warning
