"""The PandaSet reader: a made log with known truth, and the real sequence 002."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from datasets.mini_log import START_S, WORLD_YAW_DEG, sweep_columns, write_frame, write_mini_log
from lightsim.core.actors import ActorKind
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.core.sensors import LidarSweep
from lightsim.datasets.pandaset.tracks import KIND_BY_LABEL
from lightsim.datasets.reader import read_log
from lightsim.errors import InputError
from lightsim.masks.ego_vehicle import ego_vehicle_masks

ROAD_CLASS = 7
BOX_TIME_S = 0.05
"""The moving car is straight ahead: scanned half a turn before the sweep's time."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mini_log(tmp_path_factory.mktemp("mini") / "log")


@pytest.fixture(scope="module")
def log(folder: Path) -> DrivingLog:
    return read_log(LogReading(source=str(folder)))


def test_cameras_and_frames(log: DrivingLog) -> None:
    assert list(log.cameras) == ["back_camera", "front_camera"]
    camera = log.cameras["front_camera"]
    assert (camera.width_px, camera.height_px, camera.cx, camera.cy) == (64, 36, 32.0, 18.0)
    assert [f.stem for f in log.frames_of("front_camera")] == ["00", "01", "02"]
    times = [f.time_ns for f in log.frames]
    assert times == sorted(times)
    frame = log.frames_of("front_camera")[0]
    assert frame.load_srgb8().shape == (36, 64, 3)
    ahead, inside = camera.project(
        frame.world_from_camera.inverse().apply(np.array([[50.0, 0.0, 2.2], [50.0, 1.0, 2.2]]))
    )
    assert inside.all()
    np.testing.assert_allclose(ahead[0], [32.0, 18.0], atol=1e-9)
    assert ahead[1, 0] < 32.0, "what lies to the left is drawn to the left"


def test_the_ego_frame_looks_forward_from_the_road(log: DrivingLog) -> None:
    pose = log.ego.at(log.ego.start_ns)
    np.testing.assert_allclose(pose.rotation, np.eye(3), atol=1e-9)
    assert abs(pose.translation_m[2]) < 1e-9
    assert pose.translation_m[0] == pytest.approx(-30.0 * 0.05, abs=1e-4)


def test_sweeps_have_the_sensor_where_it_stood(log: DrivingLog) -> None:
    sweep = log.sweeps[1].load()
    columns = sweep_columns(START_S + 0.1)
    expected = np.zeros((400, 3))
    is_front = columns["d"] == 1
    expected[:, 0] = 30.0 * (columns["t"] - START_S) + np.where(is_front, 0.6, 0.0)
    expected[:, 2] = np.where(is_front, 1.9, 2.2)
    np.testing.assert_allclose(sweep.origins_world, expected, atol=1e-3)
    np.testing.assert_allclose(sweep.time_offset_s, columns["t"] - START_S - 0.1, atol=1e-6)
    np.testing.assert_allclose(sweep.intensity, 0.2, atol=1e-6)
    assert (sweep.semantic_class == 7).all()


def test_siblings_are_one_actor_timed_when_it_was_scanned(log: DrivingLog) -> None:
    assert [a.actor_id for a in log.actors] == ["moving-a", "parked"]
    moving, parked = log.actors
    assert (moving.is_moving, parked.is_moving) == (True, False)
    assert (moving.kind, moving.label) == (ActorKind.CAR, "Car")
    np.testing.assert_allclose(parked.size_lwh_m, [4.5, 1.9, 1.6])
    times_s = (moving.trajectory.times_ns - int(START_S) * 10**9) * 1e-9
    np.testing.assert_allclose(
        times_s, [-BOX_TIME_S, 0.1 - BOX_TIME_S, 0.2 - BOX_TIME_S], atol=1e-3
    )
    np.testing.assert_allclose(moving.trajectory.positions_m[:, 0], [20.0, 23.0, 26.0], atol=1e-4)
    pose = moving.world_from_actor(moving.trajectory.start_ns)
    assert pose.yaw_rad == pytest.approx(0.0, abs=1e-9), "the actor looks along its length"
    assert parked.world_from_actor(parked.trajectory.start_ns).yaw_rad == pytest.approx(np.pi / 2)


