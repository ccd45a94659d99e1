"""Views of a log for a monocular detector: projections and boxes in the level frame of each camera.

The level frame has its origin at the camera, x horizontal along the optical axis, y left, z up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64

from lightsim.core.actors import ActorTrack
from lightsim.core.buffers import BACKGROUND
from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.core.sensors import CameraFrame
from lightsim.datasets.reader import read_log
from lightsim.export.projection import box_rectangle, inside_picture
from lightsim.progress import Progress
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.scene import placed_meshes
from lightsim.simulation.labels import actor_labels
from lightsim.store.arrays import load_arrays, save_arrays
from lightsim_lab.synthetic.reader import read_true_meshes, true_scenario

# Least visible pixels, at the recorded size, and least visible fraction of a vehicle that has to
# be detected; others are ignored. Sensitivity not measured.
_LEAST_PX, _LEAST_VISIBILITY = 20, 0.2
# The same for logs without truth: least number of LiDAR returns in the box. nuScenes demands one;
# a few more exclude boxes that returns of neighbours touch.
_LEAST_RETURNS = 5
Visibility = Callable[[CameraFrame, PinholeCamera], dict[str, bool]]
"""(frame, camera) -> whether each vehicle in the picture has to be detected, by its id."""


@dataclass(frozen=True, eq=False)
class Views:
    """All views of a log.

    Args:
        names: "<camera>/<frame stem>" of every view.
        projections: recorded pixels from the level frame, homogeneous.
        sizes_px: width and height of the recorded pictures.
        boxes: vehicles in the level frame, of all views in turn (`boxes.py`).
        counts: number of boxes of each view.
        is_ignored: boxes that are hidden or too small.
    """

    names: tuple[str, ...]
    projections: Float64[np.ndarray, "n 3 4"]
    sizes_px: Int64[np.ndarray, "n 2"]
    boxes: Float64[np.ndarray, "m 7"]
    counts: Int64[np.ndarray, " n"]
    is_ignored: Bool[np.ndarray, " m"]

    def labels(self, k: int) -> tuple[Float64[np.ndarray, "_ 7"], Float64[np.ndarray, "_ 7"]]:
        """Return the boxes of a view that have to be detected, and the ignored ones."""
        end = int(self.counts[: k + 1].sum())
        part = slice(end - int(self.counts[k]), end)
        boxes, is_ignored = self.boxes[part], self.is_ignored[part]
        return boxes[~is_ignored], boxes[is_ignored]

    def write(self, path: Path) -> None:
        """Write the views; the file appears whole or not at all."""
        save_arrays(path, {**vars(self), "names": np.array(self.names)})

    @staticmethod
    def read(path: Path) -> Views:
        """Read a file of `write`."""
        arrays = load_arrays(path)
        names = tuple(str(name) for name in arrays.pop("names"))
        return Views(names, **arrays)


def label_views(
    log_folder: Path, truth: Path | None, cameras: Sequence[str], progress: Progress
) -> Views:
    """Label the vehicles of a log.

    Args:
        truth: ground truth of a synthetic log, which gives exact visibility; None: LiDAR returns
            in the boxes decide.
        cameras: names of the cameras; empty for all.
    """
    log = read_log(LogReading(source=str(log_folder), cameras=tuple(cameras), image_scale=1.0))
    visibility = _by_returns(log) if truth is None else _by_truth(log, truth)
    rows = list(_views(log, visibility, progress))
    names, projections, sizes, boxes, ignored = zip(*rows, strict=True)
    return Views(
        names,
        np.stack(projections),
        np.array(sizes, dtype=np.int64),
        np.concatenate(boxes),
        np.array([len(b) for b in boxes], dtype=np.int64),
        np.concatenate(ignored),
    )


_View = tuple[
    str,
    Float64[np.ndarray, "3 4"],
    tuple[int, int],
    Float64[np.ndarray, "k 7"],
    Bool[np.ndarray, " k"],
]


def _views(log: DrivingLog, visibility: Visibility, progress: Progress) -> Iterator[_View]:
    tracks = {track.actor_id: track for track in log.actors}
    for frame in progress.track(log.frames, f"labels of {log.name}", len(log.frames)):
        camera = log.cameras[frame.camera_name]
        level_from_world = _world_from_level(frame).inverse()
        is_visible = visibility(frame, camera)
        rows = [_box(tracks[name], level_from_world, frame.time_ns) for name in is_visible]
        yield (
            f"{frame.camera_name}/{frame.stem}",
            _projection(frame, camera, level_from_world),
            (camera.width_px, camera.height_px),
            np.array(rows, dtype=np.float64).reshape(-1, 7),
            ~np.array(list(is_visible.values()), dtype=bool),
        )


def _world_from_level(frame: CameraFrame) -> RigidTransform:
    pose = frame.world_from_camera
    ahead = pose.rotation[:, 2]
    yaw = float(np.arctan2(ahead[1], ahead[0]))
    return RigidTransform.from_yaw("world", "level", yaw, pose.translation_m)


def _projection(
    frame: CameraFrame, camera: PinholeCamera, level_from_world: RigidTransform
) -> Float64[np.ndarray, "3 4"]:
    camera_from_level = (level_from_world @ frame.world_from_camera).inverse()
    k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    return k @ camera_from_level.matrix[:3]


def _box(track: ActorTrack, level_from_world: RigidTransform, time_ns: int) -> list[float]:
    pose = level_from_world @ track.world_from_actor(time_ns)
    return [*pose.translation_m.tolist(), *track.size_lwh_m.tolist(), pose.yaw_rad]


def _by_truth(log: DrivingLog, truth: Path) -> Visibility:
    """Return visibility by ray casting on the true meshes."""
    meshes = read_true_meshes(truth / "scene.npz")
    scenario = true_scenario(meshes, log.actors)
    vehicles = tuple(p for p in scenario.placements if p.track.kind.is_vehicle)
    static = make_embree_caster([meshes["background"]])

    def visibility(frame: CameraFrame, camera: PinholeCamera) -> dict[str, bool]:
        rays = frame.pixel_rays(camera, camera.pixel_centres().reshape(-1, 2))
        placements = scenario.placements_at(frame.time_ns)
        hits = make_embree_caster(placed_meshes(placements, frame.time_ns)).intersect(*rays)
        is_actor = hits.is_hit & (hits.distance_m < static.intersect(*rays).distance_m)
        numbers = [scenario.number_by_actor[p.track.actor_id] for p in placements]
        index = np.full(len(is_actor), BACKGROUND, dtype=np.int32)
        index[is_actor] = np.array(numbers, dtype=np.int32)[hits.mesh_index[is_actor]]
        labels = actor_labels(
            replace(scenario, placements=vehicles),
            frame,
            camera,
            index.reshape(camera.height_px, camera.width_px),
        )
        return {
            label.actor_id: label.visible_px >= _LEAST_PX and label.visibility >= _LEAST_VISIBILITY
            for label in labels
        }

    return visibility


def _by_returns(log: DrivingLog) -> Visibility:
    """Return visibility by the LiDAR returns in each box that projects into the picture."""
    sweeps = {sweep.stem: sweep for sweep in log.sweeps}

    def visibility(frame: CameraFrame, camera: PinholeCamera) -> dict[str, bool]:
        found, sweep = {}, sweeps[frame.stem].load()
        for track in log.actors_at(frame.time_ns):
            rectangle = box_rectangle(track, frame, camera) if track.kind.is_vehicle else None
            if rectangle is None or inside_picture(rectangle, camera) is None:
                continue
            returns, _ = track.returns_inside(sweep.points_world, sweep.times_ns)
            found[track.actor_id] = len(returns) >= _LEAST_RETURNS
        return found

    return visibility
