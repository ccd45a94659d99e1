"""Exports in KITTI's layout, read back with the formulas of its development kit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.export.tiny_export import (
    LENS,
    STEMS,
    Labels,
    box_mask,
    box_track,
    edges,
    tiny_log,
)

from lightsim.core.actors import ActorKind
from lightsim.core.frame_labels import FrameLabels
from lightsim.core.frames import RigidTransform
from lightsim.errors import InputError
from lightsim.export.kitti.labels import occlusion
from lightsim.export.kitti.log import write_kitti
from lightsim.export.projection import truncation
from lightsim.export.scenario_log import ScenarioLog
from lightsim.progress import SilentProgress
from lightsim.store.images import read_srgb8

NOTHING = FrameLabels((), np.full((LENS.height_px, LENS.width_px), -1, np.int32))


def exported(log: ScenarioLog, folder: Path) -> Path:
    folder.mkdir()
    write_kitti(log, folder, SilentProgress())
    return folder / "training"


def calibration(path: Path) -> dict[str, np.ndarray]:
    lines = (line.split(": ") for line in path.read_text().splitlines())
    return {name: np.array(words.split(), np.float64) for name, words in lines}


def objects(path: Path) -> list[dict[str, Any]]:
    found = []
    for line in path.read_text().splitlines():
        name, *words = line.split()
        v = [float(word) for word in words]
        assert len(v) == 14
        found.append({
            "name": name, "truncated": v[0], "occluded": int(v[1]), "alpha": v[2],
            "box": v[3:7], "hwl": v[7:10], "place": np.array(v[10:13]), "rotation_y": v[13],
        })  # fmt: skip
    return found


def kitti_corners(thing: dict[str, Any]) -> np.ndarray:
    """computeBox3D.m of the development kit: corners in the camera's frame."""
    height, width, length = thing["hwl"]
    c, s = np.cos(thing["rotation_y"]), np.sin(thing["rotation_y"])
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    x = np.array([1, 1, -1, -1, 1, 1, -1, -1]) * length / 2
    y = np.array([0, 0, 0, 0, -1, -1, -1, -1]) * height
    z = np.array([1, -1, -1, 1, 1, -1, -1, 1]) * width / 2
    return (turn @ np.stack([x, y, z])).T + thing["place"]


def test_boxes_come_back_within_a_millimetre(tmp_path: Path) -> None:
    """The camera is level here, so that KITTI's one angle describes the box."""
    log = tiny_log(tmp_path / "made")
    training = exported(log, tmp_path / "out")
    (track,) = log.log.actors
    for number, frame in enumerate(log.log.frames_of("front")):
        (thing,) = objects(training / "label_2" / f"{number:06d}.txt")
        assert (thing["name"], thing["occluded"], thing["truncated"]) == ("Car", 0, 0.0)
        assert thing["hwl"] == [1.5, 2.0, 4.0]
        world = frame.world_from_camera.apply(kitti_corners(thing))
        pose = track.world_from_actor(frame.time_ns)
        # The first corner is to the right of the front: of (length, -width) / 2, at the bottom.
        local = pose.inverse().apply(world)
        np.testing.assert_allclose(np.abs(local), np.tile([2.0, 1.0, 0.75], (8, 1)), atol=1e-3)
        assert np.sign(local[0]).tolist() in ([1, 1, -1], [1, -1, -1])
        ahead = frame.world_from_camera.inverse().rotate(pose.rotation[:, :1].T)[0]
        np.testing.assert_allclose(
            [np.cos(thing["rotation_y"]), -np.sin(thing["rotation_y"])], ahead[[0, 2]], atol=1e-5
        )
        # alpha is the heading that a viewer along the ray to the box sees.
        centre = frame.world_from_camera.inverse().apply(pose.translation_m[None])[0]
        ray = np.arctan2(centre[0], centre[2])
        turn = np.array([[np.cos(ray), -np.sin(ray)], [np.sin(ray), np.cos(ray)]])
        seen = turn @ ahead[[0, 2]]
        assert thing["alpha"] == pytest.approx(np.arctan2(-seen[1], seen[0]), abs=1e-5)
        left, top, right, bottom = edges(box_mask(frame, track))
        assert thing["box"] == [left, top, right - 1, bottom - 1]
        assert (read_srgb8(training / "image_2" / f"{number:06d}.png") == frame.load_srgb8()).all()


