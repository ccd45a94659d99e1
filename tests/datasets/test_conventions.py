"""Logs that pipelines of users changed: other axes, orders, ranges and file names. They are read as
the plain log is, or an error or a note names the difference."""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from datasets import kitti_log, lightsim_log, mini_log, nuscenes_log
from lightsim.core.frames import Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.datasets.ego_path import gap_notes
from lightsim.datasets.first_sweeps import full_scale
from lightsim.datasets.reader import read_log
from lightsim.errors import InputError

Change = Callable[[Path], object]
Rows = list[dict[str, Any]]
WRITERS: dict[str, Callable[[Path], Path]] = {
    "lightsim": lightsim_log.write_lightsim_mini,
    "pandaset": mini_log.write_mini_log,
    "nuscenes": nuscenes_log.write_data_set,
    "kitti": kitti_log.write_kitti,
}
_XYZW = ("qx", "qy", "qz", "qw")


def read(folder: Path) -> DrivingLog:
    return read_log(LogReading(source=str(folder)))


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIGHTSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Plain logs of each data set, by its name."""
    root = tmp_path_factory.mktemp("plain")
    return {name: write(root / name) for name, write in WRITERS.items()}


@pytest.fixture(scope="module")
def plain(made: dict[str, Path]) -> dict[str, DrivingLog]:
    return {name: read(folder) for name, folder in made.items()}


def changed(made: dict[str, Path], name: str, change: Change, tmp_path: Path) -> Path:
    """Return a changed copy; of KITTI with the calibration beside the drive."""
    folder = made[name]
    if name == "kitti":
        copy = Path(shutil.copytree(folder.parent, tmp_path / folder.parent.name)) / folder.name
    else:
        copy = Path(shutil.copytree(folder, tmp_path / "log"))
    change(copy)
    return copy


def table(name: str, of: Callable[[dict[str, Any]], dict[str, Any]]) -> Change:
    """Change the rows of a CSV file."""

    def change(log: Path) -> None:
        with (log / name).open(newline="") as file:
            rows = [row | of(row) for row in csv.DictReader(file)]
        with (log / name).open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)

    return change


def document(name: str, of: Callable[[Any], object]) -> Change:
    """Change the value of JSON files in place."""

    def change(log: Path) -> None:
        for path in log.glob(name):
            value = json.loads(path.read_text())
            result = of(value)
            path.write_text(json.dumps(value if result is None else result))

    return change


def turned(axis: str, degrees: float) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Rows with poses turned about an axis of their own."""

    def of(row: dict[str, Any]) -> dict[str, Any]:
        own = Rotation.from_quat([float(row[key]) for key in _XYZW])
        turn = Rotation.from_euler(axis, degrees, degrees=True)
        return dict(zip(_XYZW, (own * turn).as_quat(), strict=True))

    return of


def reordered(row: dict[str, Any]) -> dict[str, Any]:
    """The quaternion in the order x, y, z, w."""
    return {key: row[old] for key, old in zip(("qw", "qx", "qy", "qz"), _XYZW, strict=True)}


def camera_poses(of: Callable[[np.ndarray], np.ndarray]) -> Change:
    def change(header: dict[str, Any]) -> None:
        for camera in header["cameras"].values():
            camera["ego_from_camera"] = of(np.array(camera["ego_from_camera"])).tolist()

    return document("log.json", change)


def poses_of_pictures(shift_ns: int) -> Change:
    def change(log: Path) -> None:
        time_ns = lightsim_log.picture_times("front")[0]
        pose = lightsim_log.world_from_ego(time_ns) @ lightsim_log.EGO_FROM_FRONT
        rows = [["front", time_ns + shift_ns, *lightsim_log.row(pose)]]
        lightsim_log.write_table(log / "camera_poses.csv", f"camera {lightsim_log.POSE}", rows)

    return change


def frames(part: str, of: Callable[[pd.DataFrame], pd.DataFrame]) -> Change:
    """Change the tables of a PandaSet folder."""

    def change(log: Path) -> None:
        for path in (log / part).glob("*.pkl.gz"):
            frame = pd.DataFrame(pd.read_pickle(path))
            of(frame).to_pickle(path)

    return change


