"""The reader of lightsim-log/1 folders: a made log with known truth, and a real one."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from datasets.lightsim_log import (
    AZIMUTH_DEG,
    CAR_SIZE,
    EGO_FROM_FRONT,
    EGO_FROM_LEFT,
    EGO_FROM_LIDAR,
    LATITUDE_DEG,
    LONGITUDE_DEG,
    N_POINTS,
    POSE,
    READOUT_S,
    SPEED_M_S,
    START_NS,
    UTC_MINUS_LOG_NS,
    header,
    picture_times,
    posts,
    row,
    sweep_columns,
    sweep_times,
    world_from_car,
    world_from_ego,
    write_header,
    write_lightsim_mini,
    write_table,
)
from datasets.point_writers import write_bin, write_pcd, write_ply
from lightsim.core.actors import ActorKind
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.datasets.reader import check_layout, read_log
from lightsim.errors import InputError
from lightsim.masks.ego_vehicle import ego_vehicle_masks

MM = 1e-3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_lightsim_mini(tmp_path_factory.mktemp("lightsim") / "log")


@pytest.fixture(scope="module")
def log(folder: Path) -> DrivingLog:
    return read_log(LogReading(source=str(folder)))


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "log"))


def read(folder: Path, **options: Any) -> DrivingLog:
    return read_log(LogReading(source=str(folder), **options))


def notes_of(log: DrivingLog) -> str:
    return " / ".join(log.notes)


def test_the_layout_is_recognised(folder: Path, tmp_path: Path) -> None:
    assert check_layout(LogReading(source=str(folder))) == "lightsim"
    with pytest.raises(InputError, match=r"a part of the recording.*lightsim build .*log"):
        read(folder / "images")
    with pytest.raises(InputError, match="a folder of 1 recordings"):
        read(folder.parent)
    (tmp_path / "log.json").write_text("{}")
    with pytest.raises(InputError, match="does not have the layout"):
        read(tmp_path)


@pytest.mark.parametrize("name", ["front", "left"])
def test_each_picture_has_its_own_time_and_pose(log: DrivingLog, name: str) -> None:
    mounting = {"front": EGO_FROM_FRONT, "left": EGO_FROM_LEFT}[name]
    # The frame's time is the middle of the readout; front is stamped at its start.
    after_ns = round(READOUT_S * 5e8) if name == "front" else 0
    frames = log.frames_of(name)
    # A lens moves the time of the centre by microseconds.
    stamps = np.array(picture_times(name)) + after_ns
    assert np.abs(np.array([f.time_ns for f in frames]) - stamps).max() < 50_000
    assert [f.stem for f in frames] == ["0", "1", "2", "3"]
    for frame in frames:
        truth = world_from_ego(frame.time_ns) @ mounting
        found = frame.world_from_camera
        np.testing.assert_allclose(found.translation_m + log.origin_m, truth[:3, 3], atol=MM)
        np.testing.assert_allclose(found.rotation, truth[:3, :3], atol=1e-4)
        assert frame.shutter is not None
        down, across = frame.shutter.readout_s, frame.shutter.readout_across_s
        expected = (READOUT_S, 0.0) if name == "front" else (0.0, READOUT_S)
        np.testing.assert_allclose((down, across), expected, atol=2e-3)
        assert np.linalg.norm(frame.shutter.velocity_m_s) == pytest.approx(SPEED_M_S, rel=0.02)


def test_the_corners_of_a_box_fall_onto_the_right_pixels(log: DrivingLog) -> None:
    camera, frame = log.cameras["front"], log.frames_of("front")[1]
    (car,) = (a for a in log.actors if a.actor_id == "car-1")
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    own = car.world_from_actor(frame.time_ns).apply(signs * np.array(CAR_SIZE) / 2)
    uv, inside = camera.project(frame.world_from_camera.inverse().apply(own))
    truth = world_from_car(frame.time_ns)
    corners = (signs * np.array(CAR_SIZE) / 2) @ truth[:3, :3].T + truth[:3, 3]
    pose = world_from_ego(frame.time_ns) @ EGO_FROM_FRONT
    x, y, z = ((corners - pose[:3, 3]) @ pose[:3, :3]).T
    # cx, cy of OpenCV, plus half a pixel.
    np.testing.assert_allclose(uv, np.stack([60 * x / z + 32, 60 * y / z + 24], axis=1), atol=0.02)
    assert inside.any()


def test_points_are_where_they_were_though_the_sensor_moved(log: DrivingLog) -> None:
    for lazy, time_ns in zip(log.sweeps, sweep_times(), strict=True):
        sweep = lazy.load()
        assert sweep.time_ns == time_ns
        points = sweep.points_world.astype(np.float64) + log.origin_m
        np.testing.assert_allclose(points, posts(), atol=MM)
        offsets = sweep_columns(time_ns)["time_offset_s"].astype(np.float64)
        np.testing.assert_allclose(sweep.time_offset_s, offsets, atol=1e-7)
        for i in range(0, N_POINTS, 50):
            truth = world_from_ego(time_ns + round(float(offsets[i]) * 1e9)) @ EGO_FROM_LIDAR
            origin = sweep.origins_world[i].astype(np.float64) + log.origin_m
            np.testing.assert_allclose(origin, truth[:3, 3], atol=2 * MM)
        np.testing.assert_allclose(sweep.intensity, 0.2, atol=1e-6)
        assert sweep.ring.tolist() == (np.arange(N_POINTS) % 5).tolist()
        assert (sweep.semantic_class == 7).all()
    assert log.semantic_names == {7: "Wall"}
    assert log.licence == "CC0-1.0"


def test_north_and_the_sun_come_from_gps_and_the_local_clock(log: DrivingLog) -> None:
    geo = log.geo
    assert geo is not None
    assert geo.heading_deg == pytest.approx(AZIMUTH_DEG, abs=0.2)
    assert geo.clock is not None
    assert geo.clock.utc_minus_log_ns == UTC_MINUS_LOG_NS
    sun = geo.sun_at(log.frames[0].time_ns)
    assert sun is not None
    azimuth, elevation = approximate_sun((START_NS + UTC_MINUS_LOG_NS) * 1e-9)
    assert sun.azimuth_deg == pytest.approx(azimuth, abs=0.5)
    assert sun.elevation_deg == pytest.approx(elevation, abs=0.5)


def approximate_sun(utc_s: float) -> tuple[float, float]:
    """Low-precision formulas of the Astronomical Almanac, to 0.1 degrees."""
    days = utc_s / 86400.0 + 2440587.5 - 2451545.0
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude = np.radians(
        280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.02 * np.sin(2 * anomaly)
    )
    tilt = np.radians(23.439)
    ascension = np.arctan2(np.cos(tilt) * np.sin(longitude), np.cos(longitude))
    declination = np.arcsin(np.sin(tilt) * np.sin(longitude))
    sidereal = np.radians((280.46062 + 360.98564737 * days + LONGITUDE_DEG) % 360.0)
    hour, latitude = sidereal - ascension, np.radians(LATITUDE_DEG)
    up = np.sin(latitude) * np.sin(declination)
    up += np.cos(latitude) * np.cos(declination) * np.cos(hour)
    east = -np.cos(declination) * np.sin(hour)
    north = np.cos(latitude) * np.sin(declination)
    north -= np.sin(latitude) * np.cos(declination) * np.cos(hour)
    return float(np.degrees(np.arctan2(east, north)) % 360), float(np.degrees(np.arcsin(up)))


def test_tracks_masks_lenses_and_notes(log: DrivingLog) -> None:
    car, kiosk = sorted(log.actors, key=lambda a: a.actor_id)
    assert (car.kind, car.is_moving, car.label) == (ActorKind.CAR, True, "Car")
    assert (kiosk.kind, kiosk.is_moving) == (ActorKind.OTHER, False)
    np.testing.assert_allclose(car.size_lwh_m, CAR_SIZE)
    mask = log.ego_vehicle_masks["front"]
    assert mask[-6:].all()
    assert not mask[:-6].any()
    notes = notes_of(log)
    for part in (
        "ego.csv: 1 of 38 poses repeat a time",
        "left: brown lens, resampled to pinhole (left)",
        "fisheye: kannala_brandt lens, resampled to pinhole (fisheye",
        "unknown labels count as neither vehicles nor persons: 1 x 'Kiosk'",
    ):
        assert part in notes
    fisheye = [name for name in log.cameras if name.startswith("fisheye")]
    assert fisheye
    for frame in log.frames:
        camera = log.cameras[frame.camera_name]
        assert frame.load_srgb8().shape == (camera.height_px, camera.width_px, 3)


@pytest.mark.parametrize(
    ("suffix", "form", "write"),
    [
        (".ply", "ascii", write_ply),
        (".ply", "binary_little_endian", write_ply),
        (".pcd", "ascii", write_pcd),
        (".pcd", "binary", write_pcd),
        (".bin", "", write_bin),
    ],
)
def test_every_format_of_points_gives_the_same(
    copy: Path, log: DrivingLog, suffix: str, form: str, write: Callable[..., None]
) -> None:
    for time_ns in sweep_times():
        path = copy / "sweeps" / "top" / f"{time_ns}.npz"
        write(path.with_suffix(suffix), sweep_columns(time_ns), form)
        path.unlink()
    for lazy, own in zip(read(copy).sweeps, log.sweeps, strict=True):
        found, expected = lazy.load(), own.load()
        np.testing.assert_allclose(found.points_world, expected.points_world, atol=1e-5)
        np.testing.assert_allclose(found.time_offset_s, expected.time_offset_s, atol=1e-7)
        np.testing.assert_allclose(found.intensity, expected.intensity, atol=1e-6)
        if suffix != ".bin":
            assert (found.ring == expected.ring).all()
            assert (found.semantic_class == expected.semantic_class).all()


@pytest.mark.parametrize("time", ["start", "middle", "end"])
def test_points_at_sweep_time_keep_their_place_and_their_origins_are_midway(
    copy: Path, time: str
) -> None:
    lidar = header()["lidars"]["top"] | {"points": "at sweep time", "time": time}
    write_header(copy, header() | {"lidars": {"top": lidar}})
    for time_ns in sweep_times():
        pose = world_from_ego(time_ns) @ EGO_FROM_LIDAR
        xyz = (posts() - pose[:3, 3]) @ pose[:3, :3]
        np.savez(copy / "sweeps/top" / f"{time_ns}.npz", xyz=xyz, intensity=np.ones(N_POINTS))
    log = read(copy)
    sweep = log.sweeps[1].load()
    points = sweep.points_world.astype(np.float64) + log.origin_m
    np.testing.assert_allclose(points, posts(), atol=MM)
    middle_ns = {"start": 50_000_000, "middle": 0, "end": -50_000_000}[time]
    truth = world_from_ego(sweep.time_ns + middle_ns) @ EGO_FROM_LIDAR
    origins = sweep.origins_world.astype(np.float64) + log.origin_m
    np.testing.assert_allclose(origins, np.tile(truth[:3, 3], (N_POINTS, 1)), atol=2 * MM)
    assert "no time_offset_s" in notes_of(log)


def test_given_points_stand_in_for_lidar(copy: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Beams start at the nearest camera that sees a point; hidden and unseen points are left."""
    shutil.rmtree(copy / "sweeps")
    for time_ns in picture_times("front")[:3]:
        next((copy / "images" / "front").glob(f"{time_ns}.*")).unlink()
    start = world_from_ego(picture_times("front")[3]) @ EGO_FROM_FRONT
    ahead, hidden, behind = ([0.0, 0.0, 8.0], [0.0, 0.0, 12.0], [0.0, 0.0, -9.0])
    own = np.array([ahead, hidden, behind])
    points = own @ start[:3, :3].T + start[:3, 3]
    # Doubles: UTM coordinates have steps of 0.5 m in float32.
    lines = "".join(" ".join(f"{v:.6f}" for v in p) + "\n" for p in points)
    head = "ply\nformat ascii 1.0\nelement vertex 3\n"
    head += "".join(f"property double {a}\n" for a in "xyz") + "end_header\n"
    (copy / "points.ply").write_text(head + lines)
    log = read(copy, cameras=("front",))
    assert "no LiDAR: geometry comes from the given points of points.ply" in notes_of(log)
    assert [s.stem for s in log.sweeps] == ["3"]
    sweep = log.sweeps[0].load()
    np.testing.assert_allclose(sweep.points_world + log.origin_m, points[:1], atol=0.01)
    origin = sweep.origins_world[0] + log.origin_m
    np.testing.assert_allclose(origin, start[:3, 3], atol=0.01)
    assert "dropped 2 of 3 points that no camera sees" in caplog.text


