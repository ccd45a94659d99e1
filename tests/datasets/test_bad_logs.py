"""Broken logs: each gets one clear error that names the file."""

from __future__ import annotations

import gzip
import json
import pickle
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from datasets.mini_log import (
    START_S,
    cuboid_columns,
    sweep_columns,
    write_frame,
    write_json,
    write_mini_log,
)
from lightsim.core.reading import LogReading
from lightsim.datasets.reader import read_log
from lightsim.errors import InputError

Break = Callable[[Path], object]


def change_json(name: str, change: Callable[[Any], Any]) -> Break:
    def apply(log: Path) -> None:
        path = log / name
        write_json(path, change(json.loads(path.read_text())))

    return apply


def with_value(keys: tuple[Any, ...], value: Any) -> Callable[[Any], Any]:
    def change(document: Any) -> Any:
        inner = document
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value
        return document

    return change


def delete(name: str) -> Break:
    def apply(log: Path) -> None:
        path = log / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return apply


def cut(name: str, fraction: float) -> Break:
    def apply(log: Path) -> None:
        path = log / name
        data = path.read_bytes()
        path.write_bytes(data[: int(len(data) * fraction)])

    return apply


def write_text(name: str, text: str) -> Break:
    return lambda log: (log / name).write_text(text)


def change_sweep(**columns: Any) -> Break:
    def apply(log: Path) -> None:
        table = sweep_columns(START_S)
        for name, value in columns.items():
            table[name] = value
        write_frame(log / SWEEP, table)

    return apply


def change_boxes(**columns: Any) -> Break:
    def apply(log: Path) -> None:
        table = cuboid_columns(START_S)
        for name, value in columns.items():
            table[name.replace("__", ".")] = value
        write_frame(log / BOXES, table)

    return apply


def drop_column(name: str, column: str, columns: Callable[[float], dict[str, Any]]) -> Break:
    def apply(log: Path) -> None:
        table = columns(START_S)
        del table[column]
        write_frame(log / name, table)

    return apply


class _RunsCode:
    def __reduce__(self) -> tuple:
        return subprocess.call, (["touch", "ran"],)


def hostile(name: str) -> Break:
    return lambda log: (log / name).write_bytes(gzip.compress(pickle.dumps(_RunsCode())))


def add_picture(name: str, size: tuple[int, int]) -> Break:
    return lambda log: Image.new("RGB", size).save(log / name)


def add_late_sweep(log: Path) -> None:
    change_json("lidar/timestamps.json", lambda t: [*t, t[-1] + 5.0])(log)
    write_frame(log / "lidar/03.pkl.gz", sweep_columns(START_S))


