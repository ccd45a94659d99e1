"""The nuScenes reader: a made data set with known truth."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest

from datasets import nuscenes_log as made
from datasets.nuscenes_log import LYFT, T4, Layout, write_data_set
from lightsim.core.actors import ActorKind
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.core.solar import solar_position
from lightsim.datasets.fingerprint import hash_recording
from lightsim.datasets.nuscenes.boxes import KIND_BY_LABEL
from lightsim.datasets.reader import check_layout, read_log
from lightsim.errors import InputError


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Generator[Path]:
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setenv("LIGHTSIM_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data_set(tmp_path_factory.mktemp("made") / "nuscenes")


@pytest.fixture(scope="module")
def log(folder: Path) -> DrivingLog:
    return read(folder)


def read(folder: Path, scene: str = "") -> DrivingLog:
    return read_log(LogReading(source=str(folder), scene=scene, image_scale=1.0))


def seconds(time_ns: int) -> float:
    return (time_ns - made.START_US * 1000) * 1e-9


def recorded_m(log: DrivingLog, points_world: np.ndarray) -> np.ndarray:
    """Positions in the recording's own world frame."""
    return points_world.astype(np.float64) + np.array(log.origin_m)


def test_frames_have_their_own_times_and_poses(log: DrivingLog) -> None:
    assert log.name == "scene-0061"
    assert list(log.cameras) == ["CAM_BACK", "CAM_FRONT"]
    for name in log.cameras:
        frames = log.frames_of(name)
        assert len(frames) == made.N_TICKS
        for tick, frame in enumerate(frames):
            truth_s = made.tick_s(tick) + made.CAMERA_OFFSET_S[name]
            assert seconds(frame.time_ns) == pytest.approx(truth_s, abs=1e-6)
            truth = made.ego_m(truth_s) + made.rotation(made.YAW_RAD) @ made.CAMERA_M[name]
            position = recorded_m(log, frame.world_from_camera.translation_m)
            np.testing.assert_allclose(position, truth, atol=1e-4)
            assert frame.shutter is None
            assert frame.load_srgb8().shape == (made.HEIGHT_PX, made.WIDTH_PX, 3)
    assert len({frame.stem for frame in log.frames}) == made.N_TICKS


def test_corners_of_the_driven_box_fall_onto_their_pixels(log: DrivingLog) -> None:
    actor = next(a for a in log.actors if a.actor_id == "0-driven")
    axes = made.rotation(made.YAW_RAD)
    width, length, height = made.CAR_SIZE_WLH
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    for frame in log.frames_of("CAM_FRONT")[2:6]:
        time_s = seconds(frame.time_ns)
        world = made.car_m(time_s) + corners * np.array([length, width, height]) @ axes.T
        camera_m = made.ego_m(time_s) + axes @ made.CAMERA_M["CAM_FRONT"]
        x, y, z = ((world - camera_m) @ axes @ made.EGO_FROM["CAM_FRONT"]).T
        cx, cy = made.CENTRE_PX
        truth = np.stack([made.FOCAL_PX * x / z + cx, made.FOCAL_PX * y / z + cy], axis=1)
        pose = actor.world_from_actor(frame.time_ns)
        uv, _ = frame.project(log.cameras["CAM_FRONT"], pose.apply(corners * actor.size_lwh_m))
        # Half a pixel: the corner of the first pixel is (0, 0), its centre in the data set.
        np.testing.assert_allclose(uv, truth + 0.5, atol=0.02)


def test_boxes_are_where_and_when_the_lidar_scans_them(log: DrivingLog) -> None:
    driven, parked = sorted(log.actors, key=lambda a: a.actor_id)
    assert (driven.is_moving, parked.is_moving) == (True, False)
    assert (driven.kind, driven.label) == (ActorKind.CAR, "vehicle.car")
    np.testing.assert_allclose(driven.size_lwh_m, [4.2, 1.8, 1.5])
    times_s = [seconds(t) for t in driven.trajectory.times_ns.tolist()]
    truth_s = [made.car_scan_s(made.tick_s(2 * key)) for key in range(made.N_KEY_FRAMES)]
    np.testing.assert_allclose(times_s, truth_s, atol=1e-4)
    assert all(0.01 < 0.5 * key - t < 0.05 for key, t in enumerate(times_s)), "before the stamp"
    truth_m = np.stack([made.car_m(t) for t in times_s])
    np.testing.assert_allclose(recorded_m(log, driven.trajectory.positions_m), truth_m, atol=1e-3)
    pose = driven.world_from_actor(driven.trajectory.start_ns)
    assert pose.yaw_rad == pytest.approx(made.YAW_RAD)