def test_bits_that_are_no_numbers_are_dropped_without_a_warning(copy: Path) -> None:
    """Signalling NaN, which damaged binary files contain, warn where they are converted."""
    for time_ns in sweep_times():
        path = copy / "sweeps" / "top" / f"{time_ns}.npz"
        columns = sweep_columns(time_ns)
        columns["xyz"].view(np.uint32)[3] = 0x7F800001
        columns["xyz"][5] = np.inf
        write_pcd(path.with_suffix(".pcd"), columns, "binary")
        path.unlink()
    log = read(copy)
    assert [len(lazy.load().points_world) for lazy in log.sweeps] == [N_POINTS - 2] * 4


def test_missing_parts_are_survived_and_said(copy: Path) -> None:
    for name in ("boxes.csv", "gps.csv"):
        (copy / name).unlink()
    shutil.rmtree(copy / "images" / "left")
    shutil.rmtree(copy / "masks")
    (copy / "images" / "front" / f"{picture_times('front')[1]}.png").unlink()
    (copy / "sweeps" / "top" / f"{sweep_times()[2]}.npz").unlink()
    (copy / "images" / "front" / "first.jpg").write_bytes(b"x")
    (copy / "images" / "rear").mkdir()
    write_header(copy, header() | {"extra": 1})
    log = read(copy)
    notes = notes_of(log)
    for part in (
        "left: no picture in images/left",
        "front: no picture for 1 of 4 frames",
        "images/front: 1 files are not named by time",
        "images: 1 folders are not named in log.json and are not used: rear",
        "log.json: unknown entries are ignored: 'extra'",
        "no labelled boxes",
        "no GPS",
    ):
        assert part in notes, part
    assert len(log.sweeps) == 3
    shutil.rmtree(copy / "sweeps")
    assert read(copy).sweeps == ()