def floats(pattern: str, columns: int, of: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change files of float32 rows."""

    def change(log: Path) -> None:
        for path in log.glob(pattern):
            of(np.fromfile(path, "<f4").reshape(-1, columns)).tofile(path)

    return change


def mask(of: Callable[[np.ndarray], np.ndarray]) -> Change:
    def change(log: Path) -> None:
        path = log / "masks/front.png"
        Image.fromarray(of(np.array(Image.open(path)))).save(path)

    return change


def exif(log: Path) -> None:
    path = next(log.glob("images/front/*.jpg"))
    picture = Image.open(path)
    header = picture.getexif()
    header[0x0112] = 3
    picture.save(path, exif=header)


def from_one(log: Path) -> None:
    for path in sorted((log / "image_02/data").iterdir(), reverse=True):
        path.rename(path.with_stem(f"{int(path.stem) + 1:010d}"))


def as_png(log: Path) -> None:
    for path in list(log.glob("s*/CAM*/*.jpg")):
        Image.open(path).save(path.with_suffix(".png"))
        path.unlink()


def with_mark(pattern: str) -> Change:
    """Text files with a byte order mark, as editors on Windows write."""

    def change(log: Path) -> None:
        for path in log.glob(pattern):
            path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())

    return change


def stacked(rows: np.ndarray) -> np.ndarray:
    """Five columns in place of four."""
    return np.hstack([rows, rows[:, :1]])


WRONG: dict[str, tuple[str, Change, str]] = {
    "order of the ego's quaternions": ("lightsim", table("ego.csv", reordered), "along its x axis"),
    "ego y forward": ("lightsim", table("ego.csv", turned("z", -90)), "along its x axis"),
    "ego z down": ("lightsim", table("ego.csv", turned("x", 180)), "not upright"),
    "place at 0, 0": (
        "lightsim", document("log.json", lambda v: v.update(place=[0, 0])), "sea off Africa",
    ),
    "inverted mask": ("lightsim", mask(lambda grey: 255 - grey), "Invert the mask"),
    "EXIF": ("lightsim", exif, "auto-orient"),
    "times as text": (
        "pandaset", document("camera/*/timestamps.json", lambda v: [str(x) for x in v]), "is text",
    ),
    "times in nanoseconds": (
        "pandaset", document("lidar/timestamps.json", lambda v: [int(x * 1e9) for x in v]),
        "not milliseconds, nanoseconds",
    ),
    "headings in degrees": (
        "pandaset", frames("annotations/cuboids", lambda t: t.assign(yaw=np.degrees(t.yaw))),
        "yaw of a box.*radians",
    ),
    "pictures from 1": ("kitti", from_one, "counted from 1"),
    "no oxts": ("kitti", lambda log: shutil.rmtree(log / "oxts"), "oxts/timestamps.txt: cannot"),
    "fixes at 0": (
        "kitti",
        lambda log: [
            path.write_text(" ".join(["0", "0", *path.read_text().split()[2:]]))
            for path in log.glob("oxts/data/*.txt")
        ],
        "0, 0 is no fix",
    ),
    "KITTI sweeps with 5 columns": (
        "kitti", floats("velodyne_points/data/*", 4, stacked), "not those of returns",
    ),
    "nuScenes sweeps of doubles": (
        "nuscenes", floats("s*/LIDAR*/*", 5, lambda rows: rows.astype("<f8")), "sweep",
    ),
    "nuScenes sweeps with 4 columns": (
        "nuscenes", floats("s*/LIDAR*/*", 5, lambda rows: rows[:, :4].copy()), "sweep",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG.values(), ids=list(WRONG))
def test_what_cannot_be_right_is_refused(
    made: dict[str, Path], case: tuple[str, Change, str], tmp_path: Path
) -> None:
    name, change, message = case
    with pytest.raises(InputError, match=message):
        read(changed(made, name, change, tmp_path))


NOTED: dict[str, tuple[str, Change, str]] = {
    "inverted cameras": ("lightsim", camera_poses(np.linalg.inv), "may be inverted"),
    "cameras of x forward": (
        "lightsim",
        camera_poses(lambda m: m @ np.linalg.inv(lightsim_log.transform(
            lightsim_log.EGO_FROM_FRONT[:3, :3], (0, 0, 0)))),
        "looks upwards",
    ),
    "cameras of OpenGL": (
        "lightsim", camera_poses(lambda m: m @ np.diag([1, -1, -1, 1])), "is rolled",
    ),
    "length and width": (
        "lightsim",
        table("boxes.csv", lambda row: {"length": row["width"], "width": row["length"]}),
        "wider than long",
    ),
    "headings": ("lightsim", table("boxes.csv", turned("z", 90)), "move sideways"),
    "tilted boxes": ("lightsim", table("boxes.csv", turned("x", 90)), "are tilted"),
    "headings of another axis": (
        "pandaset", frames("annotations/cuboids", lambda t: t.assign(yaw=t.yaw + 1.4)), "sideways",
    ),
    "poses of no picture": ("lightsim", poses_of_pictures(256), "1 of 1 poses belong to no"),
    "another name of a mask": (
        "lightsim",
        lambda log: (log / "masks/front.png").rename(log / "masks/front_mask.png"),
        "masks: .*front_mask.png",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", NOTED.values(), ids=list(NOTED))
def test_what_may_be_wrong_is_noted(
    made: dict[str, Path], plain: dict[str, DrivingLog], case: tuple[str, Change, str],
    tmp_path: Path,
) -> None:  # fmt: skip
    name, change, words = case
    notes = set(read(changed(made, name, change, tmp_path)).notes) - set(plain[name].notes)
    assert any(re.search(words, note) for note in notes), notes


def fractions(frame: pd.DataFrame) -> pd.DataFrame:
    return frame.assign(i=frame.i / 255)


def sweep_fractions(log: Path) -> None:
    for path in log.glob("sweeps/top/*.npz"):
        columns = dict(np.load(path))
        np.savez(path, **(columns | {"intensity": columns["intensity"] / np.float32(255)}))


def sorted_rows(log: Path) -> None:
    frames("annotations/semseg", lambda t: t.assign(**{"class": np.arange(len(t)) % 40}))(log)
    frames("lidar", lambda t: t.sort_values("y"))(log)


SAME: dict[str, tuple[str, Change, bool]] = {
    "intensities 0 to 1": ("pandaset", frames("lidar", fractions), True),
    "intensities 0 to 1 with intensity_max 255": ("lightsim", sweep_fractions, True),
    "intensities 0 to 255 with intensity_max 1": (
        "lightsim",
        document("log.json", lambda v: v["lidars"]["top"].update(intensity_max=1)),
        True,
    ),
    "nuScenes intensities 0 to 1": (
        "nuscenes",
        floats("s*/LIDAR*/*", 5, lambda r: r * np.array([1, 1, 1, 1 / 255, 1], np.float32)),
        True,
    ),
    "KITTI intensities 0 to 255": (
        "kitti",
        floats("velodyne_points/data/*", 4, lambda r: r * np.array([1, 1, 1, 255], np.float32)),
        True,
    ),
    "tables with a byte order mark": ("nuscenes", with_mark("v1.0-*/*.json"), False),
    "calibration with a byte order mark": ("pandaset", with_mark("*.yaml"), False),
    "KITTI text with a byte order mark": ("kitti", with_mark("oxts/**/*.txt"), False),
    "names of Windows": (
        "nuscenes",
        document("v1.0-*/sample_data.json", lambda rows: [
            row | {"filename": row["filename"].replace("/", "\\")} for row in rows]),
        False,
    ),
    "converted pictures": ("nuscenes", as_png, False),
    "mask of 0 and 1": ("lightsim", mask(lambda grey: grey // 255), False),
}  # fmt: skip


@pytest.mark.parametrize("case", SAME.values(), ids=list(SAME))
def test_the_same_log_is_read(
    made: dict[str, Path], plain: dict[str, DrivingLog], case: tuple[str, Change, bool],
    tmp_path: Path,
) -> None:  # fmt: skip
    name, change, is_noted = case
    log, other = read(changed(made, name, change, tmp_path)), plain[name]
    new_notes = set(log.notes) - set(other.notes)
    assert len(new_notes) == is_noted, new_notes
    assert [f.time_ns for f in log.frames] == [f.time_ns for f in other.frames]
    np.testing.assert_allclose(log.ego.matrices, other.ego.matrices, atol=1e-12)
    sweep, expected = log.sweeps[1].load(), other.sweeps[1].load()
    np.testing.assert_allclose(sweep.points_world, expected.points_world, atol=1e-6)
    np.testing.assert_allclose(sweep.intensity, expected.intensity, rtol=1e-5)
    for key, hidden in other.ego_vehicle_masks.items():
        np.testing.assert_array_equal(log.ego_vehicle_masks[key], hidden)


def test_classes_follow_the_rows_of_a_sorted_sweep(made: dict[str, Path], tmp_path: Path) -> None:
    log = read(changed(made, "pandaset", sorted_rows, tmp_path))
    sweep = log.sweeps[0].load()
    # Returns were stored in the order of their times, over one turn.
    stored_row = np.floor((sweep.time_offset_s / mini_log.PERIOD_S + 1) * 400).astype(int)
    assert (np.diff(stored_row) < 0).any()
    np.testing.assert_array_equal(sweep.semantic_class, stored_row % 40)


def test_missing_returns_at_zero_are_dropped(made: dict[str, Path], tmp_path: Path) -> None:
    zero = frames("lidar", lambda t: t.assign(**{k: t[k].where(t.index >= 100, 0) for k in "xyz"}))
    log = read(changed(made, "pandaset", zero, tmp_path))
    assert len(log.sweeps[0].load().points_world) == 300


def test_points_in_the_frame_of_the_sensor_are_refused(tmp_path: Path) -> None:
    # 15 frames at 30 m/s: 42 m.
    folder = mini_log.write_mini_log(tmp_path / "log", 15)
    read(folder)
    frames("lidar", lambda t: t.assign(x=t.x - mini_log.ego_x_m(float(t.t.max()))))(folder)
    with pytest.raises(InputError, match="not in that of the sensor"):
        read(folder)


def test_fixes_at_zero_are_no_fixes(tmp_path: Path) -> None:
    def zero(fixes: Rows) -> Rows:
        return [fix | {"lat": 0.0, "long": 0.0} for fix in fixes]

    folder = mini_log.write_mini_log(tmp_path / "log", 6)
    document("meta/gps.json", lambda fixes: zero(fixes[:2]) + fixes[2:])(folder)
    geo = read(folder).geo
    assert geo is not None
    assert geo.place is not None
    assert geo.place.latitude_deg == pytest.approx(mini_log.LATITUDE_DEG, abs=1e-3)
    assert geo.heading_deg == pytest.approx(90 - mini_log.WORLD_YAW_DEG, abs=0.5)
    document("meta/gps.json", zero)(folder)
    log = read(folder)
    assert log.geo is None
    assert any("6 GPS fixes are 0, 0" in note for note in log.notes)


@pytest.mark.parametrize(
    ("intensity", "expected", "scale"),
    [
        ([0.0, 51.0, 255.0], 255.0, 255.0),
        ([0.0, 1.0, 1.0], 255.0, 255.0),  # Few counts.
        ([0.0, 0.2, 1.0], 255.0, 1.0),
        ([0.0, 51.0, 200.0], 1.0, 255.0),
        ([0.1, 0.2, 0.3, 7e3], 1.0, 1.0),  # A retro-reflector.
        ([300.0, 6e4], 255.0, 65535.0),
        ([0.0, np.nan], 255.0, 255.0),
    ],
)
def test_scale_of_intensities(intensity: list[float], expected: float, scale: float) -> None:
    assert full_scale(np.array(intensity), expected) == scale


def test_gaps_of_the_ego_path_are_noted() -> None:
    def notes(seconds: list[float]) -> tuple[str, ...]:
        poses = np.tile(np.eye(4), (len(seconds), 1, 1))
        poses[:, 0, 3] = 10.0 * np.array(seconds)
        times_ns = (np.array(seconds) * 1e9).astype(np.int64)
        return gap_notes(Trajectory("world", "ego", times_ns, poses), pictures_ns)

    pictures_ns = np.arange(0, 4_000_000_000, 100_000_000)
    assert notes([0.0, 0.1, 0.2, 0.3, 3.0, 3.1, 3.2, 4.0]) == (
        "the ego path has gaps of up to 2.7 s and 27 m: poses of 27 pictures are interpolated",
    )
    assert notes([0.0, 1.1, 2.2, 3.3, 4.4]) == ()
