"""The DGP reader: a made scene with known truth, and the real test scene of DGP."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tools.fuzz.containers import mutate_npz
from tools.fuzz.mutations import mutate_bytes, mutate_json, pick
from tools.fuzz.pictures import mutate_picture
from tools.fuzz.targets import use_log

from datasets.dgp_log import (
    AHEAD_M,
    CAMERA_LAG_US,
    CAMERA_M,
    FISHEYE,
    FOCAL_PX,
    LIDAR,
    N_FRAMES,
    PARKED_M,
    ROAD_M,
    SIZE_LWH_M,
    SPEED_M_S,
    START_NS,
    YAW_DEG,
    box_poses,
    times_us,
    vehicle_from_camera,
    world_from_vehicle,
    world_points,
    write_dgp_scene,
    write_json,
)
from datasets.test_bad_logs import change_json, cut, delete, with_value, write_text
from lightsim.core.actors import ActorKind
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.core.solar import solar_position
from lightsim.datasets.fingerprint import hash_recording
from lightsim.datasets.reader import check_layout, read_log
from lightsim.errors import InputError

SCENE = "scene_0123abcd.json"
ANN_ARBOR_DEG = (42.30, -83.70)


def reading(source: Path, **options: Any) -> LogReading:
    return LogReading(source=str(source), **options)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dgp_scene(tmp_path_factory.mktemp("dgp") / "000150")


@pytest.fixture(scope="module")
def log(folder: Path) -> DrivingLog:
    return read_log(reading(folder))


def test_times_and_poses_of_each_frame(log: DrivingLog) -> None:
    assert log.name == "000150"
    assert log.stems == ("0", "1", "2", "3")
    frames = log.frames_of("CAMERA_01")
    expected_ns = START_NS + times_us(CAMERA_LAG_US) * 1000
    assert [f.time_ns for f in frames] == expected_ns.tolist()
    origin = np.array(log.origin_m)
    for frame, us in zip(frames, times_us(CAMERA_LAG_US), strict=True):
        truth = world_from_vehicle(us * 1e-6) @ vehicle_from_camera("CAMERA_01")
        np.testing.assert_allclose(frame.world_from_camera.rotation, truth.rotation, atol=1e-9)
        at_m = frame.world_from_camera.translation_m + origin
        np.testing.assert_allclose(at_m, truth.translation_m, atol=1e-4)


def test_the_origin_of_the_ego_frame_is_on_the_road(log: DrivingLog) -> None:
    pose = log.ego.at(START_NS)
    below = world_from_vehicle(0.0).apply(np.array([[0.0, 0.0, ROAD_M]]))[0]
    np.testing.assert_allclose(pose.translation_m + log.origin_m, below, atol=2e-3)
    assert np.degrees(pose.yaw_rad) == pytest.approx(YAW_DEG)
    assert any("the road is -0.400 m from" in note for note in log.notes)
    assert any("returns have no times of their own" in note for note in log.notes)


def test_a_box_is_where_the_camera_sees_it(log: DrivingLog) -> None:
    """Corners of the parked car in closed form: focal length times the ratio of its offsets."""
    frame, camera = log.frames_of("CAMERA_01")[2], log.cameras["CAMERA_01"]
    actor = next(a for a in log.actors if a.actor_id == "7")
    half = np.array(SIZE_LWH_M) / 2
    corner_world = actor.world_from_actor(frame.time_ns).apply(half[None])
    uv, _ = frame.project(camera, corner_world)
    # Frame `vehicle` of the first cloud: the car is turned by 0.5 rad, the camera has moved on.
    c, s = np.cos(0.5), np.sin(0.5)
    x, y, z = np.array(PARKED_M) + [c * half[0] - s * half[1], s * half[0] + c * half[1], half[2]]
    moved_m = SPEED_M_S * (2 * 0.1 - CAMERA_LAG_US * 1e-6)
    depth = x - moved_m - CAMERA_M[0]
    u, v = (
        32.0 - FOCAL_PX * (y - CAMERA_M[1]) / depth,
        24.0 - FOCAL_PX * (z - CAMERA_M[2]) / depth,
    )
    np.testing.assert_allclose(uv[0], [u, v], atol=1e-4)


def test_returns_are_in_world_within_a_millimetre(log: DrivingLog) -> None:
    assert len(log.sweeps) == N_FRAMES
    for i in (0, N_FRAMES - 1):
        sweep = log.sweeps[i].load()
        truth = world_points() - log.origin_m
        np.testing.assert_allclose(sweep.points_world, truth, atol=1e-3)
        assert sweep.time_ns == START_NS + int(times_us()[i]) * 1000
        # Beams start on the roof, where the cameras are, not on the road.
        start = world_from_vehicle(times_us()[i] * 1e-6).apply(CAMERA_M[None])[0] - log.origin_m
        np.testing.assert_allclose(sweep.origins_world[5], start, atol=1e-3)
        np.testing.assert_allclose(sweep.intensity, 0.25)


def test_tracks_of_boxes(log: DrivingLog) -> None:
    actors = {a.actor_id: a for a in log.actors}
    assert set(actors) == {"7", "4294967296"}
    assert (actors["7"].is_moving, actors["4294967296"].is_moving) == (False, True)
    assert actors["7"].kind is ActorKind.CAR
    np.testing.assert_allclose(actors["7"].size_lwh_m, SIZE_LWH_M)
    for name, actor in actors.items():
        truth = box_poses(0.3)[name]
        pose = actor.world_from_actor(START_NS + 300_000_000)
        np.testing.assert_allclose(
            pose.translation_m + log.origin_m, truth.translation_m, atol=1e-4
        )
        np.testing.assert_allclose(pose.rotation, truth.rotation, atol=1e-7)
    start = actors["4294967296"].trajectory.positions_m[0] - log.ego.at(START_NS).translation_m
    assert np.hypot(*start[:2]) == pytest.approx(AHEAD_M, abs=1e-4)


def test_fisheye_cameras_are_resampled(log: DrivingLog, folder: Path) -> None:
    assert FISHEYE in log.cameras
    assert any(f"{FISHEYE}: kannala_brandt lens" in note for note in log.notes)
    frame = log.frames_of(FISHEYE)[0]
    ahead = frame.world_from_camera.rotation[:, 2]
    yaw = np.radians(YAW_DEG + 60.0)
    np.testing.assert_allclose(ahead, [np.cos(yaw), np.sin(yaw), 0.0], atol=0.05)


def test_north_and_sun(folder: Path) -> None:
    log = read_log(reading(folder, place="42.3,-83.7"))
    assert log.geo is not None
    assert log.geo.heading_deg == pytest.approx(90.0)
    assert log.geo.heading_residual_deg == 15.0
    assert any("north is assumed" in note for note in log.notes)
    sun, truth = log.geo.sun_at(START_NS), solar_position(*ANN_ARBOR_DEG, START_NS)
    assert sun is not None
    assert sun.elevation_deg == pytest.approx(truth.elevation_deg, abs=1e-6)
    # Ten in the morning of a June day: the sun is in the east-south-east.
    assert (sun.azimuth_deg, sun.elevation_deg) == pytest.approx((101.0, 47.0), abs=0.5)
    given = read_log(reading(folder, heading_deg=10.0))
    assert given.geo is not None
    assert given.geo.heading_deg == pytest.approx(10.0)
    assert not any("north is assumed" in note for note in given.notes)
    assert any("no place" in note for note in given.notes)


def test_stamps_ten_times_too_large(tmp_path: Path, log: DrivingLog) -> None:
    scaled = read_log(reading(write_dgp_scene(tmp_path / "scene", stamp_scale=10)))
    assert [f.time_ns for f in scaled.frames] == [f.time_ns for f in log.frames]
    assert any("10 times too large" in note for note in scaled.notes)
    assert not any("10 times too large" in note for note in log.notes)


def test_missing_and_doubled_files_are_noted(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "scene"))
    (copy / f"point_cloud/{LIDAR}/01.npz").unlink()
    (copy / "rgb/CAMERA_09/02.png").unlink()
    (copy / f"bounding_box_3d/{LIDAR}/02.json").unlink()
    change_json(SCENE, lambda d: d | {"data": [*d["data"], d["data"][0], {
        "id": d["data"][0]["id"], "datum": {"radar_point_cloud": {}}}]})(copy)  # fmt: skip
    log = read_log(reading(copy))
    notes = " / ".join(log.notes)
    for part in (
        "LIDAR: 1 files are missing",
        "CAMERA_09: 1 files are missing",
        "CAMERA_09: no picture for 1 of 4 frames",
        "LIDAR: 1 entries repeat a time stamp",
        "1 entries are neither pictures nor point clouds",
        "no labelled boxes for 1 of 3 clouds",
    ):
        assert part in notes
    assert len(log.sweeps) == 3
    assert len(log.frames) == 3 * N_FRAMES - 1


def test_labels_lenses_and_intensities_of_other_scenes(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "scene"))
    items = {"items": [{"id": 2, "name": "Hovercraft"}]}
    write_json(copy / "ontology/names.json", items)
    change_json("calibration/rig.json", with_value(("intrinsics", 3, "xi"), 0.4))(copy)
    path = copy / f"point_cloud/{LIDAR}/00.npz"
    data = np.load(path)["data"]
    data[0, 3] = 200.0
    np.savez(path, data=data)
    log = read_log(reading(copy))
    assert {a.kind for a in log.actors} == {ActorKind.OTHER}
    assert any("2 x 'Hovercraft'" in note for note in log.notes)
    assert any("CAMERA_09: its lens model (xi) is not supported" in note for note in log.notes)
    assert "CAMERA_09" not in log.cameras
    assert log.sweeps[0].load().intensity[0] == pytest.approx(200 / 255)


def test_choice_of_a_scene(folder: Path, tmp_path: Path) -> None:
    whole = tmp_path / "ddad"
    for name in ("000001", "000002"):
        shutil.copytree(folder, whole / name)
    write_json(whole / "ddad.json", {})
    with pytest.raises(InputError, match=r"2 recordings.*000001, 000002"):
        read_log(reading(whole))
    with pytest.raises(InputError, match=r"no such recording.*--scene 7"):
        read_log(reading(whole, scene="7"))
    log = read_log(reading(whole, scene="000002"))
    assert log.name == "000002"
    hashes = hash_recording(reading(whole, scene="000002"))
    assert all(name.startswith("000002/") for name in hashes)
    n_files = sum(path.is_file() for path in (whole / "000002").rglob("*"))
    assert len(hashes) == n_files
    with pytest.raises(InputError, match="SOURCE is another scene"):
        read_log(reading(folder, scene="000002"))
    with pytest.raises(InputError, match="a part of the scene"):
        check_layout(reading(folder / "rgb"))
    assert check_layout(reading(whole)) == "dgp"


Break = Callable[[Path], object]


def change_entry(keys: tuple[Any, ...], value: Any, at: int = 0) -> Break:
    return change_json(SCENE, with_value(("data", at, *keys), value))


def change_cloud(change: Callable[[np.ndarray], np.ndarray]) -> Break:
    def apply(scene: Path) -> None:
        path = scene / f"point_cloud/{LIDAR}/00.npz"
        np.savez(path, data=change(np.load(path)["data"]))

    return apply


def rename_cloud(scene: Path) -> None:
    path = scene / f"point_cloud/{LIDAR}/00.npz"
    np.savez(path, points=np.load(path)["data"])


def change_box(keys: tuple[Any, ...], value: Any) -> Break:
    return change_json(BOXES, with_value(("annotations", 0, *keys), value))


def resize(scene: Path) -> None:
    Image.new("RGB", (32, 24)).save(scene / "rgb/CAMERA_01/01.png")


BOXES, RIG = f"bounding_box_3d/{LIDAR}/00.json", "calibration/rig.json"
CLOUD, IMAGE = ("datum", "point_cloud"), ("datum", "image")
FIRST_IMAGE = N_FRAMES
NAN = float("nan")
CASES: list[tuple[str, Break, str]] = [
    ("scene is no JSON", write_text(SCENE, "{"), rf"{SCENE}: .*not valid JSON"),
    ("scene is a list", write_text(SCENE, "[]"), rf"{SCENE}: not a JSON object"),
    ("deep JSON", write_text(SCENE, "[" * 99_999), rf"{SCENE}: .*not valid JSON"),
    ("no samples", change_json(SCENE, with_value(("samples",), [])), r"samples: not a JSON array"),
    ("data of text", change_json(SCENE, with_value(("data",), "x")), r"data: not a JSON array"),
    ("entry of text", change_json(SCENE, with_value(("data", 2), "x")), r"data\[2\]: not a JSON"),
    ("no pose", change_entry((*CLOUD, "pose"), None), r"data\[0\], pose: not a JSON object"),
    ("pose of NaN", change_entry((*CLOUD, "pose", "translation", "x"), NAN),
     r"data\[0\], pose, 'x': not a finite number"),
    ("zero quaternion",
     change_entry((*CLOUD, "pose", "rotation"), dict.fromkeys(("qw", "qx", "qy", "qz"), 0)),
     r"data\[0\], pose: the rotation is not a unit quaternion"),
    ("lying vehicle",
     change_entry((*CLOUD, "pose", "rotation"), {"qw": 0.7, "qx": 0.7, "qy": 0, "qz": 0}),
     rf"{SCENE}: the vehicle is not upright"),
    ("vehicle that jumps", change_entry((*CLOUD, "pose", "translation", "x"), 0.0),
     r"LIDAR/pose\[3\]: the pose is too far"),
    ("camera elsewhere", change_entry((*IMAGE, "pose", "translation", "z"), 9e3, FIRST_IMAGE),
     r"CAMERA_01/pose\[1\]: the pose is too far"),
    ("no time", change_entry(("id", "timestamp"), 5), r"data\[0\], id: the time stamp cannot be"),
    ("another century", change_entry(("id", "timestamp"), "1819-06-27T14:30:25Z"),
     rf"{SCENE}: the time stamps are implausible"),
    ("sensor without name", change_entry(("id", "name"), ""), r"data\[0\], id: the sensor has no"),
    ("cloud outside", change_entry((*CLOUD, "filename"), "../../x.npz"),
     r"data\[0\], filename: a file's name leads out"),
    ("absolute picture", change_entry((*IMAGE, "filename"), "/etc/passwd", FIRST_IMAGE),
     r"data\[4\], filename: a file's name leads out"),
    ("boxes outside", change_entry((*CLOUD, "annotations", "1"), "../x.json"),
     r"data\[0\], annotations: a file's name leads out"),
    ("calibration outside",
     change_json(SCENE, lambda d: d | {"samples": [{"calibration_key": "../../x"}]}),
     r"samples\[0\]: a file's name leads out"),
    ("no calibration", delete(RIG), r"rig\.json: cannot open"),
    ("calibration of two lengths", change_json(RIG, with_value(("names",), ["LIDAR"])),
     r"rig\.json: names, extrinsics and intrinsics differ in number"),
    ("sensor not calibrated", change_json(RIG, with_value(("names", 0), "RADAR")),
     r"rig\.json: the calibration has no sensor 'LIDAR'"),
    ("no focal length", change_json(RIG, with_value(("intrinsics", 1, "fx"), None)),
     r"rig\.json/CAMERA_01/intrinsics, 'fx': not a finite number"),
    ("tiny focal length", change_json(RIG, with_value(("intrinsics", 1, "fx"), 0.01)),
     r"CAMERA_01/intrinsics: the intrinsics do not fit"),
    ("distortion of text", change_json(RIG, with_value(("intrinsics", 1, "k1"), "x")),
     r"CAMERA_01/intrinsics, k1: not a finite number"),
    ("camera far away", change_json(RIG, with_value(("extrinsics", 1, "translation", "x"), 900)),
     r"rig\.json, CAMERA_01: the sensor is not on the vehicle"),
    ("truncated cloud", cut(f"point_cloud/{LIDAR}/00.npz", 0.5), r"00\.npz: the arrays cannot"),
    ("cloud without data", rename_cloud, r"00\.npz: the file does not"),
    ("cloud of two columns", change_cloud(lambda d: d[:, :2]), r"00\.npz: the file does not"),
    ("empty cloud", change_cloud(lambda d: d[:0]), r"00\.npz: the file does not contain"),
    ("cloud of text", change_cloud(lambda d: d.astype(str)), r"00\.npz: the file does not contain"),
    ("cloud of NaN", change_cloud(lambda d: d * np.nan), r"00\.npz: the sweep has no valid point"),
    ("cloud of millimetres", change_cloud(lambda d: d * 1000), r"00\.npz: the sweep's points"),
    ("format of numbers", change_entry((*CLOUD, "point_format"), [0, 1, 2]),
     r"data\[0\], point_format: the format"),
    ("boxes of text", write_text(BOXES, '{"annotations": 3}'), r"00\.json, annotations: not a"),
    ("box without id", change_box(("instance_id",), None), r"annotations\[0\]: the box has no"),
    ("box of no size", change_box(("box", "width"), 0), rf"{SCENE}, actor 7: the size of a box"),
    ("box of NaN", change_box(("box", "length"), NAN), r"annotations\[0\]"),
    ("box far away", change_box(("box", "pose", "translation", "y"), 5e4),
     r"annotations\[0\]: a box is beyond"),
    ("class of text", change_box(("class_id",), "Car"), r"annotations\[0\], 'class_id'"),
    ("no class names", delete("ontology/names.json"), r"names\.json: cannot open"),
    ("class without name", write_text("ontology/names.json", '{"items": [{"id": 1}]}'),
     r"items\[0\]: the class has no name"),
    ("ontology outside", change_json(SCENE, with_value(("ontologies", "1"), "../../x")),
     r"ontologies: a file's name leads out"),
    ("truncated picture", cut("rgb/CAMERA_01/00.png", 0.5), r"00\.png: "),
    ("picture of another size", resize, r"01\.png: the picture's size differs"),
    ("picture is a web page", write_text("rgb/CAMERA_01/00.png", "<html>"), r"00\.png: "),
]  # fmt: skip


@pytest.mark.parametrize(("broken", "pattern"), [c[1:] for c in CASES], ids=[c[0] for c in CASES])
def test_broken_scenes_give_an_error_that_names_the_file(
    folder: Path, tmp_path: Path, broken: Break, pattern: str
) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "scene"))
    broken(copy)
    with pytest.raises(InputError, match=pattern):
        read_first(copy)


def read_first(scene: Path) -> None:
    """Read a scene with its first pictures and clouds."""
    use_log(read_log(reading(scene)))


def fuzz(source: Path, room: Path, count: int, seed: int) -> int:
    """Damage a file of the scene at random, `count` times; return how often it was accepted."""
    accepted = 0
    files = sorted(path.relative_to(source) for path in source.rglob("*") if path.is_file())
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        scene = Path(shutil.copytree(source, room / "scene"))
        # Most of what is read lies in the first document and the calibration.
        path = scene / (pick(rng, (SCENE, RIG, BOXES)) if rng.random() < 0.6 else pick(rng, files))
        if path.suffix == ".npz":
            words = mutate_npz(path, rng)
        elif path.suffix == ".png":
            words = mutate_picture(path, rng)
        else:
            change = mutate_json if rng.random() < 0.8 else mutate_bytes
            data, words = change(path.read_bytes(), rng)
            path.write_bytes(data)
        message = str(scene)
        try:
            read_first(scene)
            accepted += 1
        except InputError as error:
            message = str(error)
        except BaseException as error:
            raise AssertionError(f"case {number} of seed {seed}: {path}: {words}") from error
        assert str(scene) in message, (number, seed, words, message)
        shutil.rmtree(scene)
    return accepted


def test_damaged_scenes_raise_our_errors_only(folder: Path, tmp_path: Path) -> None:
    assert 0 < fuzz(folder, tmp_path, 15, 1) < 15


@pytest.fixture(scope="module")
def real_folder(shared_data: Path) -> Path:
    folder = shared_data / "anylog" / "ddad" / "scene_02"
    if not folder.is_dir():
        pytest.skip(f"needs DGP's test scene at {folder}")
    return folder


@pytest.fixture(scope="module")
def real(real_folder: Path) -> DrivingLog:
    return read_log(reading(real_folder))


def labels(folder: Path, kind: str, sensor: str, i: int) -> list[dict[str, Any]]:
    path = sorted((folder / kind / sensor).iterdir())[i]
    return json.loads(path.read_text())["annotations"]


def test_real_scene(real: DrivingLog) -> None:
    assert len(real.cameras) == 6
    assert len(real.frames) == 18
    assert len(real.sweeps) == 3
    assert real.frames[0].time_ns == 1_561_645_824_993_653_000
    assert len(real.actors) == 13
    speed = np.linalg.norm(np.diff(real.ego.positions_m[1:3], axis=0)) / 0.09904
    assert speed == pytest.approx(12.7, abs=0.1)
    assert any("the road is +0.092 m from" in note for note in real.notes)


def test_real_boxes_in_cameras_agree_with_the_data_sets_own(
    real: DrivingLog, real_folder: Path
) -> None:
    """DGP has each box in the frame of each camera, and its rectangle in whole pixels, counted from
    the centre of the first one. Without the pictures' own poses the first differ by 7 cm."""
    actors = {a.actor_id: a for a in real.actors}
    errors_m: list[float] = []
    edges_px: list[np.ndarray] = []
    for camera in real.cameras.values():
        for i, frame in enumerate(real.frames_of(camera.name)):
            camera_from_world = frame.world_from_camera.inverse()
            for label in labels(real_folder, "bounding_box_3d", camera.name, i):
                actor = actors[str(label["instance_id"])]
                pose = camera_from_world @ actor.world_from_actor(real.sweeps[i].time_ns)
                truth = [label["box"]["pose"]["translation"][axis] for axis in "xyz"]
                errors_m.append(float(np.linalg.norm(pose.translation_m - truth)))
            for label in labels(real_folder, "bounding_box_2d", camera.name, i):
                actor = actors[str(label["instance_id"])]
                pose = actor.world_from_actor(real.sweeps[i].time_ns)
                signs = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, 8).T
                uv, _ = frame.project(camera, pose.apply(signs * actor.size_lwh_m))
                edges_px.append(uv.min(axis=0) - [label["box"]["x"], label["box"]["y"]])
    assert len(errors_m) == 39
    assert max(errors_m) < 1e-4
    # Rounded down: between 0 and 1 after half a pixel is taken off.
    rests = np.concatenate(edges_px) - 0.5
    assert len(rests) >= 60
    assert (rests >= 0).all()
    assert (rests < 1).all()


