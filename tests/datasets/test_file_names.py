"""Logs with other names of files and folders than PandaSet's: read alike, or named in an error."""

from __future__ import annotations

import gzip
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from datasets.mini_log import write_mini_log
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.datasets.pandaset.numbered import PICTURES, TABLES, FileKind, numbered_files
from lightsim.datasets.reader import check_layout, read_log
from lightsim.errors import InputError

Change = Callable[[Path], object]
SWEEPS, BOXES, CLASSES = "lidar", "annotations/cuboids", "annotations/semseg"
FRONT = "camera/front_camera"


def read(folder: Path) -> DrivingLog:
    return read_log(LogReading(source=str(folder)))


def load_all(folder: Path) -> None:
    for sweep in read(folder).sweeps:
        sweep.load()


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mini_log(tmp_path_factory.mktemp("names") / "log")


@pytest.fixture(scope="module")
def plain(good: Path) -> DrivingLog:
    return read(good)


@pytest.fixture
def log(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "log"))


def renamed(folder: str, old: str, new: str, numbers: str = "*") -> Change:
    """Files of a folder under another suffix or name; "{}" stands for their own."""

    def change(log: Path) -> None:
        for path in sorted((log / folder).glob(f"{numbers}{old}")):
            stem = path.name.removesuffix(old)
            path.rename(path.with_name(new.format(stem) if "{}" in new else stem + new))

    return change


def unpacked(folder: str, suffix: str, numbers: str = "*") -> Change:
    """Tables without gzip."""

    def change(log: Path) -> None:
        for path in sorted((log / folder).glob(f"{numbers}.pkl.gz")):
            path.write_bytes(gzip.decompress(path.read_bytes()))
        renamed(folder, ".pkl.gz", suffix, numbers)(log)

    return change


def all_of(*changes: Change) -> Change:
    return lambda log: [change(log) for change in changes] and None


def as_png(log: Path) -> None:
    for path in (log / FRONT).glob("*.jpg"):
        Image.open(path).save(path.with_suffix(".PNG"))
        path.unlink()


READ: dict[str, Change] = {
    "today's mirrors": all_of(*(unpacked(part, ".pkl") for part in (SWEEPS, BOXES, CLASSES))),
    "classes alone": unpacked(CLASSES, ".pkl"),
    "boxes as .PICKLE": unpacked(BOXES, ".PICKLE"),
    "gzip under .pkl": renamed(SWEEPS, ".pkl.gz", ".pkl"),
    "no gzip under .pkl.gz": unpacked(SWEEPS, ".pkl.gz"),
    "both in one folder": unpacked(SWEEPS, ".pkl", "01"),
    "JPG": renamed(FRONT, ".jpg", ".JPG"),
    "jpeg": renamed(FRONT, ".jpg", ".jpeg"),
    "png": as_png,
    "three digits of pictures": renamed(FRONT, ".jpg", "0{}.jpg"),
    "three digits of all": all_of(
        *(renamed(f"camera/{name}", ".jpg", "0{}.jpg") for name in ("front_camera", "back_camera")),
        *(renamed(part, ".pkl.gz", "0{}.pkl.gz") for part in (SWEEPS, BOXES, CLASSES)),
    ),
    "files that are no data": lambda log: [
        (log / folder / name).write_text("x")
        for folder in (FRONT, SWEEPS, BOXES)
        for name in ("README.txt", "Thumbs.db", "._00.jpg", "mask.webp", "00.txt")
    ],
}


@pytest.mark.parametrize("change", READ.values(), ids=list(READ))
def test_other_names_give_the_same_log(log: Path, plain: DrivingLog, change: Change) -> None:
    change(log)
    found = read(log)
    assert found.notes == plain.notes
    assert [a.actor_id for a in found.actors] == [a.actor_id for a in plain.actors]
    numbers = [(f.camera_name, int(f.stem), f.time_ns) for f in found.frames]
    assert numbers == [(f.camera_name, int(f.stem), f.time_ns) for f in plain.frames]
    assert set(found.stems) == {sweep.stem for sweep in found.sweeps}, "frames find their sweeps"
    for ours, theirs in zip(found.sweeps, plain.sweeps, strict=True):
        np.testing.assert_array_equal(ours.load().points_world, theirs.load().points_world)
        assert (ours.load().semantic_class == 7).all()


NOTED: dict[str, tuple[Change, str]] = {
    "no classes": (
        lambda log: shutil.rmtree(log / CLASSES),
        "the log has no point classes: materials are inferred without them",
    ),
    "some classes": (
        lambda log: (log / CLASSES / "01.pkl.gz").unlink(),
        "no point classes for 1 of 3 frames: 1",
    ),
    "some boxes": (
        lambda log: (log / BOXES / "02.pkl.gz").unlink(),
        "no labelled boxes for 1 of 3 frames: 2",
    ),
    "the last sweep": (
        lambda log: (log / SWEEPS / "02.pkl.gz").unlink(),
        "no LiDAR sweep for 1 of 3 frames: 2",
    ),
    "no sweeps": (
        lambda log: [path.unlink() for path in (log / SWEEPS).glob("*.gz")],
        "the log has no LiDAR sweeps, which geometry requires",
    ),
    "a table twice": (
        lambda log: shutil.copy(log / SWEEPS / "00.pkl.gz", log / SWEEPS / "00.pkl"),
        "lidar: 00.pkl.gz is read, 00.pkl beside it is not",
    ),
    "pictures twice": (
        lambda log: [shutil.copy(p, p.with_suffix(".png")) for p in (log / FRONT).glob("*.jpg")],
        "front_camera: 00.jpg is read, 00.png beside it is not (and so for 2 more numbers)",
    ),
}


