"""Broken nuScenes data sets: each gets one clear error that names the file."""

from __future__ import annotations

import os
import shutil
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datasets.nuscenes_log import write_data_set
from datasets.test_bad_logs import Break, change_json, cut, delete, with_value, write_text
from lightsim.core.reading import LogReading
from lightsim.datasets.reader import read_log
from lightsim.errors import InputError

TABLES = "v1.0-mini"


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Generator[Path]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIGHTSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield write_data_set(tmp_path_factory.mktemp("made") / "nuscenes")


def row_value(table: str, key: str, value: Any, row: int = 0) -> Break:
    return change_json(f"{TABLES}/{table}.json", with_value((row, key), value))


def without(table: str, key: str) -> Break:
    def change(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        del rows[0][key]
        return rows

    return change_json(f"{TABLES}/{table}.json", change)


def without_row(table: str) -> Break:
    return change_json(f"{TABLES}/{table}.json", lambda rows: rows[1:])


def another_calibration(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [*rows, {**rows[0], "token": "another"}]


def with_two_calibrations(folder: Path) -> None:
    change_json(f"{TABLES}/calibrated_sensor.json", another_calibration)(folder)
    row_value("sample_data", "calibrated_sensor_token", "another")(folder)


def first(pattern: str, damage: Any) -> Break:
    """Damage the first file of a pattern."""

    def apply(folder: Path) -> None:
        path = sorted(folder.glob(pattern))[0]
        damage(path.relative_to(folder).as_posix())(folder)

    return apply


SWEEP, PICTURE = "samples/LIDAR_TOP/*", "samples/CAM_FRONT/*"
NAN = float("nan")
CASES: list[tuple[str, Break, str]] = [
    ("no table", delete(f"{TABLES}/sample_data.json"), r"sample_data\.json: cannot open"),
    ("no poses", delete(f"{TABLES}/ego_pose.json"), r"ego_pose\.json: cannot open"),
    ("truncated table", cut(f"{TABLES}/sample_data.json", 0.5), r"sample_data\.json: .*not valid"),
    ("object", write_text(f"{TABLES}/scene.json", '{"name": 1}'), r"scene\.json: .*not valid"),
    ("numbers", write_text(f"{TABLES}/sample.json", "[1, 2]"), r"sample\.json: .*no array of obj"),
    ("more text", write_text(f"{TABLES}/sample.json", "[] []"), r"sample\.json: .*text after"),
    ("deep", write_text(f"{TABLES}/sensor.json", "[" * 10**5), r"sensor\.json: .*not valid"),
    ("no UTF-8", lambda f: (f / TABLES / "log.json").write_bytes(b"[\xff]"), r"log\.json: .*not"),
    ("empty table", write_text(f"{TABLES}/sample_data.json", "[]"), "has no ego poses"),
    ("scene without name", without("scene", "name"), r"scene\.json.*'name'.*a row with"),
    ("token of another type", row_value("sample", "token", 5), r"sample\.json.*'token'"),
    ("NaN position", row_value("ego_pose", "translation", [NAN, 0.0, 0.0]), r"ego_pose\.json"),
    ("two numbers", row_value("ego_pose", "translation", [0.0, 0.0]), r"ego_pose\.json.*3 numbers"),
    ("no rotation", row_value("ego_pose", "rotation", [0.0] * 4), r"ego_pose\.json.*unit quat"),
    ("far away", row_value("ego_pose", "translation", [9e9, 0.0, 0.0]), "too far from the world"),
    ("seconds", row_value("sample_data", "timestamp", 1.5e9), r"sample_data\.json.*microseconds"),
    ("text time", row_value("ego_pose", "timestamp", "now"), r"ego_pose\.json.*microseconds"),
    ("file outside", row_value("sample_data", "filename", "a/../../b.jpg"), r"below .*nuscenes"),
    ("absolute", row_value("sample_data", "filename", "/etc/passwd"), r"sample_data\.json.*below"),
    ("no file name", row_value("sample_data", "filename", ""), r"sample_data\.json.*below"),
    ("other calibration", without_row("calibrated_sensor"), r"no row .*calibrated_sensor\.json"),
    ("other sensor", without_row("sensor"), r"no row with this token in sensor\.json"),
    ("two calibrations", with_two_calibrations, r"calibrated_sensor\.json.*two calibrations"),
    ("other instance", without_row("instance"), r"sample_annotation\.json.*no row .*instance"),
    ("other attribute", without_row("attribute"), r"no row with this token in attribute\.json"),
    ("size of a box", row_value("sample_annotation", "size", [1.0]), r"annotation.*3 numbers"),
    ("flat box", row_value("sample_annotation", "size", [1.0, 1.0, 0.0]), r"size of a box"),
    ("far box", row_value("sample_annotation", "translation", [0.0, 0.0, 0.0]), "beyond the LiDAR"),
    ("no matrix", row_value("calibrated_sensor", "camera_intrinsic", []), r"calibrated.*3 lists"),
    (
        "skewed matrix",
        row_value("calibrated_sensor", "camera_intrinsic", [[50.0, 1, 31], [0, 50, 23], [0, 0, 1]]),
        r"calibrated_sensor\.json/CAM_FRONT/camera_intrinsic: the camera matrix",
    ),
    (
        "pictures of another size",
        row_value("calibrated_sensor", "camera_intrinsic", [[99.0, 0, 99], [0, 99, 75], [0, 0, 1]]),
        r"calibrated_sensor\.json/CAM_FRONT/camera_intrinsic: .*another size",
    ),
    (
        "nine coefficients",
        row_value("calibrated_sensor", "camera_distortion", [0.1] * 9),
        r"calibrated_sensor\.json/CAM_FRONT/camera_intrinsic: the intrinsics",
    ),
    (
        "camera elsewhere",
        row_value("calibrated_sensor", "translation", [99.0, 0.0, 0.0]),
        "not on the vehicle",
    ),
    ("truncated sweep", first(SWEEP, lambda name: cut(name, 0.501)), r"\.bin: .*truncated"),
    ("empty sweep", first(SWEEP, lambda name: cut(name, 0.0)), r"\.bin: .*truncated"),
    ("endless sweep", first(SWEEP, lambda n: lambda f: os.truncate(f / n, 1 << 40)), "too large"),
    ("truncated picture", first(PICTURE, lambda name: cut(name, 0.6)), r"\.jpg: the picture"),
]


def read_everything(folder: Path) -> tuple[int, int]:
    log = read_log(LogReading(source=str(folder)))
    pictures = [frame.load_srgb8() for frame in log.frames]
    sweeps = [sweep.load() for sweep in log.sweeps]
    return len(pictures), len(sweeps)


def test_the_unbroken_log_reads(good: Path) -> None:
    assert read_everything(good) == (14, 7)


@pytest.mark.parametrize(("damage", "message"), [c[1:] for c in CASES], ids=[c[0] for c in CASES])
def test_a_broken_log_raises_an_error_that_names_the_file(
    good: Path, tmp_path: Path, damage: Break, message: str
) -> None:
    folder = tmp_path / "nuscenes"
    shutil.copytree(good, folder)
    damage(folder)
    with pytest.raises(InputError, match=message) as caught:
        read_everything(folder)
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_cache_that_cannot_be_written_is_an_error_with_a_remedy(
    good: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("LIGHTSIM_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(InputError, match=r"file/cache/nuscenes: .*Set LIGHTSIM_CACHE"):
        read_log(LogReading(source=str(good)))


def test_a_signalling_nan_among_the_rings_is_no_ring(tmp_path: Path) -> None:
    """NumPy warns of a signalling NaN (7FA00000) when it casts one to another type."""
    folder = write_data_set(tmp_path / "data")
    path = next((folder / "samples" / "LIDAR_TOP").iterdir())
    stored = np.fromfile(path, dtype="<u4").reshape(-1, 5)
    stored[1, 4] = 0x7FA00000
    stored.tofile(path)
    sweeps = [lazy.load() for lazy in read_log(LogReading(source=str(folder))).sweeps]
    assert sum(int((sweep.ring == -1).sum()) for sweep in sweeps) == 1