@pytest.mark.parametrize(
    ("clock", "offset_s"),
    [("utc", 0.0), ("local+02:00", -7200.0), ("local-05:30", 19800.0), ("utc+18s", -18.0)],
)
def test_clocks(copy: Path, clock: str, offset_s: float) -> None:
    write_header(copy, header() | {"clock": clock, "place": [LATITUDE_DEG, LONGITUDE_DEG]})
    (copy / "gps.csv").unlink()
    geo = read(copy).geo
    assert geo is not None
    assert geo.clock is not None
    assert geo.clock.utc_minus_log_ns == round(offset_s * 1e9)
    write_header(copy, header() | {"clock": "unknown", "place": [LATITUDE_DEG, LONGITUDE_DEG]})
    unknown = read(copy).geo
    assert unknown is not None
    assert unknown.clock is None
    assert unknown.sun_at(START_NS) is None


Change = Callable[[Path], object]


def entry(*keys: str, value: Any) -> Change:
    """Change one entry of log.json."""

    def change(folder: Path) -> None:
        document = header()
        inner = document
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value
        write_header(folder, document)

    return change


def cell(name: str, row: int, column: str, value: str) -> Change:
    def change(folder: Path) -> None:
        path = folder / name
        lines = [line.split(",") for line in path.read_text().splitlines()]
        lines[row][lines[0].index(column)] = value
        path.write_text("\n".join(",".join(line) for line in lines))

    return change