def test_every_label_of_pandaset_has_a_kind() -> None:
    assert len(KIND_BY_LABEL) == 28
    assert ActorKind.OTHER not in KIND_BY_LABEL.values()
    is_vehicle = {label for label, kind in KIND_BY_LABEL.items() if kind.is_vehicle}
    assert is_vehicle == {
        "Car", "Pickup Truck", "Medium-sized Truck", "Semi-truck", "Towed Object", "Bus",
        "Emergency Vehicle", "Other Vehicle - Construction Vehicle", "Other Vehicle - Uncommon",
        "Other Vehicle - Pedicab", "Train", "Trolley", "Tram / Subway",
    }  # fmt: skip
    is_person = {label for label, kind in KIND_BY_LABEL.items() if kind.is_person}
    assert is_person == {"Pedestrian", "Pedestrian with Object", "Personal Mobility Device"}


def test_an_unknown_label_is_said_once_and_stays(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "log"))
    for path in (copy / "annotations" / "cuboids").iterdir():
        table = pd.read_pickle(path)
        write_frame(path, {**table, "label": ["Car", "Hovercraft", "Hovercraft"]})
    log = read_log(LogReading(source=str(copy)))
    assert {(a.label, a.kind) for a in log.actors} == {
        ("Car", ActorKind.CAR),
        ("Hovercraft", ActorKind.OTHER),
    }
    notes = [note for note in log.notes if "labels" in note]
    assert len(notes) == 1
    assert notes[0].endswith("neither vehicles nor persons: 1 x 'Hovercraft'")


def test_north_comes_from_gps(log: DrivingLog) -> None:
    assert log.geo is not None
    assert log.geo.enu_from_world is not None
    assert np.degrees(log.geo.enu_from_world.yaw_rad) == pytest.approx(WORLD_YAW_DEG, abs=0.2)
    assert log.geo.clock is not None
    assert log.geo.clock.utc_minus_log_ns == 0


def test_selections(folder: Path) -> None:
    part = read_log(LogReading(source=str(folder), cameras=("back_camera",), frames="1:3:2"))
    assert list(part.cameras) == ["back_camera"]
    assert part.stems == ("01",)
    assert [s.stem for s in part.sweeps] == ["01"]
    assert len(part.actors) == 2
    with pytest.raises(InputError, match=r"'side_camera'.*back_camera, front_camera"):
        read_log(LogReading(source=str(folder), cameras=("side_camera",)))
    with pytest.raises(InputError, match="frames within 0:3"):
        read_log(LogReading(source=str(folder), frames="10:20"))


def test_a_log_that_stands_still_can_be_given_its_heading(tmp_path: Path) -> None:
    folder = write_mini_log(tmp_path / "log", speed_m_s=0.5)
    log = read_log(LogReading(source=str(folder)))
    assert log.geo is not None
    assert log.geo.enu_from_world is None
    assert any("--heading-deg" in note for note in log.notes)
    given = read_log(LogReading(source=str(folder), heading_deg=90.0))
    assert given.geo is not None
    assert given.geo.enu_from_world is not None
    np.testing.assert_allclose(given.geo.enu_from_world.rotation, np.eye(3), atol=1e-12)


def test_what_is_missing_is_survived_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = write_mini_log(tmp_path / "log", n_frames=4)
    for name in ("lidar/01.pkl.gz", "camera/front_camera/02.jpg", "meta/gps.json"):
        (folder / name).unlink()
    (folder / "annotations/semseg/00.pkl.gz").unlink()
    (folder / "static_extrinsic_calibration.yaml").unlink()
    columns = sweep_columns(START_S)
    columns["x"][:10] = np.nan
    write_frame(folder / "lidar/00.pkl.gz", columns)
    log = read_log(LogReading(source=str(folder)))
    notes = " / ".join(log.notes)
    for part in (
        "no LiDAR sweep for 1 of 4 frames: 1",
        "front_camera: no picture for 1 of 4 frames: 2",
        "no point classes for 1 of 3 frames: 0",
        "no annotations/semseg/classes.json",
        "no GPS",
        "nominal mounting",
    ):
        assert part in notes
    with caplog.at_level(logging.WARNING):
        sweep = log.sweeps[0].load()
    assert len(sweep.points_world) == 390
    assert (sweep.semantic_class == -1).all()
    assert "dropped 10 of 400" in caplog.text
    (folder / "lidar/timestamps.json").unlink()
    for path in (folder / "lidar").glob("*.gz"):
        path.unlink()
    for path in (folder / "annotations/cuboids").glob("*.gz"):
        path.unlink()
    bare = read_log(LogReading(source=str(folder)))
    assert (bare.sweeps, bare.actors) == ((), ())


@pytest.fixture(scope="module")
def real(shared_data: Path) -> DrivingLog:
    return read_log(LogReading(source=str(shared_data / "pandaset" / "002")), ego_vehicle_masks)


