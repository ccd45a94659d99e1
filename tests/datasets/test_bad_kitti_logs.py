"""Broken and damaged logs of KITTI raw and KITTI-360: each gets one clear error that names the
file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tools.fuzz.mutations import mutate_bytes, mutate_text, pick
from tools.fuzz.targets import use_log

from datasets import kitti_log as made
from lightsim.core.reading import LogReading
from lightsim.datasets.reader import read_log
from lightsim.errors import InputError

Break = Callable[[Path], object]
_OXTS, _CALIB = "oxts/data/0000000001.txt", "../calib_cam_to_cam.txt"


def _text(name: str, old: str, new: str) -> Break:
    def change(folder: Path) -> None:
        path = folder / name
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    return change


def _write(name: str, data: bytes) -> Break:
    return lambda folder: (folder / name).write_bytes(data)


def _remove(name: str) -> Break:
    return lambda folder: (folder / name).unlink()


_XML, _BIN = "tracklet_labels.xml", "velodyne_points/data/0000000000.bin"
_BOMB = (
    b'<?xml version="1.0"?><!DOCTYPE b [<!ENTITY a "aaaaaaaa">]><b><tracklets>&a;</tracklets></b>'
)
BROKEN: tuple[tuple[Break, str], ...] = (
    (_remove("../calib_velo_to_cam.txt"), r"calib_velo_to_cam.txt: .*cannot open"),
    (_text(_CALIB, "P_rect_02", "P_rect_09"), r"calib_cam_to_cam.txt: .*'P_rect_02'"),
    (_text(_CALIB, "S_rect_02: 6.4", "S_rect_02: 6.5"), r"0000000000.png: .*size differs"),
    (_text(_CALIB, "S_rect_02: 6.400000e+01", "S_rect_02: 6.4e9"), r"calib_cam_to_cam.txt: .*size"),
    (_text("../calib_imu_to_velo.txt", "R: ", "R: 7"), r"calib_imu_to_velo.txt: .*no rotation"),
    (_text("../calib_imu_to_velo.txt", "T: ", "T: nan"), r"calib_imu_to_velo.txt: .*'T'"),
    (_write("oxts/timestamps.txt", b"\n\n"), r"oxts/timestamps.txt: .*no time stamps"),
    (_text("oxts/timestamps.txt", "2011-09", "2011-19"), r"oxts/timestamps.txt: .*no time stamp"),
    (_write(_OXTS, b"49.0 8.4"), r"0000000001.txt, line 1: .*no row"),
    (_text(_OXTS, "49.0", "490.0"), r"0000000001.txt: .*out of range"),
    (_write(_OXTS, b"\xff\xfe"), r"0000000001.txt: .*no text"),
    (_write(_BIN, b"x" * 17), r"0000000000.bin: .*truncated"),
    (_write(_BIN, np.full(8, np.inf, "<f4").tobytes()), r"0000000000.bin: .*no valid point"),
    (_write(_XML, b"<a><b>"), r"tracklet_labels.xml: .*not valid XML"),
    (_write(_XML, _BOMB), r"tracklet_labels.xml: .*declares entities"),
    (_write(_XML, b"<a>" * 100), r"tracklet_labels.xml: .*nested"),
    (_text(_XML, "<l>4.2</l>", "<l>-1</l>"), r"tracklet_labels.xml, actor 0000: .*size"),
    (_text(_XML, "<tx>12.0</tx>", "<tx>nan</tx>"), r"tracklet 0, pose 0: <tx> is not"),
    (_text(_XML, "<objectType>Car</objectType>", ""), r"tracklet 0: .*no <objectType>"),
    (_text(_XML, "<tx>12.0</tx>", "<tx>1e5</tx>"), r"tracklet 0, pose 0: .*beyond the LiDAR"),
    (_write("image_02/data/0000000000.png", b"\x89PNG"), r"0000000000.png: .*cannot be read"),
)


@pytest.mark.parametrize("case", BROKEN, ids=range(len(BROKEN)))
def test_broken_files_give_one_error_that_names_them(
    case: tuple[Break, str], tmp_path: Path
) -> None:
    drive = made.write_kitti(tmp_path)
    case[0](drive)
    with pytest.raises(InputError, match=case[1]):
        use_log(read_log(LogReading(source=str(drive))))


_POSES = f"data_poses/{made.DRIVE360}/poses.txt"
_BOXES = f"data_3d_bboxes/train/{made.DRIVE360}.xml"
BROKEN360: tuple[tuple[Break, str], ...] = (
    (_remove("calibration/image_03.yaml"), r"image_03.yaml: .*cannot open"),
    (_text("calibration/image_02.yaml", "xi: 2.2", "xi: -3"), r"image_02.yaml: .*fisheye"),
    (
        _text("calibration/image_02.yaml", "gamma1: 61.0", "gamma1: 6e5"),
        r"image_02.yaml: .*fisheye",
    ),
    (_write("calibration/calib_cam_to_velo.txt", b"1 0 0"), r"calib_cam_to_velo.txt, line 1"),
    (_remove(_POSES), r"poses.txt: cannot open"),
    (_write(_POSES, b"0 " + b"2 " * 12), r"poses.txt: .*no rotation"),
    (_write(_POSES, b"99 " + b"1 " * 12), r"poses.txt: no pose has a time stamp"),
    (_text(_BOXES, "<timestamp>0</timestamp>", ""), r"sync.xml, <object1>: .*no <timestamp>"),
    (_text(_BOXES, "<instanceId>7", "<instanceId>x"), r"sync.xml, <object1>: <instanceId>"),
    (_text(_BOXES, "</data></transform>", " 5</data></transform>"), r"<object1>: a box has no"),
)


@pytest.mark.parametrize("case", BROKEN360, ids=range(len(BROKEN360)))
def test_broken_files_of_kitti360(case: tuple[Break, str], tmp_path: Path) -> None:
    root = made.write_kitti360(tmp_path / "root")
    case[0](root)
    with pytest.raises(InputError, match=case[1]):
        use_log(read_log(LogReading(source=str(root))))


def fuzz(folder: Path, source: Path, name: str, count: int, seed: int) -> int:
    """Read a log with one damaged file, `count` times; return how often it was accepted."""
    files = sorted(path for path in source.rglob("*") if path.is_file())
    accepted = 0
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        path = pick(rng, files)
        whole = path.read_bytes()
        is_text = path.suffix in (".txt", ".xml", ".yaml") and rng.random() < 0.8
        if is_text:
            text, words = mutate_text(whole.decode(), rng)
            data = text.encode(errors="replace")
        else:
            data, words = mutate_bytes(whole, rng)
        path.write_bytes(data)
        try:
            use_log(read_log(LogReading(source=str(folder), dataset=name, image_scale=1.0)))
            accepted += 1
        except InputError:
            pass
        except Exception as error:
            raise AssertionError(f"case {number}: {path.name}: {words}") from error
        finally:
            path.write_bytes(whole)
    return accepted


@pytest.mark.parametrize("name", ["kitti", "kitti360"])
def test_damaged_logs_give_clear_errors(name: str, tmp_path: Path) -> None:
    source = tmp_path / "log"
    drive = made.write_kitti(source) if name == "kitti" else made.write_kitti360(source)
    accepted = fuzz(drive, source, name, 15, 1)
    assert 0 < accepted < 15
