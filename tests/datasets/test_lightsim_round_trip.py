"""Logs that are written as lightsim-log/1 folders and read back are the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datasets.lightsim_log import write_lightsim_mini
from datasets.mini_log import write_json, write_mini_log
from lightsim.cli import main
from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.core.sensors import CameraFrame
from lightsim.core.solar import SolarPosition
from lightsim.datasets.reader import read_log
from lightsim.datasets.scale import at_scale
from lightsim.errors import InputError
from lightsim.export.lightsim.log import write_lightsim_log
from lightsim.progress import SilentProgress


def find_bonnet(
    views: Sequence[tuple[PinholeCamera, Sequence[CameraFrame]]], ego: Trajectory
) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """The lower rows of the first camera."""
    camera = views[0][0]
    mask = np.zeros((camera.height_px, camera.width_px), dtype=bool)
    mask[-5:, 3:] = True
    return {camera.name: mask}, ()


def written(log: DrivingLog, folder: Path) -> DrivingLog:
    write_lightsim_log(log, folder, SilentProgress())
    return read_log(LogReading(source=str(folder)))


def check_same(before: DrivingLog, after: DrivingLog) -> None:
    """Compare all that a log holds; the origin of its world frame may differ by whole metres."""
    shift = np.array(after.origin_m) - np.array(before.origin_m)
    np.testing.assert_array_equal(shift, np.round(shift))
    assert after.cameras == dict(before.cameras)
    for name in before.cameras:
        own, found = before.frames_of(name), after.frames_of(name)
        assert [f.time_ns for f in found] == [f.time_ns for f in own]
        for a, b in zip(own, found, strict=True):
            check_same_frame(a, b, shift)
    check_same_sweeps(before, after, shift)
    assert [(a.actor_id, a.kind, a.label, a.is_moving) for a in after.actors] == [
        (a.actor_id, a.kind, a.label, a.is_moving) for a in before.actors
    ]
    for a, b in zip(before.actors, after.actors, strict=True):
        np.testing.assert_array_equal(b.size_lwh_m, a.size_lwh_m)
        check_same_path(a.trajectory, b.trajectory, shift)
    # The path is longer by what readers extrapolate at its ends.
    inside = before.ego.times_ns
    at = replace(after.ego, times_ns=inside, matrices=after.ego.held_at(inside))
    check_same_path(before.ego, at, shift)
    check_same_place(before, after)
    assert list(after.ego_vehicle_masks) == list(before.ego_vehicle_masks)
    for name, mask in before.ego_vehicle_masks.items():
        np.testing.assert_array_equal(after.ego_vehicle_masks[name], mask)
    assert after.semantic_names == dict(before.semantic_names)
    assert (after.name, after.licence) == (before.name, before.licence)
    assert set(before.notes) <= set(after.notes)


def check_same_frame(a: CameraFrame, b: CameraFrame, shift: np.ndarray) -> None:
    np.testing.assert_array_equal(b.load_srgb8(), a.load_srgb8())
    expected = a.world_from_camera.matrix.copy()
    expected[:3, 3] -= shift
    np.testing.assert_allclose(b.world_from_camera.matrix, expected, atol=1e-6)
    assert (a.shutter is None) == (b.shutter is None)
    if a.shutter is not None and b.shutter is not None:
        assert b.shutter.readout_s == a.shutter.readout_s
        assert b.shutter.readout_across_s == a.shutter.readout_across_s
        for name in ("velocity_m_s", "angular_velocity_rad_s"):
            np.testing.assert_array_equal(getattr(b.shutter, name), getattr(a.shutter, name))


def check_same_sweeps(before: DrivingLog, after: DrivingLog, shift: np.ndarray) -> None:
    assert [s.time_ns for s in after.sweeps] == [s.time_ns for s in before.sweeps]
    for own, found in zip(before.sweeps, after.sweeps, strict=True):
        a, b = own.load(), found.load()
        for name in ("points_world", "origins_world"):
            np.testing.assert_allclose(getattr(b, name) + shift, getattr(a, name), atol=1e-4)
        for name in ("intensity", "time_offset_s", "ring", "semantic_class"):
            np.testing.assert_array_equal(getattr(b, name), getattr(a, name))


def check_same_path(a: Trajectory, b: Trajectory, shift: np.ndarray) -> None:
    np.testing.assert_array_equal(b.times_ns, a.times_ns)
    np.testing.assert_allclose(b.positions_m + shift, a.positions_m, atol=1e-6)
    np.testing.assert_allclose(b.matrices[:, :3, :3], a.matrices[:, :3, :3], atol=1e-9)


def check_same_place(before: DrivingLog, after: DrivingLog) -> None:
    a, b = before.geo, after.geo
    assert (a is None) == (b is None)
    if a is None or b is None:
        return
    assert (b.place, b.clock, b.given_sun) == (a.place, a.clock, a.given_sun)
    assert b.heading_origin == a.heading_origin
    assert b.heading_residual_deg == a.heading_residual_deg
    assert b.heading_residual_m == a.heading_residual_m
    assert (a.heading_deg is None) == (b.heading_deg is None)
    if a.heading_deg is not None:
        assert b.heading_deg == pytest.approx(a.heading_deg, abs=1e-9)


def test_a_pandaset_log_is_the_same(tmp_path: Path) -> None:
    folder = write_mini_log(tmp_path / "log")
    write_json(folder / "annotations" / "semseg" / "classes.json", {"7": "Road", "13": "Car"})
    log = read_log(LogReading(source=str(folder)), find_bonnet)
    assert log.ego_vehicle_masks
    check_same(log, written(log, tmp_path / "out"))


def test_given_place_time_and_sun_are_the_same(tmp_path: Path) -> None:
    folder = write_mini_log(tmp_path / "log", speed_m_s=0.1)
    reading = LogReading(source=str(folder), utc="2021-03-04T05:06:07", heading_deg=33.0)
    log = read_log(reading)
    check_same(log, written(log, tmp_path / "out"))
    assert log.geo is not None
    assert log.geo.clock is not None
    assert log.geo.clock.utc_minus_log_ns
    sun = replace(log, geo=replace(log.geo, given_sun=SolarPosition(120.0, 30.0)))
    check_same(sun, written(sun, tmp_path / "sun"))
    nowhere = replace(log, geo=None)
    check_same(nowhere, written(nowhere, tmp_path / "nowhere"))


def test_resampled_lenses_and_distant_worlds_are_the_same(tmp_path: Path) -> None:
    log = read_log(LogReading(source=str(write_lightsim_mini(tmp_path / "log"))))
    assert log.origin_m[1] > 5e6
    again = written(log, tmp_path / "out")
    check_same(log, again)
    check_same(again, written(again, tmp_path / "again"))


def test_a_part_of_the_real_log_is_the_same(shared_data: Path, tmp_path: Path) -> None:
    reading = LogReading(source=str(shared_data / "pandaset" / "002"), frames="42:46")
    log = at_scale(read_log(reading), 0.125)
    assert len(log.frames) == 24
    check_same(log, written(log, tmp_path / "out"))


def test_a_folder_with_other_files_is_left_alone(tmp_path: Path) -> None:
    log = read_log(LogReading(source=str(write_mini_log(tmp_path / "log"))))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("x")
    with pytest.raises(InputError, match="contains other files"):
        write_lightsim_log(log, tmp_path / "out", SilentProgress())
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["mine.txt"]


def test_a_log_that_cannot_be_read_leaves_nothing(tmp_path: Path) -> None:
    folder = write_mini_log(tmp_path / "log")
    log = read_log(LogReading(source=str(folder)))
    (folder / "lidar" / "01.pkl.gz").write_bytes(b"x")
    with pytest.raises(InputError, match=r"01\.pkl\.gz"):
        write_lightsim_log(log, tmp_path / "out", SilentProgress())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["log"]


def test_the_command_writes_at_full_size(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_mini_log(tmp_path / "log")
    main(["export", str(folder), "--out", str(tmp_path / "out"), "--frames", "0:2"])
    log = read_log(LogReading(source=str(tmp_path / "out")))
    assert len(log.frames) == 4
    assert log.cameras["front_camera"].width_px == 64
    assert "4 pictures, 2 sweeps" in capsys.readouterr().out