def test_real_log_counts(real: DrivingLog) -> None:
    assert len(real.cameras) == 6
    assert len(real.frames) == 6 * 38
    assert real.stems[0] == "42"
    assert [s.stem for s in real.sweeps][-1] == "79"
    assert len(real.sweeps) == 34
    assert any("no LiDAR sweep for 4 of 38 frames: 56 to 58, 71" in note for note in real.notes)
    front = real.cameras["front_camera"]
    assert (front.width_px, front.height_px) == (1920, 1080)
    assert front.cx == pytest.approx(970.5002)


def test_real_log_knows_north_and_the_sun(real: DrivingLog) -> None:
    geo = real.geo
    assert geo is not None
    assert geo.enu_from_world is not None
    assert np.degrees(geo.enu_from_world.yaw_rad) == pytest.approx(-0.3, abs=0.15)
    assert geo.heading_residual_m is not None
    assert geo.heading_residual_m < 0.02
    sun = geo.sun_at(real.frames[0].time_ns)
    assert sun is not None
    assert sun.azimuth_deg == pytest.approx(283.25, abs=0.1)
    assert sun.elevation_deg == pytest.approx(12.07, abs=0.1)


def test_real_log_sees_its_ego_vehicle_behind_only(real: DrivingLog) -> None:
    assert list(real.ego_vehicle_masks) == ["back_camera"]
    mask = real.ego_vehicle_masks["back_camera"]
    assert mask.shape == (1080, 1920)
    assert mask[-150:].all()
    assert not mask[:780].any()


@pytest.mark.parametrize(("stem", "gain"), [("44", 1.02), ("70", 1.2)])
def test_real_sweeps_of_both_generations(real: DrivingLog, stem: str, gain: float) -> None:
    """The Pandar64's laser elevations are sharp only from where it stood at each point's time
    (more so the faster the ego: 3 m/s in sweep 44, 5 m/s in sweep 70)."""
    sweep = next(s for s in real.sweeps if s.stem == stem).load()
    assert len(sweep.points_world) > 160_000
    assert np.isfinite(sweep.points_world).all()
    assert (sweep.semantic_class > 0).all()
    at_end = real.ego.at(sweep.time_ns, 0.1).apply(np.array([[0.0, 0.0, 2.2]]))
    moving = laser_sharpness(real, sweep, sweep.origins_world.astype(np.float64))
    frozen = laser_sharpness(real, sweep, at_end)
    assert moving > gain * frozen


def laser_sharpness(real: DrivingLog, sweep: LidarSweep, origins: np.ndarray) -> float:
    rays = sweep.points_world.astype(np.float64) - origins
    distance = np.linalg.norm(rays, axis=1)
    rays = real.ego.at(sweep.time_ns, 0.1).inverse().rotate(rays)
    elevation = np.degrees(np.arcsin(rays[:, 2] / distance))
    is_used = (distance > 8) & (rays[:, 0] < 0)  # behind, where the front LiDAR is blind
    histogram, _ = np.histogram(elevation[is_used], np.arange(-26, 16, 0.01))
    fraction = histogram / histogram.sum()
    return float((fraction**2).sum())


def test_real_actors(real: DrivingLog) -> None:
    """98 actors of 127 labelled uuids; those that drive look where they go."""
    assert len(real.actors) == 98
    assert sum(actor.is_moving for actor in real.actors) == 35
    drivers = 0
    for actor in real.actors:
        positions = actor.trajectory.positions_m
        steps = np.diff(positions, axis=0)[:, :2]
        forward = actor.trajectory.matrices[:-1, :2, 0]
        is_long = np.linalg.norm(steps, axis=1) > 0.3
        if is_long.sum() > 5:
            drivers += 1
            cosine = (steps * forward).sum(axis=1) / np.linalg.norm(steps, axis=1).clip(1e-9)
            assert np.degrees(np.arccos(np.median(cosine[is_long]))) < 10, actor.actor_id
        assert np.linalg.norm(steps, axis=1).max(initial=0.0) < 4.0
    assert drivers > 10


def test_real_lidar_falls_onto_the_pictures(real: DrivingLog) -> None:
    """Every camera sees thousands of points, and the road's are in the lower half of its picture
    (within the fraction that trees, cars and slopes leave)."""
    sweep = next(s for s in real.sweeps if s.stem == "44").load()
    points = sweep.points_world.astype(np.float64)
    for name, camera in real.cameras.items():
        frame = next(f for f in real.frames_of(name) if f.stem == "44")
        uv, inside = camera.project(frame.world_from_camera.inverse().apply(points))
        assert inside.sum() > 3000, name
        is_road = inside & (sweep.semantic_class == ROAD_CLASS)
        assert (uv[is_road, 1] > 0.45 * camera.height_px).all(), name
