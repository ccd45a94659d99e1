"""Views of a log for a monocular detector: projection and boxes in the level frame of a camera.

The level frame has its origin at the camera, x horizontal along the optical axis, y left, z up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int32

from lightsim.core.actors import ActorTrack
from lightsim.core.buffers import BACKGROUND
from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import RayCaster
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.datasets.reader import read_log
from lightsim.progress import Progress
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.scene import placed_meshes
from lightsim.simulation.labels import actor_labels
from lightsim.store.artefact import read_json, write_json
from lightsim_lab.synthetic.reader import read_true_meshes, true_scenario

# Least visible pixels, at the recorded size, of a vehicle that has to be detected; others are
# ignored. Sensitivity not measured.
_LEAST_PX = 20
# Its least visible fraction, likewise.
_LEAST_VISIBILITY = 0.2
# Least LiDAR returns, inside the picture, of a vehicle in a log without ground truth: nothing else
# measures what hides it. Sensitivity not measured.
_LEAST_RETURNS = 5


@dataclass(frozen=True, eq=False)
class View:
    """A recorded picture.

    Args:
        name: "<camera>/<frame stem>".
        size_px: width and height.
        projection: pixels from the level frame, homogeneous.
        boxes: vehicles that have to be detected, in the level frame (`boxes.py`).
        ignored: vehicles that are hidden, too small, or outside the region of interest.
    """

    name: str
    size_px: tuple[int, int]
    projection: Float64[np.ndarray, "3 4"]
    boxes: Float64[np.ndarray, "_ 7"]
    ignored: Float64[np.ndarray, "_ 7"]

    def within(self, reach_m: float) -> View:
        """Return the view with the vehicles centred outside the region of interest ignored.

        Args:
            reach_m: length and width of the region (`DetectorConfig.reach_m`).
        """
        x, y = self.boxes[:, :2].T
        is_inside = (x >= 0) & (x < reach_m) & (np.abs(y) < reach_m / 2)
        ignored = np.concatenate([self.ignored, self.boxes[~is_inside]])
        return replace(self, boxes=self.boxes[is_inside], ignored=ignored)


def label_street(folder: Path, path: Path, progress: Progress) -> None:
    """Label the vehicles in all views of a street with ground truth, and write them to a file."""
    log = read_log(LogReading(source=str(folder / "log"), image_scale=1.0))
    meshes = read_true_meshes(folder / "truth" / "scene.npz")
    scenario = true_scenario(meshes, log.actors)
    static = make_embree_caster([meshes["background"]])
    frames = progress.track(log.frames, f"labels of {folder.name}", len(log.frames))
    views = [_view(scenario, static, frame, log.cameras[frame.camera_name]) for frame in frames]
    _write_views(path, views)


def label_log(source: Path, camera: str, every: int, path: Path, progress: Progress) -> None:
    """Label the vehicles in each n-th view of a camera by the boxes of the recording.

    A vehicle whose returns the picture does not show is hidden or outside: it is ignored.
    """
    reading = LogReading(
        source=str(source), cameras=(camera,), frames=f"::{every}", image_scale=1.0
    )
    log = read_log(reading)
    frames = progress.track(log.frames, f"labels of {source.name}", len(log.frames))
    views = [_recorded_view(log, frame) for frame in frames]
    _write_views(path, views)


def _write_views(path: Path, views: Sequence[View]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, views)


def read_views(path: Path) -> list[View]:
    """Read a file of `label_street`."""

    def boxes(rows: list[list[float]]) -> Float64[np.ndarray, "_ 7"]:
        return np.array(rows, dtype=np.float64).reshape(-1, 7)

    return [
        View(row["name"], tuple(row["size_px"]), np.array(row["projection"]),
             boxes(row["boxes"]), boxes(row["ignored"]))
        for row in read_json(path)
    ]  # fmt: skip


def _recorded_view(log: DrivingLog, frame: CameraFrame) -> View:
    camera = log.cameras[frame.camera_name]
    sweep = min(log.sweeps, key=lambda one: abs(one.time_ns - frame.time_ns)).load()
    _, is_inside = frame.project(camera, sweep.points_world)
    points = sweep.points_world[is_inside]
    sides: tuple[list[ActorTrack], list[ActorTrack]] = ([], [])
    for track in log.actors_at(frame.time_ns):
        if track.kind.is_vehicle:
            returns = int(track.contains(points, sweep.time_ns).sum())
            sides[returns < _LEAST_RETURNS].append(track)
    return _made_view(frame, camera, *sides)


def _view(scenario: Scenario, static: RayCaster, frame: CameraFrame, camera: PinholeCamera) -> View:
    sides: tuple[list[ActorTrack], list[ActorTrack]] = ([], [])
    vehicles = tuple(p for p in scenario.placements if p.track.kind.is_vehicle)
    index = _actor_index(scenario, static, frame, camera)
    for label in actor_labels(replace(scenario, placements=vehicles), frame, camera, index):
        is_ignored = label.visible_px < _LEAST_PX or label.visibility < _LEAST_VISIBILITY
        sides[is_ignored].append(scenario.tracks[label.number])
    return _made_view(frame, camera, *sides)


def _made_view(
    frame: CameraFrame,
    camera: PinholeCamera,
    counted: Sequence[ActorTrack],
    ignored: Sequence[ActorTrack],
) -> View:
    """Return the view of a frame with the boxes of tracks at its time."""
    pose = frame.world_from_camera
    ahead = pose.rotation[:, 2]
    yaw = float(np.arctan2(ahead[1], ahead[0]))
    level = RigidTransform.from_yaw("world", "level", yaw, pose.translation_m).inverse()

    def boxes(tracks: Sequence[ActorTrack]) -> Float64[np.ndarray, "_ 7"]:
        places = [level @ track.world_from_actor(frame.time_ns) for track in tracks]
        rows = [
            [*place.translation_m, *track.size_lwh_m, place.yaw_rad]
            for place, track in zip(places, tracks, strict=True)
        ]
        return np.array(rows, dtype=np.float64).reshape(-1, 7)

    intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    return View(
        f"{frame.camera_name}/{frame.stem}",
        (camera.width_px, camera.height_px),
        intrinsics @ (level @ pose).inverse().matrix[:3],
        boxes(counted),
        boxes(ignored),
    )


def _actor_index(
    scenario: Scenario, static: RayCaster, frame: CameraFrame, camera: PinholeCamera
) -> Int32[np.ndarray, "h w"]:
    """Return the number of the actor that each pixel shows."""
    rays = frame.pixel_rays(camera, camera.pixel_centres().reshape(-1, 2))
    placements = scenario.placements_at(frame.time_ns)
    hits = make_embree_caster(placed_meshes(placements, frame.time_ns)).intersect(*rays)
    is_actor = hits.is_hit & (hits.distance_m < static.intersect(*rays).distance_m)
    numbers = [scenario.number_by_actor[p.track.actor_id] for p in placements]
    index = np.full(len(is_actor), BACKGROUND, dtype=np.int32)
    index[is_actor] = np.array(numbers, dtype=np.int32)[hits.mesh_index[is_actor]]
    return index.reshape(camera.height_px, camera.width_px)
