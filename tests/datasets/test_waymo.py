"""The reader of the Waymo Open Dataset: made drives in both forms, and one real frame."""

from __future__ import annotations

import shutil
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tools.fuzz.mutations import mutate_bytes, pick

from datasets import waymo_log as made
from lightsim.core.actors import ActorKind
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.datasets.fingerprint import hash_recording
from lightsim.datasets.lenses import Lens
from lightsim.datasets.reader import read_log
from lightsim.datasets.waymo.frames import read_records
from lightsim.datasets.waymo.wire import Wire, open_tfrecord
from lightsim.errors import InputError, LightSimError, MissingDependencyError

REAL_NAME = "anylog/waymo/pvps_data_one_frame.tfrecord"


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made.write_tfrecord(tmp_path_factory.mktemp("v1") / "segment.tfrecord")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made.write_parquet(tmp_path_factory.mktemp("v2"))


def read(source: Path, scene: str = "") -> DrivingLog:
    return read_log(LogReading(source=str(source), scene=scene))


@pytest.fixture(scope="module")
def log(records: Path) -> DrivingLog:
    return read(records)


def seconds(log_ns: int) -> float:
    """Seconds since the start of the first sweep."""
    return (log_ns - made.START_US * 1000) * 1e-9


def test_frames_have_the_times_and_poses_of_their_middle_column(log: DrivingLog) -> None:
    assert log.name == made.NAME
    assert log.origin_m == tuple(np.round(made.ego_at(made.middle_s(0, 4) + made.POSE_LATE_S)))
    for name, number in (("front", 1), ("side_left", 4)):
        frames = log.frames_of(name)
        assert [frame.stem for frame in frames] == [str(i) for i in range(4)]
        for i, frame in enumerate(frames):
            # The lens moves the centre of the view by a column, which is read 0.02 ms later.
            time_s = seconds(frame.time_ns) + made.START_S
            assert time_s == pytest.approx(made.middle_s(i, number), abs=5e-5)
            truth = made.matrix_at(time_s) @ made.camera_matrix(number)
            got = frame.world_from_camera
            np.testing.assert_allclose(got.translation_m + log.origin_m, truth[:3, 3], atol=1e-4)
            # Right, down and forward are -y, -z and x of the data set's cameras.
            axes = np.stack([-truth[:3, 1], -truth[:3, 2], truth[:3, 0]], axis=1)
            np.testing.assert_allclose(got.rotation, axes, atol=1e-9)
            assert frame.shutter is not None
            assert frame.shutter.readout_across_s == pytest.approx(made.READOUT_S, abs=5e-4)
            assert frame.shutter.readout_s == pytest.approx(0.0, abs=2e-4)


def test_box_corners_fall_where_the_column_sees_them(log: DrivingLog) -> None:
    """Each corner is projected by hand from where the camera is when its column is read."""
    corners = np.array([[x, y, z] for x in (-2.2, 2.2) for y in (-0.9, 0.9) for z in (-0.7, 0.7)])
    points = made.PARKED + corners
    f_u, f_v, c_u, c_v = made.INTRINSIC[:4]
    seen = 0
    for frame in log.frames:
        number = {"front": 1, "side_left": 4}[frame.camera_name]
        uv, inside = frame.project(log.cameras[frame.camera_name], points - log.origin_m)
        for (u, v), point in zip(uv[inside], points[inside], strict=True):
            start_s = made.start_s(int(frame.stem))
            middle_s = made.middle_s(0, number) - made.START_S + start_s
            time_s = middle_s + (u / made.WIDTH_PX - 0.5) * made.READOUT_S
            world_from_camera = made.matrix_at(time_s) @ made.camera_matrix(number)
            x, y, z = np.linalg.solve(world_from_camera, np.append(point, 1.0))[:3]
            assert u == pytest.approx(c_u - f_u * y / x, abs=0.02)
            assert v == pytest.approx(c_v - f_v * z / x, abs=0.02)
            seen += 1
    assert seen > 15