@pytest.mark.parametrize(("change", "note"), NOTED.values(), ids=list(NOTED))
def test_what_is_left_out_is_noted(log: Path, change: Change, note: str) -> None:
    change(log)
    assert note in read(log).notes


def moved(old: str, new: str) -> Change:
    def change(log: Path) -> None:
        (log / new).parent.mkdir(parents=True, exist_ok=True)
        shutil.move(log / old, log / new)

    return change


def one_level_down(log: Path) -> None:
    shutil.move(log / SWEEPS, log / "all")
    shutil.move(log / "all", log / SWEEPS / "sequence")
    for path in (log / SWEEPS / "sequence").glob("*.json"):
        path.rename(log / SWEEPS / path.name)


REFUSED: dict[str, tuple[Change, str]] = {
    "webp": (renamed(FRONT, ".jpg", ".webp"), r"front_camera: .*00\.webp, 01\.webp"),
    "some webp": (renamed(FRONT, ".jpg", ".webp", "01"), r"front_camera: .*got 01\.webp"),
    "a prefix": (renamed(FRONT, ".jpg", "frame_{}.jpg"), r"frame_00\.jpg: .*frame_01\.jpg"),
    "a browser's copy": (renamed(FRONT, ".jpg", "{} (1).jpg", "01"), r"01 \(1\)\.jpg: .*number"),
    "two widths": (
        lambda log: shutil.copy(log / FRONT / "00.jpg", log / FRONT / "000.jpg"),
        r"00\.jpg, 000\.jpg",
    ),
    "two cases": (
        lambda log: shutil.copy(log / FRONT / "00.jpg", log / FRONT / "00.JPG"),
        r"00\.JPG, 00\.jpg|00\.jpg, 00\.JPG",
    ),
    "an unfinished download": (
        renamed(SWEEPS, ".pkl.gz", ".pkl.gz.part", "02"),
        r"lidar: .*02\.pkl\.gz\.part",
    ),
    "JSON boxes": (renamed(BOXES, ".pkl.gz", ".json"), r"cuboids: .*00\.json"),
    **{
        f"sweeps as {suffix}": (renamed(SWEEPS, ".pkl.gz", suffix), rf"lidar: .*00{suffix}")
        for suffix in (".parquet", ".feather", ".csv", ".npy", ".pcd", ".bin", ".pkl.bz2")
    },
    "a folder too many": (one_level_down, r"lidar: .*the folder sequence"),
    "boxes elsewhere": (moved(BOXES, "cuboids"), r"log/cuboids: .*00\.pkl\.gz"),
    "boxes without their folder": (
        lambda log: [p.rename(log / "annotations" / p.name) for p in (log / BOXES).iterdir()],
        r"log/annotations: .*00\.pkl\.gz",
    ),
    "boxes under another word": (moved(BOXES, "annotations/boxes_3d"), r"annotations/boxes_3d: "),
    "classes elsewhere": (moved(CLASSES, "semseg"), r"log/semseg: .*00\.pkl\.gz"),
    "sweeps in capitals": (moved(SWEEPS, "LiDAR"), r"log/LiDAR: .*00\.pkl\.gz"),
    "cameras in the plural": (moved("camera", "cameras"), r"a folder with annotations, cameras"),
    **{
        f"{name} instead of a table": (
            lambda log, data=data: (log / SWEEPS / "01.pkl.gz").write_bytes(data),
            rf"01\.pkl\.gz: the file is not a pickled table, got {name}",
        )
        for name, data in (
            ("a pointer of Git LFS", b"version https://git-lfs.github.com/spec/v1\noid"),
            ("a web page", b"<!DOCTYPE html>"),
            ("Parquet", b"PAR1 and so on"),
            ("bzip2", b"BZh91AY"),
        )
    },
}


@pytest.mark.parametrize(("change", "message"), REFUSED.values(), ids=list(REFUSED))
def test_what_cannot_be_read_is_named(log: Path, change: Change, message: str) -> None:
    change(log)
    with pytest.raises(InputError, match=message) as caught:
        load_all(log)
    assert str(log) in str(caught.value)


@pytest.mark.parametrize("levels", ["data", "archive/data"])
def test_a_folder_above_sequences_names_them(good: Path, tmp_path: Path, levels: str) -> None:
    for name in ("001", "002"):
        shutil.copytree(good, tmp_path / levels / name)
    source = tmp_path / levels.partition("/")[0]
    first = tmp_path / levels / "001"
    with pytest.raises(InputError, match=rf"2 sequences: 001, 002.*build {first} --work") as caught:
        check_layout(LogReading(source=str(source)))
    assert "layout of a supported data set" in str(caught.value)


@pytest.mark.parametrize("part", ["camera", FRONT, "lidar", BOXES])
def test_a_part_of_a_sequence_names_it(log: Path, part: str) -> None:
    with pytest.raises(InputError, match=rf"a part of the sequence {log}.*build {log} --work"):
        check_layout(LogReading(source=str(log / part)))


def test_an_archive_is_to_be_unpacked(tmp_path: Path) -> None:
    (tmp_path / "pandaset.zip").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"pandaset\.zip: SOURCE is a file.*Unpack"):
        check_layout(LogReading(source=str(tmp_path / "pandaset.zip")))


@pytest.mark.parametrize("kind", [PICTURES, TABLES])
def test_numbers_sort_as_numbers(tmp_path: Path, kind: FileKind) -> None:
    for i, name in enumerate(("10", "9", "100")):
        (tmp_path / f"{name}{kind.suffixes[i % 2]}").touch()
    files = numbered_files(tmp_path, kind)
    assert list(files.paths) == [9, 10, 100]
    assert files.digits == 3