def test_real_returns_lie_in_the_boxes(real: DrivingLog, real_folder: Path) -> None:
    """The sample has a fifth of the returns that were counted for the labels."""
    counts, labelled = 0, 0
    for i, lazy in enumerate(real.sweeps):
        sweep = lazy.load()
        number = {str(a["instance_id"]): a["num_points"]
                  for a in labels(real_folder, "bounding_box_3d", LIDAR, i)}  # fmt: skip
        for actor in real.actors:
            n = int(actor.contains(sweep.points_world, sweep.time_ns).sum())
            if number[actor.actor_id] > 1000:
                assert n * 5 == pytest.approx(number[actor.actor_id], rel=0.15)
            counts, labelled = counts + n, labelled + number[actor.actor_id]
    assert counts * 5 == pytest.approx(labelled, rel=0.05)


def test_real_beams_are_free(real: DrivingLog) -> None:
    """Few returns lie behind nearer ones, seen from the start of the beams."""
    from scipy.spatial import KDTree

    def hidden(from_m: np.ndarray, points: np.ndarray) -> float:
        rays = points - from_m
        reach = np.linalg.norm(rays, axis=1)
        units = rays / reach[:, None]
        gaps, index = KDTree(units).query(units, k=7, distance_upper_bound=0.0025)
        near = np.where(np.isfinite(gaps), reach[np.minimum(index, len(reach) - 1)], np.inf)
        return float((near.min(axis=1) < 0.85 * reach).mean())

    sweep = real.sweeps[1].load()
    points = sweep.points_world[sweep.distances_m < 60.0].astype(np.float64)
    start = sweep.origins_world[0].astype(np.float64)
    assert hidden(start, points) < 0.03
    assert hidden(start - [0.0, 0.0, 1.4], points) > 0.15