def sweep(**columns: Any) -> Change:
    path = f"sweeps/top/{sweep_times()[0]}.npz"
    return lambda f: np.savez(f / path, **{**sweep_columns(sweep_times()[0]), **columns})


def cut(name: str, fraction: float) -> Change:
    def change(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(len(data) * fraction)])

    return change


def write(name: str, data: bytes) -> Change:
    def change(folder: Path) -> None:
        for path in (folder / "sweeps" / "top").iterdir():
            path.unlink()
        (folder / name).write_bytes(data)

    return change


def picture_pose(shift: list[float], motion: list[float] | None = None) -> Change:
    """Give the first picture of the front camera a pose of its own."""
    time_ns = picture_times("front")[0]
    pose = world_from_ego(time_ns) @ EGO_FROM_FRONT
    pose[:3, 3] += shift
    names = f"camera {POSE} vx vy vz wx wy wz"
    cells = ["front", time_ns, *row(pose), *(motion or [0.0] * 6)]
    return lambda folder: write_table(folder / "camera_poses.csv", names, [cells])


FIRST = f"images/front/{picture_times('front')[0]}.jpg"
POINTS = f"sweeps/top/{sweep_times()[0]}"
PLY = b"ply\nformat ascii 1.0\nelement vertex %s\nproperty float x\nend_header\n1\n"
CASES: list[tuple[str, Change, str]] = [
    ("no header", lambda f: (f / "log.json").write_text("{"), r"log\.json: .*not valid JSON"),
    ("array", lambda f: write_header(f, []), r"log\.json: not a JSON object"),
    ("other format", entry("format", value="lightsim-log/9"), r"'format'.*lightsim-log/1"),
    ("no clock", entry("clock", value=None), r"'clock' is missing.*\"utc\""),
    ("odd clock", entry("clock", value="CEST"), r"'clock'.*CEST"),
    ("place", entry("place", value=[91, 0]), "not on Earth"),
    ("place of text", entry("place", value="Munich"), r"'place'.*latitude, longitude"),
    ("model", entry("cameras", "front", "model", value="pinhole2"), "cameras/front.*kannala"),
    ("NaN", entry("cameras", "front", "fx", value=float("nan")), "cameras/front, 'fx': .*finite"),
    ("focal", entry("cameras", "front", "fx", value=-1), "cameras/front.*intrinsics"),
    ("bool", entry("cameras", "front", "cx", value=True), "'cx': not a finite number"),
    ("size", entry("cameras", "front", "size_px", value=[64, 48, 3]), r"\[width, height\]"),
    ("huge", entry("cameras", "front", "size_px", value=[10**9, 10**9]), "size_px 1e"),
    ("other size", entry("cameras", "front", "size_px", value=[70, 48]), r"\.jpg.*64x48 px.*70x48"),
    ("half a pixel", entry("cameras", "front", "first_pixel_centre", value=1), "0.0 .OpenCV"),
    ("matrix", entry("cameras", "left", "ego_from_camera", value=[[1, 2]]), "left.*4 rows"),
    ("scale", entry("cameras", "left", "ego_from_camera", value=(2 * np.eye(4)).tolist()), "4 row"),
    ("far sensor", entry("cameras", "left", "ego_from_camera", value=[[1, 0, 0, 99],
     *np.eye(4)[1:].tolist()]), "not on the vehicle"),
    ("readout", entry("cameras", "left", "readout_s", value=5), "readout"),
    ("way", entry("cameras", "left", "readout", value="down"), "left_to_right"),
    ("distortion", entry("cameras", "left", "distortion", value=[0] * 9), "at most 8"),
    ("outside", entry("cameras", value={"../x": header()["cameras"]["left"]}), "valid file name"),
    ("points", entry("lidars", "top", "points", value="raw"), "raw, at their own times"),
    ("intensity", entry("lidars", "top", "intensity_max", value=0), "above 0"),
    ("class id", entry("point_classes", value={"x": "Wall"}), "point class"),
    ("no ego", lambda f: (f / "ego.csv").unlink(), r"ego\.csv: cannot open"),
    ("ego time", cell("ego.csv", 3, "time_ns", "1.6e18"), r"ego\.csv, row 3: .*whole nanosec"),
    ("ego text", cell("ego.csv", 3, "x", "far"), r"ego\.csv, row 3: the column 'x'"),
    ("ego NaN", cell("ego.csv", 3, "qx", "nan"), r"ego\.csv, row 3: the column 'qx'"),
    ("quaternion", cell("ego.csv", 3, "qw", "9"), r"ego\.csv, row 3: .*unit quaternion"),
    ("jump", cell("ego.csv", 20, "x", "700000"), "pose is too far"),
    ("column", cell("ego.csv", 0, "qw", "w"), r"ego\.csv: the column 'qw' is missing"),
    ("ragged", cell("ego.csv", 3, "x", "1,2"), r"ego\.csv, row 3: .*number of cells"),
    ("empty", lambda f: (f / "ego.csv").write_text(""), r"ego\.csv.*an empty file"),
    ("binary", lambda f: (f / "ego.csv").write_bytes(b"\xff\xfe\x00"), r"not a CSV table"),
    ("seconds", entry("clock", value="utc+1600000000s"), "between 1980 and 2100"),
    ("box size", cell("boxes.csv", 1, "width", "0"), r"boxes\.csv, row 1 \(track car-1\)"),
    ("long box", cell("boxes.csv", 1, "length", "4500"), "too large"),
    ("far box", cell("boxes.csv", 1, "x", "0"), "beyond"),
    ("no track", cell("boxes.csv", 1, "track", ""), "printable"),
    ("latitude", cell("gps.csv", 1, "latitude", "95"), r"gps\.csv, row 1"),
    ("gps of another day", lambda f: (f / "gps.csv").write_text(
        "time_ns,latitude,longitude\n1500000000000000000,1,2\n"), r"gps\.csv.*no GPS fix"),
    ("far picture", picture_pose([900.0, 0.0, 0.0]), r"camera_poses\.csv, front at .*too far"),
    ("fast picture", picture_pose([0.0] * 3, [1e6] * 6), r"camera_poses\.csv, front .*1\.732e\+06"),
    ("picture", cut(FIRST, 0.5), r"\.jpg: the picture cannot be read"),
    ("no picture", lambda f: (f / FIRST).write_text("x"), r"\.jpg: the picture cannot be read"),
    ("mask", lambda f: Image.new("L", (9, 9)).save(f / "masks/front.png"), "mask's size"),
    ("sweep", cut(f"{POINTS}.npz", 0.7), r"\.npz: the arrays cannot be read"),
    ("sweep of objects", sweep(ring=np.array([{}] * N_POINTS, dtype=object)), "cannot be read"),
    ("rows", sweep(ring=np.zeros(3)), r"\.npz: the column 'ring' does not fit"),
    ("shape", sweep(xyz=np.zeros((N_POINTS, 2))), r"the column 'xyz' does not fit"),
    ("ring", sweep(ring=np.full(N_POINTS, 0.5)), r"column 'ring'.*0\.5 in row 0"),
    ("times", sweep(time_offset_s=np.full(N_POINTS, 5.0)), "not those of the sweep"),
    ("nothing", sweep(xyz=np.full((N_POINTS, 3), np.nan)), "no valid point"),
    ("ply", write(f"{POINTS}.ply", b"ply\n"), r"\.ply: .*end_header"),
    ("ply count", write(f"{POINTS}.ply", PLY % b"99"), r"\.ply: .*1 numbers"),
    ("ply huge", write(f"{POINTS}.ply", PLY % b"9" * 12), r"\.ply"),
    ("ply without y", write(f"{POINTS}.ply", PLY % b"1"), r"\.ply: the file has no positions"),
    ("pcd", write(f"{POINTS}.pcd", b"DATA binary_compressed\n"), r"pcl_convert_pcd_ascii_binary"),
    ("bin", write(f"{POINTS}.bin", b"123"), r"\.bin: .*3 bytes.*20"),
]  # fmt: skip


