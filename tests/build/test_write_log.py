"""`lightsim simulate --write-log`: the log that comes out, as others read it and as we do."""

from __future__ import annotations

import glob
import gzip
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from scipy.spatial import KDTree
from tests.build.test_simulate import ahead_of_ego, request
from tests.conftest import BuiltStreet

from lightsim import cli
from lightsim.build.workspace import Workspace
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.core.scenario import Scenario
from lightsim.datasets.pandaset.rig import CALIBRATION_FILE, read_rig
from lightsim.datasets.reader import read_log
from lightsim.datasets.safe_pickle import names_in, read_table
from lightsim.errors import InputError, LightSimError
from lightsim.export.pandaset.lists import WrittenFrames, _without_readout, _write
from lightsim.export.pandaset.log import _is_made, log_folders
from lightsim.simulation.options import SimulateOptions
from lightsim.simulation.relight import replayed
from lightsim.store.pandaset_tables import cuboid_table, write_table
from lightsim.store.table_pickle import PORTABLE_NAMES
from lightsim_lab.synthetic import shipped_street

SHIFT_M = 1.0
AHEAD_M = 9.0
SMALL = ("--image-scale", "0.125")
ONE_CAMERA = ("--cameras", "front_camera")
RECORDED = shipped_street() / "log"


def simulated(work: Path, path: Path, log: Path, *words: str) -> DrivingLog:
    cli.main(["simulate", str(work), str(path), "--write-log", str(log), *words])
    return read_log(LogReading(source=str(log)))


