"""Recordings that later stages would refuse are refused at once; odd light is noted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datasets.mini_log import write_mini_log
from lightsim.build.options import BuildOptions
from lightsim.build.pipeline import build
from lightsim.build.suitability import check_suitable, light_notes, motion_notes
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.datasets.reader import read_log
from lightsim.errors import InputError
from lightsim.progress import SilentProgress

ALL = ("log", "masks", "fields", "sky")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """START_S is 12:26 UTC in September."""
    return write_mini_log(tmp_path_factory.mktemp("suitable") / "log")


@pytest.fixture(scope="module")
def day(folder: Path) -> DrivingLog:
    return read_log(LogReading(source=str(folder)))


def at_longitude(log: DrivingLog, longitude_deg: float) -> DrivingLog:
    assert log.geo is not None
    assert log.geo.place is not None
    return replace(
        log, geo=replace(log.geo, place=replace(log.geo.place, longitude_deg=longitude_deg))
    )


def with_pictures(log: DrivingLog, value: int) -> DrivingLog:
    picture = np.full((36, 64, 3), value, np.uint8)
    return log.with_frames(tuple(replace(f, load_srgb8=lambda: picture) for f in log.frames))


def options(**given: str) -> BuildOptions:
    return BuildOptions(reading=LogReading(source="SOURCE"), **given)  # type: ignore[arg-type]


def test_a_day_with_sweeps_is_suitable(day: DrivingLog) -> None:
    check_suitable(day, options(), ALL)
    assert light_notes(day) == ()


def test_night_is_refused_where_its_sun_is_asked_for(day: DrivingLog) -> None:
    night = at_longitude(day, -170.0)
    for gps in ("all", "place"):
        with pytest.raises(InputError, match=r"SOURCE: .*at night.*below the horizon.*--gps none"):
            check_suitable(night, options(gps=gps), ALL)
    check_suitable(night, options(gps="none"), ALL)
    check_suitable(night, options(), ("log", "masks", "fields"))
    (note,) = light_notes(night)
    assert note.startswith("night: by GPS and clock the sun is")
    assert "--gps none" in note


@pytest.mark.parametrize("is_placed", [True, False])
def test_dark_pictures_are_noted(day: DrivingLog, is_placed: bool) -> None:
    log = day if is_placed else replace(day, geo=None)
    assert light_notes(with_pictures(log, 90)) == ()
    (note,) = light_notes(with_pictures(log, 25))
    assert "the pictures are dark" in note
    assert ("neither place nor time is known" in note) != is_placed


def test_no_sweeps_are_refused_where_geometry_is_made(day: DrivingLog) -> None:
    bare = replace(day, sweeps=())
    with pytest.raises(
        InputError, match=r"SOURCE: .*no LiDAR sweep.*lidar/00\.pkl.*points\.ply.*colmap"
    ):
        check_suitable(bare, options(), ALL)
    check_suitable(bare, options(), ("log", "masks", "alignment"))


def test_a_build_stops_after_its_first_stage(tmp_path: Path) -> None:
    folder = write_mini_log(tmp_path / "log")
    fixes = json.loads((folder / "meta/gps.json").read_text())
    for fix in fixes:
        fix["long"] -= 180.0
    (folder / "meta/gps.json").write_text(json.dumps(fixes))
    reading = BuildOptions(reading=LogReading(source=str(folder), image_scale=1.0))
    build(tmp_path / "work", reading, SilentProgress(), until="log")
    record = json.loads((tmp_path / "work/log/artefact.json").read_text())
    assert any(note.startswith("night: ") for note in record["notes"])
    with pytest.raises(InputError, match="recorded at night"):
        build(tmp_path / "work", reading, SilentProgress())
    assert not (tmp_path / "work/masks").exists()


def test_a_damaged_sweep_is_found_in_the_first_stage(tmp_path: Path) -> None:
    folder = write_mini_log(tmp_path / "log")
    path = folder / "lidar/02.pkl.gz"
    path.write_bytes(path.read_bytes()[:-100])
    reading = BuildOptions(reading=LogReading(source=str(folder), image_scale=1.0))
    with pytest.raises(InputError, match=r"lidar/02\.pkl\.gz: .*truncated"):
        build(tmp_path / "work", reading, SilentProgress(), until="log")


def test_an_ego_vehicle_that_stands_is_noted_with_its_cost(day: DrivingLog) -> None:
    still = day.ego.matrices.copy()
    still[:, :3, 3] = day.ego.positions_m[0]
    log = replace(day, ego=replace(day.ego, matrices=still))
    (note,) = motion_notes(log)
    assert note.startswith("the ego moves 0.0 m in all: surfaces are seen from one place")
    moves = still.copy()
    moves[:, 0, 3] += np.linspace(0.0, 100.0, len(moves))
    assert motion_notes(replace(day, ego=replace(day.ego, matrices=moves))) == ()