def read_all(folder: Path) -> None:
    log = read(folder)
    for frame in log.frames:
        frame.load_srgb8()
    for lazy in log.sweeps:
        lazy.load()


@pytest.mark.parametrize(("name", "change", "message"), CASES, ids=[case[0] for case in CASES])
def test_broken_logs_give_one_error(copy: Path, name: str, change: Change, message: str) -> None:
    change(copy)
    with pytest.raises(InputError, match=message) as found:
        read_all(copy)
    assert len(str(found.value).splitlines()) == 1


@pytest.fixture(scope="module")
def real(shared_data: Path) -> DrivingLog:
    source = shared_data / "anylog" / "neutral" / "ddad_scene_02"
    if not source.is_dir():
        pytest.skip(f"needs {source}")
    return read_log(LogReading(source=str(source)), ego_vehicle_masks)


def test_real_log(real: DrivingLog) -> None:
    assert len(real.cameras) == 6
    assert len(real.frames) == 18
    assert len(real.sweeps) == 3
    assert len(real.actors) == 13
    assert real.cameras["CAMERA_01"].cx == pytest.approx(928.0218817 + 0.5)
    assert real.origin_m == (111.0, -2261.0, -13.0)


def labelled_rectangles(real: DrivingLog, shared_data: Path) -> list[tuple[Any, ...]]:
    """Return (frame, track, left, top, right, bottom) of DDAD's own labels of the pictures."""
    source = shared_data / "anylog" / "ddad" / "scene_02" / "bounding_box_2d"
    if not source.is_dir():
        pytest.skip(f"needs {source}")
    tracks = {actor.actor_id: actor for actor in real.actors}
    found = []
    for frame in real.frames:
        path = sorted((source / frame.camera_name).glob("*.json"))[int(frame.stem)]
        for label in json.loads(path.read_text())["annotations"]:
            x, y, w, h = (label["box"][key] for key in "xywh")
            found.append((frame, tracks[str(label["instance_id"])], x, y, x + w, y + h))
    return found