def test_returns_and_origins_are_at_their_own_times(log: DrivingLog) -> None:
    """The sensor moves 0.75 m in a sweep; returns and origins are exact to a millimetre."""
    assert len(log.sweeps) == made.N_TICKS
    for tick, lazy in enumerate(log.sweeps):
        sweep = lazy.load()
        stamp_s = made.tick_s(tick)
        points, origins = made.returns_world(stamp_s)
        kept = np.arange(len(points)) != 5
        np.testing.assert_allclose(recorded_m(log, sweep.points_world), points[kept], atol=1e-3)
        np.testing.assert_allclose(recorded_m(log, sweep.origins_world), origins[kept], atol=1e-3)
        truth_s = made.beam_times_s(stamp_s)[kept] - stamp_s
        np.testing.assert_allclose(sweep.time_offset_s, truth_s, atol=1e-6)
        np.testing.assert_allclose(sweep.intensity, 0.2, atol=1e-6)
        assert (sweep.ring == np.arange(len(points))[kept] % made.LASERS).all()


def test_signalling_nans_of_damaged_sweeps_are_dropped(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "set"))
    path = sorted((copy / "samples" / "LIDAR_TOP").iterdir())[0]
    data = np.frombuffer(path.read_bytes(), np.uint32).copy().reshape(-1, 5)
    data[0, 0] = data[1, 3] = 0x7F800001
    path.write_bytes(data.tobytes())
    sweep = read(copy).sweeps[0].load()
    assert len(sweep.points_world) == len(data) - 3
    assert np.isfinite(sweep.points_world).all()


def test_place_time_and_north_come_from_the_map(log: DrivingLog) -> None:
    assert log.geo is not None
    assert log.geo.place is not None
    # Metres of a degree at the equator, on WGS 84.
    latitude = 1.2882100868743724 + made.START_M[1] / 110_574.4
    longitude = 103.78475189208984 + made.START_M[0] / 111_291.6
    assert log.geo.place.latitude_deg == pytest.approx(latitude, abs=1e-5)
    assert log.geo.place.longitude_deg == pytest.approx(longitude, abs=1e-5)
    assert log.geo.heading_deg == pytest.approx(90.0)
    assert (log.geo.heading_origin, log.geo.heading_residual_deg) == ("map", 0.5)
    sun = log.geo.sun_at(log.frames[0].time_ns)
    truth = solar_position(latitude, longitude, made.START_US * 1000)
    assert sun is not None
    assert sun.azimuth_deg == pytest.approx(truth.azimuth_deg, abs=0.01)
    assert sun.elevation_deg == pytest.approx(truth.elevation_deg, abs=0.01)
    assert any("planar" in note for note in log.notes)
    assert log.licence.startswith("CC BY-NC-SA 4.0")


@pytest.mark.parametrize("layout", [T4, LYFT], ids=["t4", "lyft"])
def test_other_data_sets_with_these_tables(tmp_path: Path, layout: Layout) -> None:
    log = read(write_data_set(tmp_path / "set", layout))
    sweep = log.sweeps[2].load()
    points, _ = made.returns_world(made.tick_s(2))
    if not layout.is_merged:
        np.testing.assert_allclose(recorded_m(log, sweep.points_world), np.delete(points, 5, 0),
                                   atol=1e-3)  # fmt: skip
        return
    np.testing.assert_allclose(recorded_m(log, sweep.points_world), points, atol=1e-3)
    assert (sweep.time_offset_s == 0).all()
    assert (sweep.ring == -1).all()
    cameras_m = np.mean(list(made.CAMERA_M.values()), axis=0)
    at_stamp = made.ego_m(made.tick_s(2)) + made.rotation(made.YAW_RAD) @ cameras_m
    np.testing.assert_allclose(recorded_m(log, sweep.origins_world[0]), at_stamp, atol=1e-3)
    notes = " / ".join(log.notes)
    for part in ("merged from several LiDARs", "no times of their own", "brown lens"):
        assert part in notes
    driven = next(a for a in log.actors if a.actor_id == "0-driven")
    truth_s = [0.5 * key for key in range(made.N_KEY_FRAMES)]
    times_s = [seconds(t) for t in driven.trajectory.times_ns.tolist()]
    np.testing.assert_allclose(times_s, truth_s, atol=1e-9)
    assert log.geo is not None
    assert log.geo.heading_deg == pytest.approx(90.0, abs=0.6)
    assert log.geo.heading_origin == "gps track"


