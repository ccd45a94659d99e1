"""The readers of KITTI raw and KITTI-360: made logs with known truth, and real frames."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from datasets import kitti_log as made
from lightsim.core.actors import ActorKind
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.datasets.fingerprint import hash_recording
from lightsim.datasets.kitti.velodyne import Revolution
from lightsim.datasets.reader import check_layout, read_log
from lightsim.errors import InputError


@dataclass(frozen=True)
class Truth:
    """A made log, and what it should be."""

    log: DrivingLog
    ego_from_velo: np.ndarray
    origin_m: np.ndarray
    before: float
    world_from_camera: Callable[[str, int], np.ndarray]


def _kitti_camera(name: str, time_ns: int) -> np.ndarray:
    rect_from_camera = np.eye(4)
    rect_from_camera[:3, 3] = -made.BASELINE_M[name]
    chain = (made.EGO_FROM_VELO, np.linalg.inv(made.CAM0_FROM_VELO))
    turned = np.linalg.inv(made.RECT_FROM_CAM0) @ rect_from_camera
    return made.world_from_ego(time_ns, _KITTI_ORIGIN) @ chain[0] @ chain[1] @ turned


def _kitti360_camera(name: str, time_ns: int) -> np.ndarray:
    turn = np.linalg.inv(made.RECT_FROM_CAM360) if name in ("image_00", "image_01") else np.eye(4)
    rig = made.EGO_FROM_IMU360 @ made.IMU_FROM_CAM360[name]
    return made.world_from_ego(time_ns, made.ORIGIN360_M) @ rig @ turn


# The world frame of KITTI begins at the first OXTS record, 4 ms after the first picture.
_STEP_M = made.SPEED_M_S * 0.004 * np.array([np.cos(made.YAW_RAD), np.sin(made.YAW_RAD), 0.0])
_KITTI_ORIGIN = np.array([0.0, 0.0, 100.0]) - _STEP_M


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made.write_kitti(tmp_path_factory.mktemp("kitti"))


@pytest.fixture(scope="module")
def kitti360(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made.write_kitti360(tmp_path_factory.mktemp("kitti360"))


@pytest.fixture(params=["kitti", "kitti360"])
def truth(request: pytest.FixtureRequest) -> Truth:
    source = request.getfixturevalue(request.param)
    log = read_log(LogReading(source=str(source)))
    if request.param == "kitti":
        return Truth(log, made.EGO_FROM_VELO, _KITTI_ORIGIN, made.BEFORE, _kitti_camera)
    return Truth(log, made.EGO_FROM_VELO360, made.ORIGIN360_M, 0.5, _kitti360_camera)


def test_cameras_are_where_the_vehicle_is_at_the_time_of_each_picture(truth: Truth) -> None:
    log = truth.log
    names = [name for name in log.cameras if not name.startswith("image_02_")]
    assert len(names) == 2
    for name in names:
        frames = log.frames_of(name)
        assert [f.time_ns for f in frames] == [made.frame_ns(n) for n in range(made.N_FRAMES)]
        for frame in frames:
            expected = truth.world_from_camera(name, frame.time_ns)
            expected[:3, 3] -= log.origin_m
            np.testing.assert_allclose(frame.world_from_camera.matrix, expected, atol=1e-5)
            assert frame.load_srgb8().shape == (48, 64, 3)
            assert frame.shutter is None, "the shutters are global"
        camera = log.cameras[name]
        # Centre of the first pixel at 0.5: half a pixel is added to the stored 31.5, 23.5.
        assert (camera.fx, camera.cx, camera.cy) == (60.0, 32.0, 24.0)


def test_points_are_where_the_scanner_saw_them_while_it_moved(truth: Truth) -> None:
    assert len(truth.log.sweeps) == made.N_FRAMES
    for number, lazy in enumerate(truth.log.sweeps):
        sweep = lazy.load()
        expected = made.points_world(number, truth.before, truth.ego_from_velo, truth.origin_m)
        expected = np.concatenate([expected[::2], expected[1::2]]) - truth.log.origin_m
        np.testing.assert_allclose(sweep.points_world, expected, atol=1e-3)
        offsets = made.offsets_s(truth.before)
        stored = np.concatenate([offsets[::2], offsets[1::2]])
        np.testing.assert_allclose(sweep.time_offset_s, stored, atol=1e-6)
        np.testing.assert_allclose(sweep.intensity, 0.3, atol=1e-6)
        assert sweep.time_ns == made.frame_ns(number)


def test_the_box_is_drawn_where_the_car_is(truth: Truth) -> None:
    log = truth.log
    car = next(actor for actor in log.actors if actor.is_moving)
    assert (car.kind, car.label.lower()) == (ActorKind.CAR, "car")
    np.testing.assert_allclose(car.size_lwh_m, made.CAR_SIZE_LWH_M, rtol=1e-6)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    corners = corners * made.CAR_SIZE_LWH_M
    name = next(iter(log.cameras))
    camera = log.cameras[name]
    for frame in log.frames_of(name)[1:3]:
        world = car.world_from_actor(frame.time_ns).apply(corners)
        uv, _ = frame.project(camera, world)
        pose = made.world_from_car(frame.time_ns, truth.ego_from_velo, truth.origin_m)
        expected = np.linalg.inv(truth.world_from_camera(name, frame.time_ns)) @ pose
        points = corners @ expected[:3, :3].T + expected[:3, 3]
        np.testing.assert_allclose(uv[:, 0], 60 * points[:, 0] / points[:, 2] + 32, atol=2e-3)
        np.testing.assert_allclose(uv[:, 1], 60 * points[:, 1] / points[:, 2] + 24, atol=2e-3)


def test_boxes_have_the_time_at_which_the_scanner_faced_them(kitti: Path) -> None:
    car = read_log(LogReading(source=str(kitti))).actors[0]
    offset_s = -np.arctan2(1.5, 12.0) / (2 * np.pi) * made.PERIOD_NS * 1e-9
    expected = [made.frame_ns(n) + offset_s * 1e9 for n in range(made.N_FRAMES)]
    np.testing.assert_allclose(car.trajectory.times_ns - expected, 0.0, atol=1e3)


def test_the_scanner_turns_clockwise() -> None:
    points = np.array([[0.0, 5.0, 0.0], [5.0, 0.0, 0.0], [0.0, -5.0, 0.0], [-5.0, 1e-6, 0.0]])
    left, front, right, behind = Revolution(0.1, 0.05).offsets_s(points).tolist()
    assert (left, front, right) == pytest.approx((-0.025, 0.0, 0.025))
    assert behind == pytest.approx(-0.05)
    # A revolution that starts on the left has all other points later.
    assert Revolution(0.1, 0.025).offsets_s(points)[3] == pytest.approx(0.05)


def test_north_place_and_sun(truth: Truth) -> None:
    geo = truth.log.geo
    assert geo is not None
    assert geo.heading_deg == pytest.approx(90.0), "world x is east"
    assert np.degrees(truth.log.ego.at(made.frame_ns(0)).yaw_rad) == pytest.approx(
        np.degrees(made.YAW_RAD), abs=1e-6
    )
    assert geo.place is not None
    assert geo.clock is not None
    sun = geo.sun_at(made.frame_ns(0))
    assert sun is not None
    # 2011-09-26 13:17:59 CEST in Karlsruhe: the sun is in the south, 40 degrees high.
    assert sun.azimuth_deg == pytest.approx(180.1, abs=0.7)
    assert sun.elevation_deg == pytest.approx(39.9, abs=0.3)
    assert truth.log.licence == "CC BY-NC-SA 3.0"


def test_places(kitti: Path, kitti360: Path) -> None:
    geo = read_log(LogReading(source=str(kitti))).geo
    assert geo is not None
    assert geo.place is not None
    assert (geo.place.latitude_deg, geo.place.longitude_deg) == pytest.approx((49.0, 8.4), abs=1e-6)
    assert geo.sun_std_deg < 0.5
    geo = read_log(LogReading(source=str(kitti360))).geo
    assert geo is not None
    assert geo.place is not None
    # 1200 m east and 3400 m south of the lake at 48.9843445, 8.4295857.
    assert geo.place.latitude_deg == pytest.approx(48.9843445 - 3400 / 111_200, abs=1e-4)
    assert geo.place.longitude_deg == pytest.approx(8.4295857 + 1200 / 73_060, abs=1e-4)
    assert geo.sun_std_deg > 10, "the zone is not known"


def test_side_fisheyes_become_pinhole_views(kitti360: Path) -> None:
    log = read_log(LogReading(source=str(kitti360)))
    views = [name for name in log.cameras if name.startswith("image_02_")]
    assert len(views) >= 2
    yaws = [
        log.frames_of(name)[0].world_from_camera.rotate(np.array([[0.0, 0.0, 1.0]]))[0]
        for name in views
    ]
    left = np.array([-np.sin(made.YAW_RAD), np.cos(made.YAW_RAD), 0.0])
    mean = np.mean(yaws, axis=0)
    assert mean @ left / np.linalg.norm(mean) > 0.99, "image_02 looks to the left"
    assert any("image_03: no such folder" in note for note in log.notes)
    assert any("1 x 'building'" in note for note in log.notes)
    parked = next(actor for actor in log.actors if not actor.is_moving)
    assert (parked.trajectory.start_ns, parked.trajectory.end_ns) == (
        made.frame_ns(0),
        made.frame_ns(made.N_FRAMES - 1),
    )


def test_source_may_be_the_drive_its_date_or_the_root(kitti: Path, kitti360: Path) -> None:
    hashes = hash_recording(LogReading(source=str(kitti)))
    assert "../calib_cam_to_cam.txt" in hashes
    for source in (kitti.parent, kitti.parent.parent):
        assert check_layout(LogReading(source=str(source))) == "kitti"
        reading = LogReading(source=str(source), scene=made.DRIVE)
        assert read_log(reading).name == made.DRIVE
        assert len(hash_recording(reading)) == len(hashes)
    assert check_layout(LogReading(source=str(kitti360))) == "kitti360"
    with pytest.raises(InputError, match="a part of a KITTI drive"):
        check_layout(LogReading(source=str(kitti / "image_02")))
    with pytest.raises(InputError, match=r"--scene with one of 1: 2011_09_26_drive_0001_sync"):
        read_log(LogReading(source=str(kitti.parent), scene="2011_09_26_drive_0002_sync"))
    unrectified = kitti.parent / "2011_09_26_drive_0001_extract"
    unrectified.mkdir()
    for name in ("oxts", "image_02"):
        (unrectified / name).mkdir()
    with pytest.raises(InputError, match="not rectified"):
        read_log(LogReading(source=str(unrectified)))
    assert read_log(LogReading(source=str(kitti.parent))).name == made.DRIVE
    shutil.rmtree(unrectified)


def test_missing_files_are_survived_and_noted(tmp_path: Path) -> None:
    drive = made.write_kitti(tmp_path, n_frames=5)
    (drive / "image_02" / "data" / "0000000002.png").unlink()
    (drive / "velodyne_points" / "data" / "0000000001.bin").unlink()
    times = drive / "velodyne_points" / "timestamps.txt"
    lines = times.read_text().splitlines()
    lines[3] = ""
    times.write_text("\n".join(lines))
    # Two records with one time stamp.
    times = drive / "oxts" / "timestamps.txt"
    lines = times.read_text().splitlines()
    lines[2] = lines[1]
    times.write_text("\n".join(lines))
    log = read_log(LogReading(source=str(drive)))
    notes = " / ".join(log.notes)
    assert "image_02: no picture for 1 of 5 frames" in notes
    assert "velodyne: 1 files have no time stamp" in notes
    assert "oxts: 1 files repeat a time stamp" in notes
    assert "1 boxes of frames without a time or a pose" in notes
    assert len(log.sweeps) == 3
    for name in ("velodyne_points", "tracklet_labels.xml", "image_03"):
        path = drive / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    bare = read_log(LogReading(source=str(drive)))
    assert (bare.sweeps, bare.actors, list(bare.cameras)) == ((), (), ["image_02"])


def test_poses_exist_while_the_vehicle_moves(tmp_path: Path) -> None:
    root = made.write_kitti360(tmp_path / "root", n_frames=5)
    poses = root / "data_poses" / made.DRIVE360 / "poses.txt"
    lines = poses.read_text().splitlines()
    poses.write_text("\n".join(lines[1:2] + lines[3:]))
    log = read_log(LogReading(source=str(root)))
    assert any("no pose for 2 of 5 frames" in note for note in log.notes)
    # The pose is found by the frame's number, not by its line.
    place = log.ego.at(made.frame_ns(3)).translation_m + log.origin_m
    expected = made.world_from_ego(made.frame_ns(3), made.ORIGIN360_M)[:3, 3]
    np.testing.assert_allclose(place, expected, atol=1e-5)


# The sample has frames 139 to 145 of drive 0023 under the numbers 0 to 6, beside the time stamps of
# the whole drive: the OXTS positions fit those of these lines.
_FIRST_LINE = 139


@pytest.fixture(scope="module")
def real(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> DrivingLog:
    date = shared_data / "anylog" / "kitti_raw" / "2011_09_26"
    if not date.is_dir():
        pytest.skip(f"needs the KITTI sample at {date}")
    copy = Path(shutil.copytree(date, tmp_path_factory.mktemp("real") / "2011_09_26"))
    drive = copy / "2011_09_26_drive_0023_sync"
    for path in (copy, *copy.rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o644)
    for name in ("image_02", "oxts"):
        path = drive / name / "timestamps.txt"
        lines = path.read_text().splitlines()
        path.write_text("\n".join(lines[_FIRST_LINE : _FIRST_LINE + 7]))
    return read_log(LogReading(source=str(drive), image_scale=1.0))


def test_real_log_has_the_sun_in_the_south(real: DrivingLog) -> None:
    assert len(real.frames) == len(real.sweeps) == 7
    assert real.geo is not None
    sun = real.geo.sun_at(real.frames[0].time_ns)
    assert sun is not None
    # A pole's shadow in the pictures gives 175 +- 10 degrees.
    assert sun.azimuth_deg == pytest.approx(180.2, abs=0.3)
    assert sun.elevation_deg == pytest.approx(39.8, abs=0.1)


def test_real_speed_is_smooth_with_the_own_times_of_records(real: DrivingLog) -> None:
    steps_m = np.linalg.norm(np.diff(real.ego.positions_m[1:-1], axis=0), axis=1)
    speeds = steps_m / (np.diff(real.ego.times_ns[1:-1]) * 1e-9)
    assert speeds == pytest.approx(8.94, abs=0.08)


def test_real_pictures_agree_with_points_of_other_frames(real: DrivingLog) -> None:
    """Brightness at the points of one sweep correlates between pictures 0.4 s and 3.6 m apart:
    0.76; 0.71 and less for poses 50 ms late or early, or turned by 0.6 degrees."""
    right = _agreement(real, lambda pose: pose)
    assert right > 0.74
    changes = [_moved(ahead_m, 0.0) for ahead_m in (-0.45, 0.45)]
    changes += [_moved(0.0, turn_rad) for turn_rad in (-0.01, 0.01)]
    for change in changes:
        assert _agreement(real, lambda pose, c=change: pose @ c) < right - 0.04


def _moved(ahead_m: float, turn_rad: float) -> RigidTransform:
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return RigidTransform.from_rotation("camera", "camera", turn, np.array([0.0, 0.0, ahead_m]))


def _agreement(log: DrivingLog, change: Callable[[RigidTransform], RigidTransform]) -> float:
    camera = log.cameras["image_02"]
    found = []
    for first, second in ((0, 4), (1, 5), (2, 6)):
        points = log.sweeps[first].load().points_world.astype(np.float64)
        values, insides = [], []
        for number in (first, second):
            frame = log.frames[number]
            pose = frame.world_from_camera if number == first else change(frame.world_from_camera)
            uv, inside = camera.project(pose.inverse().apply(points))
            pixel = np.where(inside[:, None], uv, 0.0).astype(int)
            values.append(frame.load_srgb8().mean(axis=2)[pixel[:, 1], pixel[:, 0]])
            insides.append(inside)
        both = insides[0] & insides[1]
        found.append(np.corrcoef(values[0][both], values[1][both])[0, 1])
    return float(np.mean(found))


def test_real_points_fall_onto_pixel_centres(real: DrivingLog) -> None:
    """The sample's points were made of depth at pixel centres: calibration and half-pixel."""
    frame, lazy = real.frames[0], real.sweeps[0]
    sweep = lazy.load()
    # At the time of the picture, without the motion within the sweep.
    poses = real.ego.held_at(sweep.time_ns + np.round(sweep.time_offset_s * 1e9).astype(np.int64))
    local = np.einsum(
        "nji,nj->ni", poses[:, :3, :3], sweep.points_world.astype(np.float64) - poses[:, :3, 3]
    )
    points = real.ego.at(frame.time_ns).apply(local)
    uv, inside = real.cameras["image_02"].project(frame.world_from_camera.inverse().apply(points))
    off = np.abs(uv[inside] % 1.0 - 0.5)
    assert inside.mean() > 0.99
    assert (off < 0.05).mean() > 0.95