def test_pictures_are_resampled_without_the_distortion(log: DrivingLog) -> None:
    picture = log.frames_of("front")[2].load_srgb8().astype(float)
    f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3 = made.INTRINSIC
    v, u = np.mgrid[4:40, 4:60] + 0.5
    x, y = (u - c_u) / f_u, (v - c_v) / f_v
    r2 = x * x + y * y
    f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u_d = c_u + f_u * (x * f + 2 * p1 * x * y + p2 * (r2 + 2 * x * x))
    v_d = c_v + f_v * (y * f + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
    # Pixel centres of the made picture are at 0.5; colours there are 60 + 2 * index.
    shown = picture[4:40, 4:60]
    np.testing.assert_allclose(shown[..., 0], 60 + 2 * (u_d - 0.5), atol=2.5)
    np.testing.assert_allclose(shown[..., 1], 60 + 2 * (v_d - 0.5), atol=2.5)
    assert abs(float((shown[..., 0] - 60 - 2 * (u_d - 0.5)).mean())) < 0.3


def test_returns_lie_on_ground_and_wall_though_the_sensor_moves(log: DrivingLog) -> None:
    for i, lazy in enumerate(log.sweeps):
        sweep = lazy.load()
        assert seconds(sweep.time_ns) == pytest.approx(made.pose_s(i) - made.START_S, abs=2e-6)
        points = sweep.points_world.astype(float) + log.origin_m
        origins = sweep.origins_world.astype(float) + log.origin_m
        first, second, _ = made.top_images(i)
        n_first, n_second = first[..., 0].size - 1, int((second[..., 0] > 0).sum())
        n_front = int((made.front_image(i)[..., 0] > 0).sum())
        assert len(points) == n_first + n_second + n_front
        is_first = np.arange(len(points)) < n_first
        is_front = np.arange(len(points)) >= n_first + n_second
        ground = np.abs(points[:, 2] - made.GROUND_M)
        out = points[:, :2] - made.ORIGIN[:2]
        wall = np.abs(np.linalg.norm(out, axis=1) - made.WALL_M)
        on_scene = np.minimum(ground, wall)
        assert on_scene[is_first | is_front].max() < 1e-3
        assert (wall[is_first] < 1e-3).sum() > 50
        behind = points[~is_first & ~is_front]
        assert len(behind)
        # The column gives the time; the rows of one column are measured after one another.
        own_s = sweep.time_offset_s[~is_front].astype(float) + made.pose_s(i)
        row = sweep.ring[~is_front]
        truth = made.ego_at(own_s + made.ROW_DELAY_S * row) + made.ATTITUDE @ made.LIDAR_EGO
        np.testing.assert_allclose(origins[~is_front], truth, atol=1e-3)
        assert (own_s - made.start_s(i)).min() > 0
        assert (own_s - made.start_s(i)).max() < made.TURN_S
        assert (sweep.time_offset_s[is_front] == 0).all()
        values = set(np.unique(sweep.intensity).round(3).tolist())
        assert values == {0.25, 0.5, 1.0}


def test_boxes_are_where_the_actors_were_when_scanned(log: DrivingLog) -> None:
    assert {actor.actor_id: actor.is_moving for actor in log.actors} == {
        "car": True,
        "parked": False,
    }
    for actor in log.actors:
        assert (actor.kind, actor.label) == (ActorKind.CAR, "vehicle")
        np.testing.assert_allclose(actor.size_lwh_m, made.BOX_LWH)
        path = actor.trajectory
        assert len(path) == made.N_FRAMES
        for time_ns, place in zip(path.times_ns.tolist(), path.positions_m, strict=True):
            time_s = seconds(time_ns) + made.START_S
            truth = made.car_at(time_s) if actor.actor_id == "car" else made.PARKED
            np.testing.assert_allclose(place + log.origin_m, truth, atol=1e-3)


def test_place_time_north_and_sun(log: DrivingLog) -> None:
    """18:17 on 27 March 2019 in San Francisco: the sun is low in the west (NOAA's calculator)."""
    assert log.geo is not None
    assert log.geo.place is not None
    assert log.geo.heading_deg == pytest.approx(90.0)
    assert log.geo.place.origin == "centre of San Francisco"
    sun = log.geo.sun_at(log.frames[0].time_ns)
    assert sun is not None
    assert sun.azimuth_deg == pytest.approx(263.3, abs=0.3)
    assert sun.elevation_deg == pytest.approx(13.1, abs=0.3)


def test_an_unnamed_city_has_no_place(tmp_path: Path) -> None:
    log = read(made.write_tfrecord(tmp_path / "a.tfrecord", "location_other"))
    assert log.geo is not None
    assert log.geo.place is None
    assert any("location_other" in note for note in log.notes)


def test_both_forms_give_the_same_log(log: DrivingLog, folder: Path) -> None:
    other = read(folder)
    assert (other.name, other.notes, other.origin_m) == (log.name, log.notes, log.origin_m)
    assert other.cameras == log.cameras
    for a, b in zip(log.frames, other.frames, strict=True):
        assert (a.camera_name, a.stem, a.time_ns) == (b.camera_name, b.stem, b.time_ns)
        np.testing.assert_array_equal(a.world_from_camera.matrix, b.world_from_camera.matrix)
        np.testing.assert_array_equal(a.load_srgb8(), b.load_srgb8())
    # Backwards, so that reading starts again in a row group.
    for a, b in zip(log.sweeps[::-1], other.sweeps[::-1], strict=True):
        one, two = a.load(), b.load()
        for name in ("points_world", "origins_world", "intensity", "time_offset_s", "ring"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    for a, b in zip(log.actors, other.actors, strict=True):
        assert (a.actor_id, a.kind, a.is_moving) == (b.actor_id, b.kind, b.is_moving)
        np.testing.assert_array_equal(a.trajectory.times_ns, b.trajectory.times_ns)
        np.testing.assert_array_equal(a.trajectory.matrices, b.trajectory.matrices)


def test_a_folder_of_two_segments_needs_a_scene(folder: Path, tmp_path: Path) -> None:
    both = Path(shutil.copytree(folder, tmp_path / "both"))
    made.write_parquet(both, "second")
    with pytest.raises(InputError, match=r"2 recordings, .*: 1234567890.*, second"):
        read(both)
    with pytest.raises(InputError, match="there is no such recording"):
        read(both, "third")
    reading = LogReading(source=str(both), scene="second")
    assert read_log(reading).name == "second"
    hashed = hash_recording(reading)
    assert len(hashed) == 8
    assert all(name.endswith("/second.parquet") for name in hashed)


def test_a_file_is_hashed_and_a_folder_of_files_names_one(records: Path) -> None:
    assert set(hash_recording(LogReading(source=str(records)))) == {"."}
    with pytest.raises(InputError, match=r"folder of 1 TFRecord files.*segment\.tfrecord"):
        read(records.parent)


def test_parts_that_are_missing_are_noted(folder: Path, tmp_path: Path) -> None:
    some = Path(shutil.copytree(folder, tmp_path / "some"))
    for part in ("lidar", "lidar_box", "stats"):
        shutil.rmtree(some / part)
    log = read(some)
    assert len(log.frames) == 8
    assert {"no LiDAR sweeps", "no labelled boxes"} <= {
        " ".join(note.split()[3:6]).rstrip(":,") for note in log.notes
    }


def test_without_pyarrow_the_error_names_the_extra(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(MissingDependencyError, match=r"lightsim\[arrow\]"):
        read(folder)


def replaced(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    """Replace bytes of the first frame, of the same length."""
    assert len(old) == len(new)

    def change(data: bytes) -> bytes:
        assert old in data
        return data.replace(old, new, 1)

    return change


def doubles(*values: float) -> bytes:
    return b"".join(struct.pack("<d", value) for value in values)


NAN, INF = float("nan"), float("inf")
RECORD_CASES = [
    ("empty", lambda data: b"", r"segment\.tfrecord"),
    ("no framing", lambda data: b"x" * 500, r"segment\.tfrecord"),
    ("cut off", lambda data: data[:-500], r"record 3: .*damaged"),
    ("a wrong length", lambda data: b"\x01" + data[1:], r"segment\.tfrecord: SOURCE is a file"),
    ("a wrong length later", lambda data: data + b"\x01" + data[1:], r"record 4: .*no record"),
    ("a record of text", lambda data: made.record(b"hello, this is a text"), r"frame 0"),
    ("a record of nothing", lambda data: made.record(b""), r"frame 0, context: .*no name"),
    ("a group", lambda data: made.record(made.varint(1 << 3 | 3)), r"frame 0: .*kind 3"),
    ("keys only", lambda data: made.record(b"\x08\x01" * 300_000), r"frame 0: .*more than 200000"),
    (
        "length beyond the record",
        lambda data: made.record(made.varint(1 << 3 | 2) + made.varint(1 << 40)),
        r"frame 0: .*beyond the end",
    ),
    (
        "another segment",
        lambda data: (
            data + made.record(made.frame_bytes(0).replace(b"1234567890_", b"0234567890_"))
        ),
        r"frame 4: .*0234567890",
    ),
    ("NaN pose", replaced(doubles(made.matrix_at(made.pose_s(0))[0, 3]), doubles(NAN)), "frame 0"),
    (
        "no rotation",
        replaced(doubles(made.ATTITUDE[0, 0]), doubles(2.0)),
        r"frame 0.*not a rotation",
    ),
    ("focal length", replaced(doubles(made.INTRINSIC[0]), doubles(0.0)), r"camera 0: .*intrinsics"),
    ("infinite centre", replaced(doubles(made.INTRINSIC[2]), doubles(INF)), r"context, camera 0"),
    (
        "trigger a minute early",
        replaced(doubles(made.picture_times(0, 1)[2]), doubles(made.START_S - 120)),
        r"image 0: .*a pose -?60",
    ),
    (
        "readout of a second",
        lambda data: b"".join(
            made.record(
                made.frame_bytes(i).replace(doubles(made.picture_times(i, 1)[1]), doubles(-1.0))
            )
            for i in range(4)
        ),
        r"front: the readout time",
    ),
    (
        "box far away",
        replaced(doubles(made.labels(0)[0]["centre"][0]), doubles(1e6)),
        r"label 0: a box",
    ),
    ("box without size", replaced(doubles(1.8), doubles(0.0)), r"tfrecord, actor car: the size"),
    ("box at NaN", replaced(doubles(made.labels(0)[0]["centre"][1]), doubles(NAN)), r"label 0"),
    ("no JPEG", replaced(made.picture_bytes(0)[:4], b"\0" * 4), r"image 0: .*unknown format"),
    ("zlib", replaced(made.matrix_bytes(made.top_images(0)[0])[:4], b"\0" * 4), r"laser 0: .*zlib"),
]


def read_everything(source: Path) -> None:
    log = read(source)
    for frame in log.frames:
        frame.load_srgb8()
    for sweep in log.sweeps:
        loaded = sweep.load()
        assert np.isfinite(loaded.points_world).all()
        assert np.isfinite(loaded.origins_world).all()


@pytest.mark.parametrize(
    ("change", "message"), [c[1:] for c in RECORD_CASES], ids=[c[0] for c in RECORD_CASES]
)
def test_a_broken_file_raises_an_error_that_names_it(
    records: Path, tmp_path: Path, change: Callable[[bytes], bytes], message: str
) -> None:
    path = tmp_path / "segment.tfrecord"
    path.write_bytes(change(records.read_bytes()))
    with pytest.raises(InputError, match=message) as caught:
        read_everything(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_bomb_of_zeros_is_refused(records: Path, tmp_path: Path) -> None:
    import zlib

    first = made.block(2, made.matrix_bytes(made.top_images(0)[0]))
    bomb = made.block(2, zlib.compress(b"\0" * (80 << 20)))
    frame = made.frame_bytes(0)
    laser = made.block(5, made.whole(1, 1) + made.block(2, bomb))
    assert first in frame
    path = tmp_path / "segment.tfrecord"
    path.write_bytes(made.record(frame + laser) + made.record(made.frame_bytes(1)))
    with pytest.raises(InputError, match="at most 67108864 bytes"):
        read_everything(path)


def column(part: str, name: str, value: object) -> Callable[[Path], object]:
    """Set the first row of a column."""

    def change(folder: Path) -> None:
        columns = made.parquet_columns()[part]
        full = next(key for key in columns if key.endswith(name))
        old = columns[full]
        columns[full] = [value, *(old if isinstance(old, list) else old.to_pylist())[1:]]
        made.write_component(folder, part, columns)

    return change


def without(part: str, name: str) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        columns = made.parquet_columns()[part]
        del columns[next(key for key in columns if key.endswith(name))]
        made.write_component(folder, part, columns)

    return change


def whole_file(part: str, change: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    def apply(folder: Path) -> None:
        path = folder / part / f"{made.NAME}.parquet"
        path.write_bytes(change(path.read_bytes()))

    return apply


PARQUET_CASES = [
    ("no calibration", lambda f: shutil.rmtree(f / "camera_calibration"), "camera_calibration"),
    ("no Parquet", whole_file("vehicle_pose", lambda d: b"text"), "vehicle_pose.*Parquet"),
    ("cut off", whole_file("camera_image", lambda d: d[: len(d) // 2]), "camera_image.*Parquet"),
    ("no column", without("camera_image", "pose_timestamp"), r"camera_image.*no column.*pose_time"),
    ("NaN", column("camera_calibration", "f_u", NAN), r"row 0, .*f_u': not a finite number"),
    ("text", column("stats", "location", "x\n"), r"stats.*row 0, .*location"),
    ("missing", column("lidar_box", "heading", None), r"lidar_box.*row 0, .*heading"),
    ("short matrix", column("vehicle_pose", "transform", [1.0]), r"vehicle_pose.*1 numbers"),
    ("no picture", column("camera_image", "].image", b""), r"camera_image.*row 0.*unknown format"),
    ("null picture", column("camera_image", "].image", None), r"camera_image.*row 0.*NoneType"),
    ("camera", column("camera_image", "camera_name", 7), r"camera_image.*row 0.*camera 7"),
    ("time", column("vehicle_pose", "micros", 12), r"vehicle_pose.*(UTC|no pose at)"),
    ("shape", column("lidar", "return1.shape", [1, 2, 3]), r"lidar/.*row 0.*dimensions"),
    ("poses", column("lidar_pose", "return1.shape", [90, 6, 6]), r"laser 1.*equal sizes"),
]


@pytest.mark.parametrize(
    ("change", "message"), [c[1:] for c in PARQUET_CASES], ids=[c[0] for c in PARQUET_CASES]
)
def test_broken_tables_raise_an_error_that_names_the_file(
    folder: Path, tmp_path: Path, change: Callable[[Path], object], message: str
) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    change(copy)
    with pytest.raises(InputError, match=message) as caught:
        read_everything(copy)
    assert str(copy) in str(caught.value)
    assert "\n" not in str(caught.value)


def damage_records(target: Path, rng: np.random.Generator) -> str:
    """Damage the file, or one message in it, whose record is then valid again."""
    if rng.random() < 0.2:
        data, words = mutate_bytes(target.read_bytes(), rng)
    else:
        frames = [made.frame_bytes(i) for i in range(made.N_FRAMES)]
        number = int(rng.integers(made.N_FRAMES))
        frames[number], words = mutate_bytes(frames[number], rng)
        data = b"".join(made.record(frame) for frame in frames)
    target.write_bytes(data)
    return words


def damage_tables(target: Path, rng: np.random.Generator) -> str:
    """Damage the bytes of a file, or one number of a column."""
    if rng.random() < 0.5:
        damaged = pick(rng, sorted(target.rglob("*.parquet")))
        data, words = mutate_bytes(damaged.read_bytes(), rng)
        damaged.write_bytes(data)
        return words
    part, columns = pick(rng, sorted(made.parquet_columns().items()))
    name = pick(rng, [n for n, v in columns.items() if isinstance(v[0], int | float)])
    row = int(rng.integers(len(columns[name])))
    if isinstance(columns[name][row], int):
        value = pick(rng, (None, 0, -1, 1, 7, 2**31, 2**62, -(2**63)))
    else:
        value = pick(rng, (None, NAN, INF, 0.0, -1.0, 1e-300, 1e18, 1e300, 2 * columns[name][row]))
    columns[name][row] = value
    made.write_component(target, part, columns)
    return f"{part}, {name}[{row}] = {value}"


def fuzz(source: Path, room: Path, count: int, seed: int) -> tuple[int, int]:
    """Damage a recording at random; return how many were accepted and refused."""
    accepted = 0
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        target = room / source.name
        if source.is_dir():
            shutil.copytree(source, target)
            words = damage_tables(target, rng)
        else:
            shutil.copyfile(source, target)
            words = damage_records(target, rng)
        message = str(target)
        try:
            read_everything(target)
            accepted += 1
        except LightSimError as error:
            message = str(error)
        except BaseException as error:
            raise AssertionError(f"case {number} of seed {seed}: {words}") from error
        assert str(target) in message, (number, seed, words, message)
        shutil.rmtree(target) if target.is_dir() else target.unlink()
    return accepted, count - accepted


@pytest.mark.parametrize("form", ["records", "folder"])
def test_damaged_recordings_raise_our_errors_only(
    form: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    _, refused = fuzz(request.getfixturevalue(form), tmp_path, 15, 1)
    assert refused > 5


@pytest.fixture(scope="module")
def real_path(shared_data: Path) -> Path:
    path = shared_data / REAL_NAME
    if not path.exists():
        pytest.skip(f"needs {path}")
    return path


@pytest.fixture(scope="module")
def real(real_path: Path) -> DrivingLog:
    return read(real_path)


def rectangles(path: Path) -> dict[tuple[int, str], np.ndarray]:
    """Waymo's own projections of the boxes, by camera and object: left, top, right, bottom."""
    found: dict[tuple[int, str], np.ndarray] = {}
    with open_tfrecord(path) as handle:
        wire = Wire(handle, path)
        frame = wire.message(next(iter(wire.records())), "frame")
        for camera in frame.messages(9, "camera"):
            for label in camera.messages(2, "label"):
                box = label.message(1, "box")
                x, y, width, height = (box.number(i) for i in (1, 2, 5, 4))
                edges = np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2])
                found[camera.whole(1), label.text(4)] = edges
    return found


def test_real_boxes_fall_where_waymo_projects_them(real: DrivingLog, real_path: Path) -> None:
    """Half of the boxes' edges are within 0.08 px; a half-pixel shift, exchanged axes, another
    pose, or p1 and p2 exchanged exceed the limits."""
    segment = read_records(real_path)
    given = rectangles(real_path)
    assert len(given) == 62
    numbers = {"front": 1, "front_left": 2, "front_right": 3, "side_left": 4, "side_right": 5}
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    errors: list[float] = []
    for frame in real.frames:
        number = numbers[frame.camera_name]
        lens, camera = segment.cameras[number].lens, real.cameras[frame.camera_name]
        for actor in real.actors:
            edges = given.get((number, f"{actor.actor_id}_{frame.camera_name.upper()}"))
            pose = actor.trajectory.at(actor.trajectory.start_ns)
            uv, _ = frame.project(camera, pose.apply(corners * actor.size_lwh_m))
            if edges is not None and not np.isnan(uv).any():
                errors.append(float(np.abs(rectangle(camera.directions(uv), lens) - edges).max()))
    assert len(errors) > 55
    assert np.median(errors) < 0.1
    assert np.percentile(errors, 90) < 0.25


def rectangle(directions: np.ndarray, lens: Lens) -> np.ndarray:
    uv, _ = lens.project(directions)
    size = np.array([lens.width_px, lens.height_px])
    return np.concatenate([np.clip(uv.min(axis=0), 0, size), np.clip(uv.max(axis=0), 0, size)])


def test_real_cameras_are_exposed_when_the_lidar_looks_their_way(real: DrivingLog) -> None:
    """The turn starts backwards at the frame's time, clockwise, and takes 0.1 s."""
    for frame in real.frames:
        ahead = (
            real.ego.held(frame.time_ns).inverse().rotate(frame.world_from_camera.rotation[:, 2])
        )
        azimuth = np.arctan2(ahead[1], ahead[0])
        turned_s = 0.1 * (np.pi - azimuth) / (2 * np.pi)
        exposed_s = (frame.time_ns - 1_553_735_853_462_203_000) * 1e-9
        assert exposed_s == pytest.approx(turned_s, abs=1e-3)
        assert frame.shutter is not None
        assert frame.shutter.readout_across_s == pytest.approx(0.044, abs=5e-4)


def test_real_frame(real: DrivingLog) -> None:
    assert {name: (c.width_px, c.height_px) for name, c in real.cameras.items()} == {
        "front": (1920, 1280),
        "front_left": (1920, 1280),
        "front_right": (1920, 1280),
        "side_left": (1920, 886),
        "side_right": (1920, 886),
    }
    kinds = [actor.kind for actor in real.actors]
    assert len(kinds) == 75
    assert {kind: kinds.count(kind) for kind in set(kinds)} == {
        ActorKind.CAR: 23,
        ActorKind.OTHER_VEHICLE: 14,
        ActorKind.PEDESTRIAN: 12,
        ActorKind.SIGN: 25,
        ActorKind.BICYCLE: 1,
    }
    # Boxes of people near the vehicle stand on the road, which is the height of its origin.
    feet = [
        a.trajectory.positions_m[0, 2] - a.size_lwh_m[2] / 2 - real.ego.positions_m[0, 2]
        for a in real.actors
        if a.kind is ActorKind.PEDESTRIAN
        and np.linalg.norm(a.trajectory.positions_m[0] - real.ego.positions_m[0]) < 15
    ]
    assert len(feet) > 3
    assert abs(np.median(feet)) < 0.2
