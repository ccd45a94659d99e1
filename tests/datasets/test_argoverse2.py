"""The Argoverse 2 reader: a made log with known truth, a real log without pictures, damage."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from datasets import argoverse2_log as made
from datasets.argoverse2_log import (
    FRONT,
    LOG,
    START_NS,
    SWEEP,
    Columns,
    box_columns,
    intrinsics_columns,
    mounting_columns,
    pose_columns,
    sweep_columns,
    write_argoverse2_log,
    write_table,
)
from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.core.solar import solar_position
from lightsim.datasets.argoverse2.log import read_actors, read_sweeps
from lightsim.datasets.argoverse2.places import (
    CITIES,
    convergence_deg,
    latitude_longitude_deg,
    utm_m,
)
from lightsim.datasets.argoverse2.poses import read_ego, read_mounting
from lightsim.datasets.argoverse2.sweeps import EGO_FROM_AXLE, load_sweep
from lightsim.datasets.argoverse2.tracks import KIND_BY_LABEL, read_boxes
from lightsim.datasets.feather import read_feather
from lightsim.datasets.fingerprint import hash_recording
from lightsim.datasets.reader import read_log
from lightsim.errors import InputError

UTC = "2021-06-21T17:00:00"
BOXES, POSES = "annotations.feather", "city_SE3_egovehicle.feather"
MOUNTING = "calibration/egovehicle_SE3_sensor.feather"
INTRINSICS = "calibration/intrinsics.feather"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_argoverse2_log(tmp_path_factory.mktemp("argoverse2") / "val")


@pytest.fixture(scope="module")
def log(folder: Path) -> DrivingLog:
    return read_log(LogReading(source=str(folder), utc=UTC))


def test_pictures_have_their_own_times_and_poses(log: DrivingLog) -> None:
    assert list(log.cameras) == ["ring_front_center", "ring_rear_left"]
    camera = log.cameras["ring_front_center"]
    assert (camera.width_px, camera.height_px) == made.SIZE_PX["ring_front_center"]
    assert (camera.fx, camera.cx, camera.cy) == (made.FOCAL_PX, 24.0, 32.0)
    for name in log.cameras:
        frames = log.frames_of(name)
        times = [made.picture_ns(name, i) for i in range(2 * made.N_SWEEPS)]
        assert [frame.time_ns for frame in frames] == times
        expected = [made.city_from_axle(made.CAMERA_M[name][None], t)[0] for t in times]
        found = [f.world_from_camera.translation_m + np.array(log.origin_m) for f in frames]
        np.testing.assert_allclose(found, expected, atol=1e-6)
        assert all(frame.shutter is None for frame in frames), "all rows are read at once"
    assert log.frames[0].load_srgb8().shape == (64, 48, 3)


def test_corners_of_a_box_fall_where_they_are(log: DrivingLog) -> None:
    """Pinhole projection by hand: the distortion of intrinsics.feather is not applied."""
    parked = _actor(log, "parked")
    frame = log.frames_of("ring_front_center")[3]
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    corners = signs * made.PARKED_LWH_M / 2
    uv, _ = frame.project(
        log.cameras["ring_front_center"],
        parked.world_from_actor(frame.time_ns).apply(corners),
    )
    driven = made.SPEED_M_S * (frame.time_ns - START_NS) * 1e-9
    seen = corners + made.PARKED_M - [driven, 0, 0] - made.CAMERA_M["ring_front_center"]
    expected = np.stack(
        [
            24 - made.FOCAL_PX * seen[:, 1] / seen[:, 0],
            32 - made.FOCAL_PX * seen[:, 2] / seen[:, 0],
        ],
        axis=1,
    )
    np.testing.assert_allclose(uv, expected, atol=1e-6)


def test_the_ego_frame_is_on_the_road(log: DrivingLog) -> None:
    pose = log.ego.at(START_NS)
    expected = made.START_M - [0, 0, made.AXLE_M] - np.array(log.origin_m)
    np.testing.assert_allclose(pose.translation_m, expected, atol=1e-9)
    assert np.degrees(pose.yaw_rad) == pytest.approx(made.HEADING_DEG)


def test_returns_and_sensors_are_where_they_were(log: DrivingLog) -> None:
    """Returns are compensated to the start of the sweep, the LiDARs move on during it."""
    columns = sweep_columns()
    xyz = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
    is_down = columns["laser_number"] >= 32
    mounted = np.where(is_down[:, None], made.DOWN_M, made.UP_M)
    for number, lazy in enumerate(log.sweeps):
        sweep = lazy.load()
        stamp = START_NS + number * made.SWEEP_NS
        assert sweep.time_ns == stamp
        points = made.city_from_axle(xyz, stamp) - log.origin_m
        np.testing.assert_allclose(sweep.points_world, points, atol=1e-3)
        moved = made.ego_m(stamp + columns["offset_ns"].astype(np.int64)) - made.ego_m(stamp)
        origins = made.city_from_axle(mounted, stamp) + moved - log.origin_m
        np.testing.assert_allclose(sweep.origins_world, origins, atol=1e-3)
        np.testing.assert_allclose(sweep.time_offset_s, columns["offset_ns"] * 1e-9, atol=1e-7)
        np.testing.assert_allclose(sweep.intensity, 0.2, atol=1e-6)
    assert len(log.sweeps) == made.N_SWEEPS


def test_boxes_are_timed_when_they_are_scanned(log: DrivingLog) -> None:
    parked, ahead = _actor(log, "parked"), _actor(log, "ahead")
    assert (parked.kind, ahead.kind) == (ActorKind.CAR, ActorKind.TRUCK)
    assert (parked.is_moving, ahead.is_moving) == (False, True)
    np.testing.assert_allclose(ahead.size_lwh_m, made.AHEAD_LWH_M)
    expected = made.city_from_axle(made.PARKED_M[None], START_NS) - log.origin_m
    np.testing.assert_allclose(parked.trajectory.positions_m, np.tile(expected, (4, 1)), atol=1e-6)
    stamps = START_NS + made.SWEEP_NS * np.arange(made.N_SWEEPS)
    positions = [made.city_from_axle(made.AHEAD_M[None], int(t))[0] for t in stamps]
    np.testing.assert_allclose(
        ahead.trajectory.positions_m, np.array(positions) - log.origin_m, atol=1e-6
    )
    # Straight ahead: the upper LiDAR is there after a quarter turn, the lower one after three.
    scans = made.scan_s(np.zeros(2), np.array([False, True]))
    scanned_s = (ahead.trajectory.times_ns - stamps) * 1e-9
    np.testing.assert_allclose(scanned_s, scans.mean(), atol=1.5e-3)


def test_place_north_and_sun(log: DrivingLog) -> None:
    geo = log.geo
    assert geo is not None
    assert geo.place is not None
    place = (geo.place.latitude_deg, geo.place.longitude_deg)
    np.testing.assert_allclose(place, (40.463, -79.952), atol=1e-3)
    # 1.05 degrees east of the central meridian: grid north is 1.05 sin(40.46) east of true north.
    assert geo.heading_deg == pytest.approx(90.680, abs=2e-3)
    assert geo.heading_origin == "map"
    sun = geo.sun_at(log.frames[0].time_ns)
    expected = solar_position(*place, 1_624_294_800 * 10**9)
    assert sun is not None
    assert sun.azimuth_deg == pytest.approx(expected.azimuth_deg, abs=1e-6)
    direction = geo.direction_at(log.frames[0].time_ns)
    assert direction is not None
    turned_deg = np.degrees(np.arctan2(direction[1], direction[0]))
    assert turned_deg == pytest.approx(90.680 - sun.azimuth_deg, abs=2e-3)


def test_without_a_clock_there_is_no_sun(folder: Path) -> None:
    log = read_log(LogReading(source=str(folder)))
    assert log.geo is not None
    assert log.geo.sun_at(log.frames[0].time_ns) is None
    notes = " / ".join(log.notes)
    assert "no real date and time" in notes
    assert "stereo_front_left: grey pictures" in notes
    assert "no pictures of ring_front_left, ring_front_right" in notes
    assert log.licence.startswith("CC BY-NC-SA 4.0")


@pytest.mark.parametrize(
    ("name", "city_m", "expected"),
    [
        ("ATX", (1745.37, -1421.37), (30.261642967615092, -97.72246957081633)),
        ("WDC", (2139.70, 4606.14), (38.931286945069985, -77.0120195048271)),
    ],
)
def test_positions_in_cities(
    name: str, city_m: tuple[float, float], expected: tuple[float, float]
) -> None:
    """Positions that av2-api computes with PROJ (tests/unit/geometry/test_utm.py)."""
    np.testing.assert_allclose(latitude_longitude_deg(CITIES[name], *city_m), expected, atol=1e-7)


@pytest.mark.parametrize("name", CITIES)
def test_grid_north(name: str) -> None:
    """Against the grid itself: a step to true north leads away from grid north by the negative
    convergence."""
    city = CITIES[name]
    place = (city.latitude_deg, city.longitude_deg)
    before, after = (utm_m(place[0] + s, place[1], city.meridian_deg) for s in (-1e-4, 1e-4))
    true_north_deg = np.degrees(np.arctan2(after[0] - before[0], after[1] - before[1]))
    assert convergence_deg(city, *place) == pytest.approx(-true_north_deg, abs=1e-3)


def test_stereo_cameras_are_read_if_named(folder: Path) -> None:
    log = read_log(LogReading(source=str(folder), cameras=("stereo_front_left",)))
    assert list(log.cameras) == ["stereo_front_left"]
    pixels = log.frames[0].load_srgb8()
    assert pixels.shape == (48, 64, 3)
    assert (pixels[..., 0] == pixels[..., 2]).all()


def test_a_scene_of_a_data_set_is_chosen(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "av2" / "val" / LOG)
    shutil.copytree(folder, tmp_path / "av2" / "train" / "9f-other")
    (tmp_path / "av2" / "train" / "notes").mkdir()
    sources = [(tmp_path / "av2", "0a1b"), (tmp_path / "av2", LOG), (tmp_path / "av2" / "val", "")]
    for source, scene in sources:
        log = read_log(LogReading(source=str(source), scene=scene))
        assert log.name == LOG
        hashed = hash_recording(LogReading(source=str(source), scene=scene))
        assert all(LOG in name and "stereo" not in name for name in hashed)
        assert any(name.endswith(SWEEP) for name in hashed)
    for scene, message in (("", "2 logs"), ("7", "no log of this name")):
        with pytest.raises(InputError, match=rf"{message}.*--scene.*{LOG}, 9f-other"):
            read_log(LogReading(source=str(tmp_path / "av2"), scene=scene))
    with pytest.raises(InputError, match=f"a part of the log .*{LOG}.*lightsim build"):
        read_log(LogReading(source=str(tmp_path / "av2" / "val" / LOG / "sensors")))


def test_what_is_missing_is_survived_and_noted(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "log"))
    (copy / SWEEP).unlink()
    (copy / BOXES).unlink()
    shutil.rmtree(copy / "map")
    sorted((copy / FRONT).iterdir())[2].unlink()
    (copy / FRONT / "thumbnail.jpg").write_text("")
    for path in (copy / "sensors/lidar").iterdir():
        # Trust, but Verify has no times of returns.
        write_table(path, {k: v for k, v in sweep_columns().items() if k != "offset_ns"})
    log = read_log(LogReading(source=str(copy)))
    notes = " / ".join(log.notes)
    for part in (
        "ring_front_center: no picture for 1 of 8 frames",
        "ring_front_center: thumbnail.jpg are not used",
        "the log has no labelled boxes",
        "returns have no times of their own",
        "the city is unknown: no file with a city in its name in map/",
    ):
        assert part in notes
    assert len(log.sweeps) == made.N_SWEEPS - 1
    sweep = log.sweeps[0].load()
    assert (sweep.time_offset_s == 0).all()
    assert log.geo is not None
    columns = sweep_columns()
    columns["x"][:5] = np.inf
    write_table(sorted((copy / "sensors/lidar").iterdir())[0], columns)
    assert len(log.sweeps[0].load().points_world) == made.N_RETURNS - 5
    assert (log.geo.place, log.geo.heading_deg) == (None, pytest.approx(90.0))


def test_every_category_has_a_kind() -> None:
    """Thirty categories of the taxonomy, one of which has two names."""
    assert len(KIND_BY_LABEL) == 31
    assert ActorKind.OTHER not in KIND_BY_LABEL.values()


def test_unknown_labels_and_repeated_boxes_are_noted(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "log"))
    columns = box_columns()
    columns["category"] = ["HOVERCRAFT"] * 8
    columns["timestamp_ns"][1] = columns["timestamp_ns"][0]
    columns["timestamp_ns"][7] += 10**12
    write_table(copy / BOXES, columns)
    log = read_log(LogReading(source=str(copy)))
    assert {(a.label, a.kind, len(a.trajectory)) for a in log.actors} == {
        ("HOVERCRAFT", ActorKind.OTHER, 3)
    }
    notes = " / ".join(log.notes)
    assert "1 boxes repeat an actor of the same sweep" in notes
    assert "1 boxes lie beyond the ego path" in notes
    assert "neither vehicles nor persons: 2 x 'HOVERCRAFT'" in notes


Break = Callable[[Path], object]


def change(name: str, columns: Callable[[], Columns], **values: object) -> Break:
    """Write a table with other columns; None removes one."""

    def apply(log: Path) -> None:
        table = {**columns(), **values}
        write_table(log / name, {k: v for k, v in table.items() if v is not None})

    return apply


def one_cell(name: str, columns: Callable[[], Columns], column: str, value: object) -> Break:
    def apply(log: Path) -> None:
        table = columns()
        cells = list(table[column])
        cells[1] = value
        write_table(log / name, {**table, column: cells})

    return apply


def cut(name: str, fraction: float) -> Break:
    def apply(log: Path) -> None:
        data = (log / name).read_bytes()
        (log / name).write_bytes(data[: int(len(data) * fraction)])

    return apply


def claim(log: Path) -> None:
    """A compressed column that claims a terabyte."""
    path = log / SWEEP
    data = path.read_bytes()
    # The frame of LZ4 (magic 0x184d2204) follows the claimed size.
    at = data.index(b"\x04\x22\x4d\x18") - 8
    path.write_bytes(data[:at] + struct.pack("<q", 1 << 40) + data[at + 8 :])


def nested(log: Path) -> None:
    write_table(log / SWEEP, {**sweep_columns(), "extra": [[1]] * made.N_RETURNS})


def encoded(log: Path) -> None:
    import pyarrow as pa

    columns = mounting_columns()
    columns["sensor_name"] = pa.array(columns["sensor_name"]).dictionary_encode()
    write_table(log / MOUNTING, columns)


def picture(name: str, size: tuple[int, int]) -> Break:
    return lambda log: Image.new("RGB", size).save(log / FRONT / name)


PICTURE = f"{made.picture_ns('ring_front_center', 0)}.jpg"
CASES: list[tuple[str, Break, str]] = [
    ("truncated sweep", cut(SWEEP, 0.5), rf"{START_NS}\.feather: .*truncated"),
    ("empty sweep file", cut(SWEEP, 0), r"\.feather: .*not a Feather file of version 2"),
    (
        "web page",
        lambda log: (log / BOXES).write_text("<html>"),
        r"annotations\.feather: .*got a web page",
    ),
    ("claim of a terabyte", claim, r"\.feather: the table is too large"),
    ("nested column", nested, r"\.feather: the column 'extra' has an unknown type, got list"),
    ("encoded column", encoded, r"sensor\.feather: .*neither a schema nor rows"),
    ("sweep without column", change(SWEEP, sweep_columns, y=None), "the column 'y' is missing"),
    ("sweep of text", change(SWEEP, sweep_columns, x=["a"] * 720), "the column 'x' has the wrong"),
    (
        "sweep of NaN",
        change(SWEEP, sweep_columns, x=np.full(720, np.nan)),
        "the sweep has no valid point",
    ),
    (
        "sweep without rows",
        change(SWEEP, lambda: {k: v[:0] for k, v in sweep_columns().items()}),
        "no valid point",
    ),
    (
        "laser of another LiDAR",
        change(SWEEP, sweep_columns, laser_number=np.full(720, 64)),
        r"\.feather: the column 'laser_number' contains a value that is not an id",
    ),
    (
        "returns of another sweep",
        change(SWEEP, sweep_columns, offset_ns=np.full(720, 7 * 10**9)),
        r"\.feather: the points' times are not those of the sweep",
    ),
    ("empty cell", one_cell(SWEEP, sweep_columns, "x", None), r"\.feather, row 1: a cell of .*'x'"),
    ("missing poses", lambda log: (log / POSES).unlink(), r"ego.*\.feather: cannot open"),
    ("NaN pose", one_cell(POSES, pose_columns, "tx_m", np.nan), r"\.feather, row 1: .*not finite"),
    ("far pose", one_cell(POSES, pose_columns, "tx_m", 1e9), r"\.feather, row 1: .*too far"),
    (
        "zero quaternions",
        change(POSES, pose_columns, qw=np.zeros(83), qz=np.zeros(83)),
        r"\.feather, row 0: the rotation is not a unit quaternion",
    ),
    (
        "times of text",
        change(POSES, pose_columns, timestamp_ns=["now"] * 83),
        "'timestamp_ns' has the wrong type",
    ),
    (
        "pose of another decade",
        one_cell(POSES, pose_columns, "timestamp_ns", 10_000_000),
        r"egovehicle\.feather: the times of the poses are not of one drive",
    ),
    (
        "negative time",
        one_cell(POSES, pose_columns, "timestamp_ns", -1),
        "'timestamp_ns' contains a value",
    ),
    ("poses without rows", change(POSES, lambda: {k: v[:0] for k, v in pose_columns().items()}),
     r"\.feather: the file has no poses"),
    ("missing mounting", lambda log: (log / MOUNTING).unlink(), r"sensor\.feather: cannot open"),
    (
        "sensor beside the vehicle",
        one_cell(MOUNTING, mounting_columns, "tx_m", 99.0),
        r"sensor\.feather, ring_rear_left: the sensor is not on the vehicle",
    ),
    (
        "camera without mounting",
        one_cell(MOUNTING, mounting_columns, "sensor_name", "other"),
        r"sensor\.feather: the camera 'ring_rear_left' is not calibrated",
    ),
    (
        "no lower LiDAR",
        change(MOUNTING, lambda: {k: v[:4] for k, v in mounting_columns().items()}),
        r"sensor\.feather: the LiDAR 'down_lidar' is not calibrated",
    ),
    (
        "camera without intrinsics",
        one_cell(INTRINSICS, intrinsics_columns, "sensor_name", "other"),
        r"intrinsics\.feather: the camera 'ring_rear_left' is not calibrated",
    ),
    (
        "focal length zero",
        change(INTRINSICS, intrinsics_columns, fx_px=np.zeros(3)),
        r"intrinsics\.feather/ring_front_center: .*do not fit",
    ),
    (
        "width of nothing",
        change(INTRINSICS, intrinsics_columns, width_px=np.zeros(3)),
        "'width_px' contains a value",
    ),
    ("box at NaN", one_cell(BOXES, box_columns, "tx_m", np.nan), r"annotations\.feather, row 1"),
    ("box without size", one_cell(BOXES, box_columns, "width_m", 0.0), "row 1 .*a box has no size"),
    ("box of a mile", one_cell(BOXES, box_columns, "length_m", 1600.0), "row 1 .*box is too large"),
    ("box on the moon", one_cell(BOXES, box_columns, "tx_m", 4e8), "row 1 .*beyond the LiDAR's"),
    ("box without id", one_cell(BOXES, box_columns, "track_uuid", ""), "row 1: .*'track_uuid'"),
    ("label of lines", one_cell(BOXES, box_columns, "category", "A\nB"), "row 1: .*'category'"),
    ("picture of another size", picture(PICTURE, (24, 32)), r"\.jpg: the picture's size differs"),
    ("picture like a ribbon", picture(PICTURE, (2, 900)), r"\.jpg: .*aspect ratio is too large"),
    ("truncated picture", cut(f"{FRONT}/{PICTURE}", 0.6), r"\.jpg: the picture cannot be read"),
    (
        "no pictures",
        lambda log: shutil.rmtree(log / "sensors/cameras"),
        r"sensors/cameras: the log has no pictures.*Sensor data set.*s5cmd",
    ),
    (
        "stereo pictures alone",
        lambda log: [shutil.rmtree(log / "sensors/cameras" / n) for n in list(made.SIZE_PX)[:2]],
        "the log has no pictures",
    ),
    ("a file for a folder", lambda log: [shutil.rmtree(log / FRONT), (log / FRONT).touch()],
     r"ring_front_center: the path has the wrong type"),
]  # fmt: skip


def read_everything(folder: Path) -> tuple[int, int]:
    log = read_log(LogReading(source=str(folder)))
    pictures = [frame.load_srgb8() for frame in log.frames]
    return len(pictures), len([sweep.load() for sweep in log.sweeps])


def test_the_unbroken_log_reads(folder: Path) -> None:
    assert read_everything(folder) == (4 * made.N_SWEEPS, made.N_SWEEPS)


@pytest.mark.parametrize(
    ("break_log", "message"), [c[1:] for c in CASES], ids=[c[0] for c in CASES]
)
def test_a_broken_log_raises_an_error_that_names_the_file(
    folder: Path, tmp_path: Path, break_log: Break, message: str
) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "log"))
    break_log(copy)
    with pytest.raises(InputError, match=message) as caught:
        read_everything(copy)
    assert str(copy) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def real(shared_data: Path) -> Path:
    folder = shared_data / "anylog" / "av2" / "val" / "7fab2350-7eaf-3b7e-a39d-6937a4c1bede"
    if not folder.is_dir():
        pytest.skip(f"needs the log at {folder}")
    return folder


@pytest.fixture(scope="module")
def pictured(real: Path, tmp_path_factory: pytest.TempPathFactory) -> DrivingLog:
    """The real log with grey pictures at the times of its sweeps, since it has none."""
    folder = Path(shutil.copytree(real, tmp_path_factory.mktemp("real") / real.name))
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755)
    camera = folder / FRONT
    camera.mkdir(parents=True)
    for path in (folder / "sensors/lidar").iterdir():
        Image.new("L", (1550, 2048), 128).save(camera / f"{path.stem}.jpg")
    return read_log(LogReading(source=str(folder)))


def test_a_real_log_without_pictures_is_refused(real: Path) -> None:
    with pytest.raises(InputError, match=r"has no pictures.*av2/sensor/val/7fab2350"):
        read_log(LogReading(source=str(real.parent), scene="7fab"))


def test_real_boxes_hold_the_returns_that_the_labels_count(real: Path) -> None:
    """num_interior_pts is met exactly, in all 162 boxes: 0.32 m, a swapped axis or another sweep
    would not."""
    origins = np.stack([read_mounting(real)[n].translation_m for n in ("up_lidar", "down_lidar")])
    boxes = read_boxes(real / BOXES)
    counts = read_feather(real / BOXES, ("num_interior_pts",), max_rows=20_000)["num_interior_pts"]
    found: dict[int, int] = {}
    for path in (real / "sensors/lidar").iterdir():
        points = load_sweep(path, origins).points
        for row in np.flatnonzero(boxes.stamps_ns == int(path.stem)).tolist():
            pose = boxes.ego_from_box[row]
            inside = np.abs((points - pose[:3, 3]) @ pose[:3, :3]) <= boxes.sizes_lwh_m[row] / 2
            found[row] = int(inside.all(axis=1).sum())
    assert len(found) == 162
    difference = sum(abs(n - int(counts[row])) for row, n in found.items())
    assert difference <= 0.002 * sum(found.values()), "float16 corners may round either way"
    assert sum(found.values()) > 18_000


def test_real_ego_path_is_on_the_ground_of_the_map(real: Path) -> None:
    ego, _ = read_ego(real)
    heights = ground_heights_m(real, ego.positions_m)
    above_m = ego.positions_m[:, 2] - heights
    assert abs(np.median(above_m)) < 0.02
    assert above_m.std() < 0.05


def test_real_returns_lie_on_the_ground_of_the_map(pictured: DrivingLog, real: Path) -> None:
    """Both sweeps, merged over the ego's motion: returns within 0.3 m of the map's ground are on it
    within some 4 cm; from the mirrored or turned vehicle they would not be."""
    for lazy in pictured.sweeps:
        sweep = lazy.load()
        points = sweep.points_world.astype(np.float64) + pictured.origin_m
        away = np.linalg.norm(points - (sweep.origins_world + pictured.origin_m), axis=1)
        above_m = points[:, 2] - ground_heights_m(real, points)
        is_near = (away < 25) & (np.abs(above_m) < 0.3)
        assert is_near.sum() > 10_000
        assert abs(np.median(above_m[is_near])) < 0.04
        assert np.median(np.abs(above_m[is_near] - np.median(above_m[is_near]))) < 0.04


def test_real_beams_are_sharp_from_the_two_lidars(pictured: DrivingLog, real: Path) -> None:
    """Elevations of one laser in its LiDAR's own frame are constant: from the other LiDAR's
    position they scatter more."""
    mounting = read_mounting(real)
    sweep = pictured.sweeps[0].load()
    ego = pictured.ego.at(sweep.time_ns)
    rays = sweep.points_world.astype(np.float64) - sweep.origins_world
    for name, low in (("up_lidar", 0), ("down_lidar", 32)):
        other = mounting["down_lidar" if name == "up_lidar" else "up_lidar"].translation_m
        shift = ego.rotate((mounting[name].translation_m - other)[None])[0]
        spread = []
        for vectors in (rays, rays + shift):
            # Rotated twice: the pose of the ego, and that of the LiDAR.
            local = ego.inverse().rotate(vectors) @ mounting[name].rotation
            away = np.linalg.norm(local, axis=1)
            elevation = np.degrees(np.arcsin(local[:, 2] / away))
            spread.append(
                np.median(
                    [
                        _spread(elevation[(sweep.ring == laser) & (away < 12)])
                        for laser in range(low, low + 32)
                        if ((sweep.ring == laser) & (away < 12)).sum() > 100
                    ]
                )
            )
        assert spread[0] < 0.2, name
        assert spread[0] < 0.8 * spread[1], name


def test_real_moving_vehicles_hold_their_returns(pictured: DrivingLog, real: Path) -> None:
    """Of the returns that labels count in boxes of vehicles above 9 m/s, 92 % are inside at the
    time of the scan; with boxes at the time stamps, 44 % would be, as boxes would be ahead."""
    columns = read_feather(
        real / BOXES, ("timestamp_ns", "num_interior_pts"), texts=("track_uuid",), max_rows=20_000
    )
    keys = zip(columns["timestamp_ns"].tolist(), columns["track_uuid"], strict=True)
    counts = dict(zip(keys, columns["num_interior_pts"].tolist(), strict=True))
    labelled, inside = 0, [0, 0]
    for lazy in pictured.sweeps:
        sweep = lazy.load()
        for actor in pictured.actors:
            if not _is_fast(actor, sweep.time_ns):
                continue
            labelled += counts[sweep.time_ns, actor.actor_id]
            path = actor.trajectory
            for i, delay_ns in enumerate((0, 66_000_000)):
                early = Trajectory(path.dst, path.src, path.times_ns - delay_ns, path.matrices)
                moved = ActorTrack(actor.actor_id, actor.kind, actor.size_lwh_m, early, True)
                inside[i] += len(moved.returns_inside(sweep.points_world, sweep.times_ns, 0.0)[0])
    assert labelled > 350
    assert inside[0] > 0.88 * labelled
    assert inside[1] < 0.6 * labelled


def _is_fast(actor: ActorTrack, time_ns: int) -> bool:
    if not (actor.kind.is_vehicle and actor.is_present(time_ns)):
        return False
    path = actor.trajectory
    steps_m = np.linalg.norm(np.diff(path.positions_m, axis=0), axis=1)
    speeds = steps_m / (np.diff(path.times_ns) * 1e-9)
    after = int(np.searchsorted(path.times_ns, time_ns))
    return float(speeds[min(after, len(speeds) - 1)]) > 9.0


def test_real_actors(real: Path) -> None:
    ego, _ = read_ego(real)
    sweeps, _ = read_sweeps(real, read_mounting(real))
    actors, notes = read_actors(real, ego, sweeps)
    assert (len(actors), notes) == (114, ())
    assert sum(actor.is_moving for actor in actors) == 39
    for actor in actors:
        steps = np.diff(actor.trajectory.positions_m, axis=0)[:, :2]
        is_long = np.linalg.norm(steps, axis=1) > 0.3
        if actor.kind.is_vehicle and is_long.sum() > 5:
            forward = actor.trajectory.matrices[:-1, :2, 0]
            cosine = (steps * forward).sum(axis=1) / np.linalg.norm(steps, axis=1).clip(1e-9)
            assert np.degrees(np.arccos(np.median(cosine[is_long]))) < 10, actor.actor_id


def ground_heights_m(folder: Path, points_city: np.ndarray) -> np.ndarray:
    """Heights of the map's ground at points; NaN where it has none (av2-api, src/av2/map)."""
    import json

    grid = np.load(next((folder / "map").glob("*ground_height_surface*.npy"))).astype(np.float64)
    to_grid = json.loads(next((folder / "map").glob("*img_Sim2_city.json")).read_text())
    at = np.floor((points_city[:, :2] + to_grid["t"]) * to_grid["s"]).astype(np.int64)
    is_in = ((at >= 0) & (at < grid.shape[::-1])).all(axis=1)
    at = np.where(is_in[:, None], at, 0)
    return np.where(is_in, grid[at[:, 1], at[:, 0]], np.nan)


def _spread(values: np.ndarray) -> float:
    return float(np.percentile(values, 84) - np.percentile(values, 16)) / 2


def _actor(log: DrivingLog, name: str) -> ActorTrack:
    return next(actor for actor in log.actors if actor.actor_id == name)


def test_the_axle_is_a_tyre_above_the_road() -> None:
    assert EGO_FROM_AXLE.translation_m.tolist() == [0.0, 0.0, made.AXLE_M]
