"""Exports in nuScenes' layout: tables that hold together, boxes and points in their places."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.export.devkit import probed
from tests.export.tiny_export import (
    FIRST_NS,
    STEMS,
    Labels,
    box_mask,
    box_track,
    camera_of,
    edges,
    ego_path,
    tiny_log,
)

from lightsim.core.actors import ActorKind
from lightsim.core.frames import matrices_from_quaternions
from lightsim.core.sensors import LazySweep
from lightsim.export.nuscenes.log import VERSION, write_nuscenes
from lightsim.export.nuscenes.names import CATEGORIES, CATEGORY_BY_KIND, channel_by_camera
from lightsim.export.nuscenes.samples import Samples
from lightsim.export.nuscenes.tables import NAMES, Tables
from lightsim.export.provenance import Written
from lightsim.export.scenario_log import ScenarioLog
from lightsim.progress import SilentProgress
from lightsim.store.images import read_srgb8

STEP_NS = 100_000_000


def exported(log: ScenarioLog, folder: Path) -> tuple[dict[str, list[dict[str, Any]]], Written]:
    folder.mkdir()
    written = write_nuscenes(log, folder, SilentProgress())
    tables = {n: json.loads((folder / VERSION / f"{n}.json").read_text()) for n in NAMES}
    return tables, written


def test_all_rows_and_files_that_are_named_exist(tmp_path: Path) -> None:
    tables, written = exported(tiny_log(tmp_path / "made"), tmp_path / "out")
    tokens = {name: {row["token"] for row in rows} for name, rows in tables.items()}
    assert all(len(tokens[name]) == len(rows) for name, rows in tables.items())
    table_of = {
        "sensor_token": "sensor", "sample_token": "sample", "ego_pose_token": "ego_pose",
        "calibrated_sensor_token": "calibrated_sensor", "instance_token": "instance",
        "category_token": "category", "visibility_token": "visibility", "scene_token": "scene",
        "log_token": "log", "first_sample_token": "sample", "last_sample_token": "sample",
        "first_annotation_token": "sample_annotation", "attribute_tokens": "attribute",
        "last_annotation_token": "sample_annotation", "log_tokens": "log",
    }  # fmt: skip
    links = 0
    for name, rows in tables.items():
        for row in rows:
            for key, value in row.items():
                values = value if isinstance(value, list) else [value]
                if key in table_of:
                    assert set(values) <= tokens[table_of[key]], (name, key)
                    links += 1
                elif key in ("prev", "next"):
                    assert value == "" or value in tokens[name]
                elif key == "filename":
                    assert (tmp_path / "out" / str(value)).is_file()
    assert links > 50
    assert [row["is_key_frame"] for row in tables["sample_data"]] == [True] * 9
    assert written.pictures[0][0].startswith("samples/CAM_FRONT/")
    assert tables["sensor"][1]["channel"] == "CAM_BACK_LEFT"
    assert {row["name"] for row in tables["category"]} == set(CATEGORIES)
    assert set(CATEGORY_BY_KIND.values()) <= set(CATEGORIES)


def test_boxes_poses_and_points_are_those_of_the_log(tmp_path: Path) -> None:
    log = tiny_log(tmp_path / "made", labels=Labels(box_track(), hidden=0.5))
    tables, _ = exported(log, tmp_path / "out")
    (track,) = log.log.actors
    for number, row in enumerate(tables["sample_annotation"]):
        pose = track.trajectory.matrices[number]
        np.testing.assert_allclose(row["translation"], pose[:3, 3], atol=1e-9)
        rotation = matrices_from_quaternions(np.array([row["rotation"]]))[0]
        np.testing.assert_allclose(rotation, pose[:3, :3], atol=1e-9)
        assert row["size"] == [2.0, 4.0, 1.5]
        assert row["num_lidar_pts"] == 3
        # Half of the columns are hidden.
        assert row["visibility_token"] == "2"
    moving = {row["token"] for row in tables["attribute"] if row["name"] == "vehicle.moving"}
    assert {t for row in tables["sample_annotation"] for t in row["attribute_tokens"]} == moving
    data = {row["token"]: row for row in tables["sample_data"]}
    poses = {row["token"]: row for row in tables["ego_pose"]}
    mounts = {row["token"]: row for row in tables["calibrated_sensor"]}
    for row in data.values():
        if row["fileformat"] != "pcd":
            continue
        points = np.fromfile(tmp_path / "out" / row["filename"], np.float32).reshape(-1, 5)
        at = points[:, :3].astype(np.float64)
        for place in (mounts[row["calibrated_sensor_token"]], poses[row["ego_pose_token"]]):
            rotation = matrices_from_quaternions(np.array([place["rotation"]]))[0]
            at = at @ rotation.T + place["translation"]
        sweep = log.sweep_by_stem[STEMS[(row["timestamp"] * 1000 - FIRST_NS) // 500_000_000]].load()
        np.testing.assert_allclose(at, sweep.points_world, atol=1e-4)
        np.testing.assert_allclose(points[:, 3], [0, 51, 127.5, 255], atol=1e-4)
        assert points[:, 4].tolist() == [0, 1, 2, 3]
        # x to the right, y ahead: the box is ahead of the vehicle.
        assert (points[:3, 1] > 10).all()


def test_kinds_without_a_category_are_counted(tmp_path: Path) -> None:
    log = tiny_log(tmp_path / "made", box_track(ActorKind.RAIL_VEHICLE))
    tables, written = exported(log, tmp_path / "out")
    assert written.left_out == {"rail vehicle": 3}
    assert tables["sample_annotation"] == tables["instance"] == []


def at_ten_hertz(log: ScenarioLog, count: int) -> ScenarioLog:
    stems = [f"{n:02d}" for n in range(count)]
    first, lazy = log.log.frames[0], log.log.sweeps[0]
    frames = tuple(
        replace(first, stem=stem, time_ns=FIRST_NS + n * STEP_NS, camera_name="front")
        for n, stem in enumerate(stems)
    )
    sweeps = tuple(
        LazySweep(stem, FIRST_NS + n * STEP_NS + 3_000_000 * (n % 2), lazy.load)
        for n, stem in enumerate(stems)
    )
    cameras = {"front": log.log.cameras["front"]}
    return replace(log, log=replace(log.log, frames=frames, sweeps=sweeps, cameras=cameras))


@pytest.mark.parametrize(("count", "keys"), [(1, ["00"]), (5, ["00"]), (12, ["00", "05", "10"])])
def test_samples_are_half_a_second_apart(tmp_path: Path, count: int, keys: list[str]) -> None:
    log = at_ten_hertz(tiny_log(tmp_path), count)
    samples = Samples.of(log, "scene", Tables("key"))
    assert list(samples.key_stems) == keys
    # Boxes of pictures between samples are interpolated up to the next one.
    next_key = keys[1] if len(keys) > 1 else keys[-1]
    assert samples.token_of("03", FIRST_NS + 3 * STEP_NS) == samples.token_of(next_key, 0)
    assert samples.token_of("11", FIRST_NS + 11 * STEP_NS) == samples.token_of(keys[-1], 0)


def test_a_frame_without_a_picture_of_some_camera_is_no_sample(tmp_path: Path) -> None:
    log = tiny_log(tmp_path)
    log = replace(log, log=log.log.with_frames(log.log.frames[1:]))
    assert list(Samples.of(log, "scene", Tables("key")).key_stems) == list(STEMS[1:])


def test_an_interrupted_export_keeps_its_pictures(tmp_path: Path) -> None:
    log = tiny_log(tmp_path / "made")
    exported(log, tmp_path / "out")
    pictures = sorted((tmp_path / "out").rglob("*.jpg"))
    assert len(pictures) == 6
    made = {p: p.stat().st_mtime_ns for p in pictures}
    unread = tuple(replace(f, load_srgb8=partial(read_srgb8, Path("no"))) for f in log.log.frames)
    again = replace(log, log=log.log.with_frames(unread))
    write_nuscenes(again, tmp_path / "out", SilentProgress())
    assert made == {p: p.stat().st_mtime_ns for p in pictures}


def test_the_devkit_draws_boxes_on_the_cars(tmp_path: Path) -> None:
    """Its projected corners are ours, and their outline is that of the pixels of the box."""
    log = tiny_log(tmp_path / "made")
    channels = channel_by_camera(log)
    exported(log, tmp_path / "out")
    found = probed("devkit_probe.py", tmp_path / "out.json", str(tmp_path / "out"), VERSION)
    assert found["scenes"] == found["names"] == ["scene-tiny-01234567"]
    (track,) = log.log.actors
    frames = {f"{channels[f.camera_name]}__{f.time_ns // 1000}": f for f in log.log.frames}
    worst_px, outline_px = [], []
    assert len(found["boxes"]) == 3
    for box in found["boxes"]:
        scene, channel, time = Path(box["file"]).stem.split("__")
        frame = frames[f"{channel}__{time}"]
        assert scene == found["names"][0]
        assert (box["category"], box["level"], box["lidar"]) == ("vehicle.car", "v80-100", 3)
        corners = np.array(box["corners_px"]) + 0.5
        # The sweep of a frame has the time of its front picture here.
        pose = track.world_from_actor(frame.time_ns)
        own, _ = frame.project(camera_of("front"), pose.apply(track.corners_actor))
        gap = np.linalg.norm(own[:, None] - corners, axis=2)
        worst_px.append(gap.min(axis=1).max())
        rectangle = [*corners.min(axis=0), *corners.max(axis=0)]
        outline_px.append(np.abs(np.array(rectangle) - edges(box_mask(frame, track))).max())
        np.testing.assert_allclose(np.linalg.norm(box["velocity"][:2]), 10.0, atol=1e-6)
    assert max(worst_px) < 1e-3
    assert max(outline_px) < 1.0
    assert np.array(list(found["points"].values())).shape == (3, 4, 4)
    assert ego_path().covers(FIRST_NS)