@pytest.fixture(scope="module")
def edited(built_street: BuiltStreet, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everybody is gone, and a red car stands in the way; two frames under two skies."""
    folder = tmp_path_factory.mktemp("written")
    edits = [
        {"do": "remove", "actor": "all"},
        {
            "do": "insert",
            "asset": "car-red",
            "id": "mine",
            "at": ahead_of_ego(built_street.work, AHEAD_M),
        },
    ]
    path = request(folder, "written", edits)
    words = ["--sky", "source", "sun:120,30", "--frames", "2:4", *SMALL]
    log = ["--write-log", str(folder / "log")]
    cli.main(["simulate", str(built_street.work), str(path), *words, *log])
    return folder / "log"


def test_a_log_without_edits_is_the_recorded_one(built_street: BuiltStreet, tmp_path: Path) -> None:
    """Byte by byte; but tables that version 0.2 wrote are written anew for older pandas."""
    path, log = request(tmp_path, "written-plain", []), tmp_path / "log"
    words = ("--frames", "0:2", "--image-scale", "1")
    simulated(built_street.work, path, log, *words)
    files = {p.relative_to(log) for p in log.rglob("*") if p.suffix in (".jpg", ".gz")}
    assert len(files) == 2 * 2 + 2 + 2
    for name in (*files, Path("static_extrinsic_calibration.yaml")):
        if name.suffix == ".gz":
            again, frame = (pd.DataFrame(pd.read_pickle(root / name)) for root in (log, RECORDED))
            pd.testing.assert_frame_equal(again, frame, check_column_type=False, check_dtype=False)
            assert names_in(gzip.decompress((log / name).read_bytes()), name) <= PORTABLE_NAMES
        else:
            assert (log / name).read_bytes() == (RECORDED / name).read_bytes(), name
    for name in ("camera/left_camera/poses.json", "lidar/poses.json", "meta/gps.json"):
        assert json.loads((log / name).read_text()) == json.loads((RECORDED / name).read_text())[:2]


@pytest.fixture(scope="module")
def street(built_street: BuiltStreet) -> tuple[Workspace, Scenario]:
    work = Workspace(built_street.work)
    return work, replayed(work, SimulateOptions(name="written"))


@pytest.mark.parametrize("skies", [["source"], ["source", "sun"]])
def test_a_log_takes_no_place_of_anything_else(
    street: tuple[Workspace, Scenario], tmp_path: Path, skies: list[str]
) -> None:
    """Asked before any frame is made."""
    work, recorded = street
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "source").write_text("dear")
    (tmp_path / "marked").mkdir()
    (tmp_path / "marked" / "simulated.json").write_text("[]")
    (tmp_path / "round").symlink_to("round")
    (tmp_path / "link").symlink_to(RECORDED)
    for place in (
        tmp_path / "mine",
        tmp_path / "marked",
        tmp_path / "mine" / "source" / "below",
        tmp_path / "round" / "log",
        tmp_path / "link" / "log",
        RECORDED / "camera" / "back",
        work.root / "scenarios" / "new",
        work.root / "twin" / "log",
    ):
        with pytest.raises(LightSimError) as reported:
            log_folders(work, recorded, place, skies)
        assert "--write-log" in str(reported.value) or "choose a folder" in str(reported.value)
    assert (tmp_path / "mine" / "source").read_text() == "dear"
    with pytest.raises(InputError, match="--frames"):
        log_folders(work, replace(recorded, frames=()), tmp_path / "log", skies)


def test_a_log_may_stand_in_an_empty_folder_or_behind_a_link(
    street: tuple[Workspace, Scenario], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, recorded = street
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to("empty")
    monkeypatch.chdir(tmp_path / "empty")
    for place in (Path("."), tmp_path / "link", Path("../empty")):
        assert log_folders(work, recorded, place, ["source"]) == {"source": tmp_path / "empty"}
    logs = log_folders(work, recorded, tmp_path / "link", ["source", "sun"])
    assert logs == {sky: tmp_path / "empty" / sky for sky in ("source", "sun")}


def test_recorded_entries_are_taken_over_as_they_are(tmp_path: Path) -> None:
    """NaN and all; a list that ends early stays as short."""
    path = tmp_path / "gps.json"
    path.write_text('[{"lat": 1.5}, {"lat": 2.5, "xvel": NaN, "height": null}, {"lat": 3.5}]')
    frames = WrittenFrames({1: "01", 2: "02", 7: "07"})
    _write(tmp_path / "again.json", frames.entries(path))
    assert "NaN" in (tmp_path / "again.json").read_text()
    again = json.loads((tmp_path / "again.json").read_text())
    assert [entry["lat"] for entry in again] == [2.5, 3.5]
    (tmp_path / "broken.json").write_text('{"lat": 1}')
    with pytest.raises(InputError, match=r"broken\.json"):
        frames.entries(tmp_path / "broken.json")


def test_a_calibration_without_readout_of_some_cameras(tmp_path: Path) -> None:
    text = "".join(
        f"{name}: # {name}\n  rotation: {{w: 1, x: 0, y: 0, z: 0}}\n"
        "  translation: {x: 0, y: 0, z: 0}\n  readout_s: 0.02\n"
        for name in ("front_camera", "left_camera")
    )
    (tmp_path / CALIBRATION_FILE).write_text(_without_readout(text, {"left_camera"}))
    assert read_rig(tmp_path).readout_s_by_camera == {"front_camera": 0.02, "left_camera": 0.0}


def test_boxes_may_lack_numbers(tmp_path: Path) -> None:
    rows = [{"uuid": "a", "camera_used": np.nan, "stationary": None, "label": None, "yaw": 1.0}]
    rows.append({"uuid": "b", "camera_used": -1, "stationary": True, "label": "Car", "yaw": 2.0})
    names = ("uuid", "camera_used", "stationary", "label", "yaw")
    write_table(tmp_path / "00.pkl.gz", cuboid_table(rows, names))
    table = read_table(tmp_path / "00.pkl.gz", names)
    np.testing.assert_array_equal(table["camera_used"], [np.nan, -1.0])
    np.testing.assert_array_equal(table["stationary"], [np.nan, 1.0])
    assert cuboid_table(rows[1:], names)["camera_used"].dtype == np.int64
    assert cuboid_table(rows[1:], names)["stationary"].dtype == np.bool_


def listed(path: Path) -> list[Any]:
    return list(json.loads(path.read_text()))


def test_pandaset_s_devkit_can_read_it(edited: Path) -> None:
    """Every call that the devkit makes, on files in the order in which it takes them: it pairs
    pictures, sweeps, poses and times by their places."""
    log = edited / "source"
    cameras = [p for p in (log / "camera").iterdir() if p.is_dir()]
    assert sorted(c.name for c in cameras) == ["front_camera", "left_camera"]
    for camera in cameras:
        pictures = [Image.open(p).copy() for p in sorted(glob.glob(f"{camera}/*.jpg"))]
        poses, times = listed(camera / "poses.json"), listed(camera / "timestamps.json")
        assert len(pictures) == len(poses) == len(times) == 2
        assert pictures[0].size == (60, 34)
        intrinsics = json.loads((camera / "intrinsics.json").read_text())
        recorded = json.loads((RECORDED / "camera" / camera.name / "intrinsics.json").read_text())
        assert intrinsics["fx"] == pytest.approx(recorded["fx"] / 8)
        assert intrinsics["cx"] == pytest.approx((recorded["cx"] + 0.5) / 8 - 0.5)
        assert set(poses[0]) == {"position", "heading"}
        assert list(poses[0]["position"]) == ["x", "y", "z"]
        assert list(poses[0]["heading"]) == ["w", "x", "y", "z"]
    sweeps = [pd.read_pickle(p) for p in sorted(glob.glob(f"{log}/lidar/*.pkl.gz"))]
    assert len(sweeps) == len(listed(log / "lidar/poses.json")) == 2
    recorded = pd.read_pickle(RECORDED / "lidar" / "02.pkl.gz")
    assert list(recorded.columns) == ["x", "y", "z", "i", "t", "d"]
    # Names as plain objects, as in PandaSet's own files: older pandas know no other text.
    assert sweeps[0].columns.dtype == object
    pd.testing.assert_frame_equal(sweeps[0].iloc[:0], recorded.iloc[:0], check_column_type=False)
    assert len(sweeps[0].loc[sweeps[0]["d"] == 0]) == len(sweeps[0])
    times = listed(log / "lidar/timestamps.json")
    assert times == listed(log / "meta/timestamps.json")
    assert abs(sweeps[1]["t"] - times[1]).max() < 0.11
    assert set(listed(log / "meta/gps.json")[0]) == {"lat", "long", "height", "xvel", "yvel"}
    cuboids = [pd.read_pickle(p) for p in sorted(glob.glob(f"{log}/annotations/cuboids/*.pkl.gz"))]
    boxes = pd.read_pickle(RECORDED / "annotations/cuboids/02.pkl.gz")
    assert list(cuboids[0].columns) == list(boxes.columns)
    assert cuboids[0]["yaw"].dtype == np.float64
    assert cuboids[0]["stationary"].dtype == np.bool_
    assert cuboids[0]["label"].dtype == object
    assert (list(cuboids[0]["uuid"]), list(cuboids[0]["label"])) == (["mine"], ["Car"])


def test_our_reader_finds_the_edited_street(edited: Path, built_street: BuiltStreet) -> None:
    """The inserted car is where it was put, its returns lie in its box and nothing behind it."""
    log = read_log(LogReading(source=str(edited / "source")))
    recorded = Workspace(built_street.work).recorded_log
    assert [s.time_ns for s in log.sweeps] == [s.time_ns for s in recorded.sweeps[2:4]]
    (mine,) = log.actors
    assert (mine.actor_id, mine.kind, mine.is_moving) == ("mine", "car", False)
    at = ahead_of_ego(built_street.work, AHEAD_M)
    pose = mine.world_from_actor(log.sweeps[0].time_ns, 0.2)
    np.testing.assert_allclose(pose.translation_m[:2], [at["x_m"], at["y_m"]], atol=0.05)
    assert np.degrees(pose.yaw_rad) == pytest.approx(at["yaw_deg"], abs=0.5)
    sweep = log.sweeps[0].load()
    local = pose.inverse().apply(sweep.points_world.astype(np.float64))
    inside = (np.abs(local) < mine.size_lwh_m / 2 + 0.15).all(axis=1)
    inside &= local[:, 2] > 0.3 - mine.size_lwh_m[2] / 2
    assert inside.sum() > 100
    # No beam goes through the body: those towards its core end in the box.
    start = pose.inverse().apply(sweep.origins_world.astype(np.float64))
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = [(side * mine.size_lwh_m / 4 - start) / (local - start) for side in (-1.0, 1.0)]
    enter, leave = np.minimum(*ends).max(axis=1), np.maximum(*ends).min(axis=1)
    to_core = (leave > enter) & (enter > 0.0)
    assert to_core.sum() > 30
    assert (enter[to_core] > 0.9).all()
    assert any("simulated" in note for note in log.notes)


def test_each_sky_has_its_log_of_one_street(edited: Path) -> None:
    names = sorted(p.name for p in edited.iterdir())
    assert len(names) == 2
    assert "source" in names
    other = edited / next(n for n in names if n != "source")
    for path in (edited / "source").rglob("*"):
        same = other / path.relative_to(edited / "source")
        if path.is_file() and path.name != "simulated.json":
            is_picture = path.suffix == ".jpg"
            assert (same.read_bytes() == path.read_bytes()) != is_picture, same
    mark = json.loads((other / "simulated.json").read_text())
    assert mark["recorded_frames"] == {"00": "02", "01": "03"}
    assert [edit["do"] for edit in mark["edits"]] == ["remove", "insert"]


def test_a_log_is_made_anew_where_its_frames_or_lightsim_are_others(edited: Path) -> None:
    log = edited / "source"
    mark = json.loads((log / "simulated.json").read_text())
    now = {key: mark[key] for key in ("sky", "frames_key")}
    others = now | {"frames_key": "others"}
    assert _is_made(log, now, is_overwriting=False)
    assert _is_made(log, now, is_overwriting=True)
    assert not _is_made(log, others, is_overwriting=True)
    with pytest.raises(InputError, match="--overwrite"):
        _is_made(log, others, is_overwriting=False)
    try:
        (log / "simulated.json").write_text(json.dumps({**mark, "code": "other"}))
        assert not _is_made(log, now, is_overwriting=False)
    finally:
        (log / "simulated.json").write_text(json.dumps(mark))


def test_another_path_carries_all_sensors_along(built_street: BuiltStreet, tmp_path: Path) -> None:
    work = built_street.work
    path = request(tmp_path, "written-beside", [{"do": "ego", "offset_m": [0.0, SHIFT_M, 0.0]}])
    log = simulated(work, path, tmp_path / "log", "--frames", "0:2", *ONE_CAMERA, *SMALL)
    recorded = Workspace(work).recorded_log
    time_ns = recorded.sweeps[0].time_ns
    was, now = recorded.ego.at(time_ns, 0.2), log.ego.at(time_ns, 0.2)
    np.testing.assert_allclose(
        now.translation_m - was.translation_m, SHIFT_M * was.rotation[:, 1], atol=0.02
    )
    sweeps = recorded.sweeps[0].load(), log.sweeps[0].load()
    shift = sweeps[1].origins_world.mean(axis=0) - sweeps[0].origins_world.mean(axis=0)
    np.testing.assert_allclose(shift, SHIFT_M * was.rotation[:, 1], atol=0.05)
    assert 0.85 < len(sweeps[1].points_world) / len(sweeps[0].points_world) < 1.15
    # The road stays where it is: new returns lie as high as recorded ones did.
    heights = [was.inverse().apply(s.points_world.astype(np.float64))[:, 2] for s in sweeps]
    near, which = KDTree(sweeps[0].points_world[:, :2]).query(sweeps[1].points_world[:, :2])
    on_road = (np.asarray(near) < 0.2) & (np.abs(heights[0][which]) < 0.1)
    assert on_road.sum() > 1000
    assert np.median(np.abs(heights[1] - heights[0][which])[on_road]) < 0.03
