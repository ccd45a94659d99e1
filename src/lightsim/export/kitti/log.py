"""Exports in the layout of KITTI's object benchmark, of one camera."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path

import numpy as np

from lightsim.core.sensors import CameraFrame
from lightsim.export.kitti.labels import CLASS_BY_KIND, KittiView
from lightsim.export.provenance import Written
from lightsim.export.scenario_log import ScenarioLog
from lightsim.progress import Progress
from lightsim.store.artefact import write_text
from lightsim.store.atomic import whole_file


def write_kitti(log: ScenarioLog, folder: Path, progress: Progress, camera: str = "") -> Written:
    """Write training/{image_2,label_2,calib,velodyne} and ImageSets/.

    Args:
        folder: empty, or with the files of an interrupted export of the same log.
        camera: name; by default the camera that looks ahead.
    """
    name = log.camera(camera)
    training = folder / "training"
    for part in ("image_2", "label_2", "calib", "velodyne"):
        (training / part).mkdir(parents=True, exist_ok=True)
    pictures: list[tuple[str, CameraFrame]] = []
    left_out: Counter[str] = Counter()
    frames = log.log.frames_of(name)
    for number, frame in enumerate(progress.track(frames, "write KITTI", len(frames))):
        stem = f"{number:06d}"
        picture = training / "image_2" / f"{stem}.png"
        # A complete file of an interrupted export is not written again.
        if not picture.is_file():
            with whole_file(picture) as temporary:
                shutil.copyfile(log.picture_path(frame), temporary)
        pictures.append((picture.relative_to(folder).as_posix(), frame))
        view = KittiView(frame, log.log.cameras[name])
        left_out += _write_labels(log, view, training / "label_2" / f"{stem}.txt")
        # The LiDAR moves with the vehicle: its pose is that at the time of the picture.
        camera_from_lidar = log.ego_from_camera(name).inverse() @ log.ego_from_lidar
        write_text(training / "calib" / f"{stem}.txt", view.calibration(camera_from_lidar))
        world_from_lidar = frame.world_from_camera @ camera_from_lidar
        _write_sweep(log, frame, world_from_lidar.inverse().matrix, training / "velodyne", stem)
    _write_sets(folder / "ImageSets", len(frames))
    return Written(pictures, left_out, _usage(log, name))


def _write_labels(log: ScenarioLog, view: KittiView, path: Path) -> Counter[str]:
    """Write the labels of a picture; return the number of boxes without a class, by kind."""
    labels = log.labels(view.frame).by_actor
    left_out: Counter[str] = Counter()
    lines: list[str] = []
    for track in log.log.actors_at(view.frame.time_ns):
        if track.kind not in CLASS_BY_KIND:
            left_out[str(track.kind)] += 1
            continue
        line = view.line(track, labels.get(track.actor_id))
        if line is not None:
            lines.append(line + "\n")
    # KITTI lists hidden actors last.
    write_text(path, "".join(sorted(lines, key=lambda line: line.startswith("DontCare"))))
    return left_out


def _write_sweep(
    log: ScenarioLog, frame: CameraFrame, lidar_from_world: np.ndarray, folder: Path, stem: str
) -> None:
    """Write x, y, z in metres and reflectance in [0, 1] of the sweep of a frame, if it has one."""
    lazy, path = log.sweep_by_stem.get(frame.stem), folder / f"{stem}.bin"
    if lazy is None or path.is_file():
        return
    sweep = lazy.load()
    points = sweep.points_world.astype(np.float64) @ lidar_from_world[:3, :3].T
    rows = np.concatenate([points + lidar_from_world[:3, 3], sweep.intensity[:, None]], axis=1)
    with whole_file(path) as temporary:
        rows.astype(np.float32).tofile(temporary)


def _write_sets(folder: Path, count: int) -> None:
    """Write the lists of files: all frames are for training, since frames of one drive are too
    similar to be divided."""
    folder.mkdir(exist_ok=True)
    every = "".join(f"{number:06d}\n" for number in range(count))
    for name, text in {"train": every, "trainval": every, "val": "", "test": ""}.items():
        write_text(folder / f"{name}.txt", text)


def _usage(log: ScenarioLog, camera: str) -> tuple[str, ...]:
    missing = [f for f in log.log.frames_of(camera) if f.stem not in log.sweep_by_stem]
    return (
        f"Camera: {camera}. P0 to P3 are its intrinsics; there is no stereo pair.",
        "occluded: 0 from 80 % visible, 1 from 40 %, else 2; 3 for actors without a mesh. Hidden"
        " actors are DontCare. truncated: fraction of the projected box outside the picture.",
        "rotation_y is the heading about the camera's y axis; the tilt of camera and road is lost.",
        f"Frames without a sweep in velodyne/: {len(missing)}.",
        "ImageSets: all frames are in train; val and test are empty.",
    )