def test_a_scene_is_chosen_by_name_or_token(tmp_path: Path) -> None:
    folder = write_data_set(tmp_path / "set", scenes=9)
    with pytest.raises(
        InputError, match=r"9 recordings.*--scene.*scene-0061, .*scene-0066, \.\.\."
    ):
        read(folder)
    with pytest.raises(InputError, match=r"--scene scene-0001"):
        read(folder, "scene-0001")
    assert read(folder, "scene-0061").name == "scene-0061"
    assert read(folder / "v1.0-mini", "0-token").name == "scene-0061"
    with pytest.raises(InputError, match="no pictures"):
        read(folder, "scene-0062")
    with pytest.raises(InputError, match="a part of the data set"):
        check_layout(LogReading(source=str(folder / "samples")))
    with pytest.raises(InputError, match="data set set"):
        check_layout(LogReading(source=str(tmp_path)))


def test_tables_are_cut_out_once_and_again_after_a_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LIGHTSIM_CACHE", str(tmp_path / "cache"))
    folder = write_data_set(tmp_path / "set", scenes=3)
    reading = LogReading(source=str(folder), scene="scene-0061")
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    read_log(reading)
    (cut,) = (tmp_path / "cache" / "nuscenes").iterdir()
    assert all(len(row["token"]) and row["token"][0] == "0" for row in
               json.loads(cut.read_text())["sample_data"])  # fmt: skip
    hashes = hash_recording(reading)
    assert len(hashes) == 3 * made.N_TICKS + 1
    assert not any(name.startswith("v1.0") for name in hashes), "not the tables of all scenes"
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    # A damaged cache is made again; so is that of changed tables.
    cut.write_text("{")
    assert hash_recording(reading) == hashes
    table = folder / "v1.0-mini" / "sample_data.json"
    os.utime(table, ns=(0, 1))
    assert hash_recording(reading) == hashes
    assert len(list((tmp_path / "cache" / "nuscenes").iterdir())) == 2
    rows = json.loads(table.read_text())
    rows[0]["timestamp"] += 1
    made.write_table(table, rows)
    assert hash_recording(reading) != hashes


def test_what_is_missing_or_doubled_is_survived_and_noted(tmp_path: Path) -> None:
    folder = write_data_set(tmp_path / "set")
    tables = folder / "v1.0-mini"
    next((folder / "samples" / "CAM_FRONT").iterdir()).unlink()
    next((folder / "sweeps" / "LIDAR_TOP").iterdir()).unlink()
    rows = json.loads((tables / "sample_data.json").read_text())
    back = [row for row in rows if "CAM_BACK" in row["token"]]
    rows += [{**back[0], "token": "doubled"}]
    back[3]["is_valid"] = False
    made.write_table(tables / "sample_data.json", rows)
    rows = json.loads((tables / "category.json").read_text())
    made.write_table(tables / "category.json", [{**rows[0], "name": "vehicle.hovercraft"}])
    log = read(folder)
    notes = " / ".join(log.notes)
    for part in (
        "CAM_FRONT: 1 of 7 rows of sample_data have no file",
        "LIDAR_TOP: 1 of 7 rows of sample_data have no file",
        "CAM_BACK: 1 of 8 rows of sample_data repeat a time stamp",
        "CAM_BACK: 1 of 8 rows of sample_data are marked as invalid",
        "2 x 'vehicle.hovercraft'",
    ):
        assert part in notes
    assert len(log.sweeps) == made.N_TICKS - 1
    for name in ("sample_annotation", "instance", "category", "attribute", "log"):
        (tables / f"{name}.json").unlink()
    bare = read(folder)
    assert bare.actors == ()
    assert bare.geo is None


def test_every_label_of_nuscenes_has_a_kind() -> None:
    labels = {label for label in KIND_BY_LABEL if "." in label or label == "animal"}
    assert len(labels) == 23 + 4
    assert {label for label, kind in KIND_BY_LABEL.items() if kind is ActorKind.OTHER} == {
        "movable_object.debris",
        "static_object.bicycle_rack",
    }