SWEEP, BOXES, CLASSES = (
    "lidar/00.pkl.gz",
    "annotations/cuboids/00.pkl.gz",
    "annotations/semseg/00.pkl.gz",
)
FRONT = "camera/front_camera"
CASES: list[tuple[str, Break, str]] = [
    ("truncated sweep", cut(SWEEP, 0.5), r"00\.pkl\.gz: .*truncated"),
    ("sweep that is no gzip", write_text(SWEEP, "hello"), r"00\.pkl\.gz: .*damaged"),
    ("hostile sweep", hostile(SWEEP), r"00\.pkl\.gz: .*none of its code was run"),
    ("hostile boxes", hostile(BOXES), r"00\.pkl\.gz: .*none of its code was run"),
    ("hostile classes", hostile(CLASSES), r"semseg/00\.pkl\.gz: .*none of its code was run"),
    (
        "sweep without column",
        drop_column(SWEEP, "i", sweep_columns),
        r"00\.pkl\.gz: the column 'i'",
    ),
    (
        "sweep of text",
        change_sweep(x="far"),
        r"00\.pkl\.gz: the column 'x' does not contain numbers.* Write the numbers",
    ),
    (
        "sweep of digits",
        change_sweep(x="1.5"),
        r"the column 'x' does not contain numbers.*astype\(float\)",
    ),
    ("sweep of NaN", change_sweep(x=np.nan), r"00\.pkl\.gz: the sweep has no valid point"),
    ("sweep of another day", change_sweep(t=START_S + 86400), r"00\.pkl\.gz: the points' times"),
    ("unknown LiDAR", change_sweep(d=3), r"00\.pkl\.gz: the column 'd'"),
    (
        "empty sweep",
        lambda log: write_frame(log / SWEEP, {k: np.empty(0) for k in "xyzitd"}),
        "no valid point",
    ),
    (
        "classes of another sweep",
        lambda log: write_frame(log / CLASSES, {"class": np.arange(7)}),
        r"semseg/00\.pkl\.gz",
    ),
    (
        "boxes without column",
        drop_column(BOXES, "yaw", cuboid_columns),
        r"cuboids/00\.pkl\.gz: the column 'yaw'",
    ),
    ("box at NaN", change_boxes(position__x=np.nan), r"cuboids/00\.pkl\.gz, row 0"),
    ("box without size", change_boxes(dimensions__y=0.0), r"cuboids/00\.pkl\.gz, row 0"),
    (
        "box of unknown LiDAR",
        change_boxes(cuboids__sensor_id=5),
        r"cuboids/00\.pkl\.gz: .*sensor_id",
    ),
    (
        "NaN pose",
        change_json(f"{FRONT}/poses.json", with_value((1, "position", "x"), float("nan"))),
        r"poses\.json\[1\]",
    ),
    (
        "zero quaternion",
        change_json(
            f"{FRONT}/poses.json", with_value((1, "heading"), {"w": 0, "x": 0, "y": 0, "z": 0})
        ),
        r"poses\.json\[1\]: .*quaternion",
    ),
    (
        "pose without heading",
        change_json(f"{FRONT}/poses.json", with_value((1,), {"position": {}})),
        r"poses\.json\[1\]: .*'heading'",
    ),
    (
        "poses that are an object",
        change_json(f"{FRONT}/poses.json", lambda _: {}),
        r"poses\.json: not a JSON array",
    ),
    (
        "fewer poses than times",
        change_json(f"{FRONT}/poses.json", lambda p: p[:-1]),
        r"poses\.json: .*differ in number",
    ),
    (
        "missing intrinsics",
        delete(f"{FRONT}/intrinsics.json"),
        r"intrinsics\.json: cannot open",
    ),
    (
        "intrinsics without fx",
        change_json(f"{FRONT}/intrinsics.json", lambda d: {"fy": d["fy"]}),
        r"intrinsics\.json: the key 'fx'",
    ),
    (
        "intrinsics as text",
        change_json(f"{FRONT}/intrinsics.json", with_value(("fx",), "60")),
        r"intrinsics\.json, 'fx'",
    ),
    (
        "focal length zero",
        change_json(f"{FRONT}/intrinsics.json", with_value(("fx",), 0)),
        r"intrinsics\.json: .*do not fit",
    ),
    (
        "bad JSON",
        write_text(f"{FRONT}/intrinsics.json", "{fx: 1"),
        r"intrinsics\.json: .*not valid JSON",
    ),
    (
        "times that run back",
        change_json(f"{FRONT}/timestamps.json", lambda t: t[::-1]),
        r"timestamps\.json: the times do not increase",
    ),
    (
        "times that are no UTC",
        change_json("lidar/timestamps.json", lambda t: [0.1, 0.2, 0.3]),
        r"lidar/timestamps\.json: a time is not in UTC",
    ),
    (
        "LiDAR times of another drive",
        change_json("lidar/timestamps.json", lambda t: [x + 100 for x in t]),
        r"lidar/timestamps\.json: the times differ from those of the other sensors",
    ),
    (
        "a sweep after the drive",
        add_late_sweep,
        r"lidar/03\.pkl\.gz: the camera poses do not reach",
    ),
    (
        "missing LiDAR times",
        delete("lidar/timestamps.json"),
        r"lidar/timestamps\.json: cannot open",
    ),
    (
        "picture exceeds the lists",
        add_picture(f"{FRONT}/09.jpg", (64, 36)),
        r"09\.jpg: .*exceeds the lists",
    ),
    (
        "picture of another size",
        add_picture(f"{FRONT}/01.jpg", (32, 18)),
        r"01\.jpg: .*size differs",
    ),
    (
        "pictures like ribbons",
        lambda log: [add_picture(f"{FRONT}/0{i}.jpg", (2, 12000))(log) for i in range(3)] and None,
        r"00\.jpg: .*aspect ratio is too large",
    ),
    (
        "picture that is none",
        write_text(f"{FRONT}/01.jpg", "no picture"),
        r"01\.jpg: the picture cannot be read",
    ),
    (
        "picture without number",
        add_picture(f"{FRONT}/first.jpg", (64, 36)),
        r"first\.jpg: .*frame number",
    ),
    (
        "camera without pictures",
        lambda log: [p.unlink() for p in (log / FRONT).glob("*.jpg")] and None,
        r"front_camera: the camera has no pictures",
    ),
    ("camera without times", delete(f"{FRONT}/timestamps.json"), r"front_camera/timestamps\.json"),
    ("no camera folder", delete("camera"), r"layout of a supported data set"),
    (
        "sweep exceeds the lists",
        lambda log: write_frame(log / "lidar/77.pkl.gz", sweep_columns(START_S)),
        r"77\.pkl\.gz: .*exceeds the list",
    ),
    (
        "boxes exceed the lists",
        lambda log: write_frame(log / "annotations/cuboids/77.pkl.gz", cuboid_columns(START_S)),
        r"77\.pkl\.gz: .*exceeds the list",
    ),
    (
        "GPS of another length",
        change_json("meta/gps.json", lambda g: g[:-1]),
        r"gps\.json: .*differ in number",
    ),
    (
        "GPS fix without latitude",
        change_json("meta/gps.json", with_value((1,), {"long": 1})),
        r"gps\.json\[1\]: the key 'lat'",
    ),
    (
        "GPS fix off the globe",
        change_json("meta/gps.json", with_value((1, "lat"), 95.0)),
        r"gps\.json\[1\]: the latitude or longitude of a GPS fix is out of range",
    ),
    (
        "calibration of nothing",
        write_text("static_extrinsic_calibration.yaml", "# empty"),
        r"calibration\.yaml: .*no sensor",
    ),
    (
        "calibration with zero quaternion",
        write_text(
            "static_extrinsic_calibration.yaml",
            "front_camera:\n  rotation: {w: 0, x: 0, y: 0, z: 0}\n"
            "  translation: {x: 0, y: 0, z: 0}\n",
        ),
        r"calibration\.yaml: ",
    ),
    (
        "calibration cut short",
        write_text(
            "static_extrinsic_calibration.yaml", "front_camera:\n  rotation: {w: 1, x: 0}\n"
        ),
        r"calibration\.yaml, 'front_camera'",
    ),
    ("truncated picture", cut(f"{FRONT}/01.jpg", 0.6), r"01\.jpg: the picture cannot be read"),
]


@pytest.fixture(scope="module")
def good_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mini_log(tmp_path_factory.mktemp("mini") / "log")


def read_everything(folder: Path) -> tuple[int, int]:
    """Pictures and sweeps that could be read."""
    log = read_log(LogReading(source=str(folder)))
    pictures = [frame.load_srgb8() for frame in log.frames]
    sweeps = [sweep.load() for sweep in log.sweeps]
    return len(pictures), len(sweeps)


def test_the_unbroken_log_reads(good_log: Path) -> None:
    pictures, sweeps = (len(list(good_log.glob(p))) for p in ("camera/*/*.jpg", "lidar/*.pkl.gz"))
    assert read_everything(good_log) == (pictures, sweeps)
    assert min(pictures, sweeps) > 0


@pytest.mark.parametrize(
    ("break_log", "message"), [c[1:] for c in CASES], ids=[c[0] for c in CASES]
)
def test_a_broken_log_raises_an_error_that_names_the_file(
    good_log: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    break_log: Break,
    message: str,
) -> None:
    folder = tmp_path / "log"
    shutil.copytree(good_log, folder)
    break_log(folder)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=message) as caught:
        read_everything(folder)
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "ran").exists()