def test_points_lie_where_the_calibration_projects_them(tmp_path: Path) -> None:
    log = tiny_log(tmp_path / "made")
    training = exported(log, tmp_path / "out")
    for number, frame in enumerate(log.log.frames_of("front")):
        rows = np.fromfile(training / "velodyne" / f"{number:06d}.bin", np.float32).reshape(-1, 4)
        np.testing.assert_allclose(rows[:, 3], [0.0, 0.2, 0.5, 1.0], atol=1e-6)
        matrices = calibration(training / "calib" / f"{number:06d}.txt")
        assert all((matrices[f"P{k}"] == matrices["P2"]).all() for k in range(4))
        rectify = matrices["R0_rect"].reshape(3, 3)
        velo = matrices["Tr_velo_to_cam"].reshape(3, 4)
        points = np.hstack([rows[:, :3].astype(np.float64), np.ones((4, 1))])
        camera = rectify @ velo @ points.T
        image = matrices["P2"].reshape(3, 4) @ np.vstack([camera, np.ones(4)])
        sweep = log.sweep_by_stem[STEMS[number]].load()
        own, _ = frame.project(LENS, sweep.points_world.astype(np.float64))
        np.testing.assert_allclose((image[:2] / image[2]).T + 0.5, own, atol=2e-3)
        # x is ahead, z up from the LiDAR.
        assert (rows[:, 0] > 10).all()
        assert rows[0, 2] == pytest.approx(0.75 + 0.5 - 0.2 - 1.9, abs=1e-3)
    sets = {p.stem: p.read_text() for p in (tmp_path / "out" / "ImageSets").iterdir()}
    every = "000000\n000001\n000002\n"
    assert sets == {"train": every, "trainval": every, "val": "", "test": ""}


@pytest.mark.parametrize(("hidden", "name", "state"), [(0.4, "Car", 1), (0.7, "Car", 2)])
def test_occlusion_is_that_of_the_visible_pixels(
    tmp_path: Path, hidden: float, name: str, state: int
) -> None:
    log = tiny_log(tmp_path / "made", labels=Labels(box_track(), hidden))
    (thing,) = objects(exported(log, tmp_path / "out") / "label_2" / "000001.txt")
    assert (thing["name"], thing["occluded"]) == (name, state)


def test_hidden_actors_are_not_cared_about(tmp_path: Path) -> None:
    log = tiny_log(tmp_path / "made", labels=Labels(box_track(), 1.0))
    training = exported(log, tmp_path / "out")
    (thing,) = objects(training / "label_2" / "000001.txt")
    frame = log.log.frames_of("front")[1]
    left, top, right, bottom = edges(box_mask(frame, box_track()))
    assert thing["name"] == "DontCare"
    assert thing["box"] == [left, top, right - 1, bottom - 1]


def test_without_a_mesh_occlusion_is_unknown(tmp_path: Path) -> None:
    """The rectangle is then that of the box, and of furniture there is nothing."""
    log = tiny_log(tmp_path / "made", labels=lambda frame: NOTHING)
    (thing,) = objects(exported(log, tmp_path / "out") / "label_2" / "000001.txt")
    assert thing["occluded"] == 3
    left, top, right, bottom = edges(box_mask(log.log.frames_of("front")[1], box_track()))
    np.testing.assert_allclose(thing["box"], [left, top, right - 1, bottom - 1], atol=1.0)
    cone = tiny_log(tmp_path / "made", box_track(ActorKind.CONE))
    folder = tmp_path / "cone"
    folder.mkdir()
    assert write_kitti(cone, folder, SilentProgress()).left_out == {"cone": 3}
    assert (folder / "training/label_2/000000.txt").read_text() == ""


def test_another_camera_is_chosen_by_name(tmp_path: Path) -> None:
    log = tiny_log(tmp_path / "made")
    (tmp_path / "out").mkdir()
    write_kitti(log, tmp_path / "out", SilentProgress(), "side")
    assert all(not p.read_text() for p in (tmp_path / "out/training/label_2").iterdir())
    with pytest.raises(InputError, match="front, side"):
        write_kitti(log, tmp_path / "out", SilentProgress(), "rear")


def test_a_tilted_camera_keeps_the_centre(tmp_path: Path) -> None:
    log = tiny_log(tmp_path / "made")
    tilt = RigidTransform.from_rotation(
        "camera", "tilted",
        np.array([[1, 0, 0], [0, np.cos(0.1), -np.sin(0.1)], [0, np.sin(0.1), np.cos(0.1)]]),
        np.zeros(3),
    )  # fmt: skip
    frames = tuple(
        replace(f, world_from_camera=RigidTransform(
            "world", "camera", (f.world_from_camera @ tilt).matrix))
        for f in log.log.frames
    )  # fmt: skip
    log = replace(log, log=log.log.with_frames(frames))
    (thing,) = objects(exported(log, tmp_path / "out") / "label_2" / "000001.txt")
    frame = log.log.frames_of("front")[1]
    centre = frame.world_from_camera.apply(kitti_corners(thing).mean(axis=0)[None])[0]
    wanted = box_track().world_from_actor(frame.time_ns).translation_m
    np.testing.assert_allclose(centre, wanted, atol=1e-3)


def test_truncation_is_the_part_outside() -> None:
    assert truncation((-96.0, 0.0, 96.0, 64.0), LENS) == pytest.approx(0.5)
    assert truncation((10.0, 10.0, 20.0, 20.0), LENS) == 0.0
    assert truncation((100.0, 0.0, 120.0, 20.0), LENS) == 1.0
    assert [occlusion(v) for v in (1.0, 0.8, 0.79, 0.4, 0.39)] == [0, 0, 1, 1, 2]