def test_real_boxes_fall_onto_the_labelled_rectangles(real: DrivingLog, shared_data: Path) -> None:
    """DDAD's rectangles are whole pixels below the corners, counted from the first pixel's centre:
    errors of +0.5 to +1.5 px. Half a pixel, the poses of another time (9 ms are 5 px) and other
    axes all break this."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    errors = []
    for frame, track, left, top, *_ in labelled_rectangles(real, shared_data):
        corners = track.world_from_actor(frame.time_ns).apply(signs * track.size_lwh_m / 2)
        uv, _ = real.cameras[frame.camera_name].project(
            frame.world_from_camera.inverse().apply(corners)
        )
        errors.append(uv.min(axis=0) - [left, top])
    assert len(errors) == 39
    np.testing.assert_allclose(np.median(errors, axis=0), 1.0, atol=0.15)
    assert np.min(errors) > 0.2
    assert np.max(errors) < 1.6


def test_real_returns_of_boxes_fall_into_the_labelled_rectangles(
    real: DrivingLog, shared_data: Path
) -> None:
    inside = total = 0
    for frame, track, left, top, right, bottom in labelled_rectangles(real, shared_data):
        sweep = next(s for s in real.sweeps if s.stem == frame.stem).load()
        points = sweep.points_world.astype(np.float64)
        own = points[track.contains(points, sweep.time_ns)]
        uv, _ = frame.project(real.cameras[frame.camera_name], own)
        low, high = np.array([left, top]) - 1.0, np.array([right, bottom]) + 2.0
        inside += int(((uv > low) & (uv < high)).all(axis=1).sum())
        total += len(own)
    assert total > 1000
    assert inside / total > 0.98
