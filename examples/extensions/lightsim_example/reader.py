"""Read a data set: one camera, described by a file dashcam.json beside the images."""

from pathlib import Path

import numpy as np

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import DrivingLog, FindEgoVehicle
from lightsim.core.reading import LogReading
from lightsim.core.sensors import CameraFrame
from lightsim.datasets.files import read_json
from lightsim.datasets.reader import LogReader
from lightsim.store.images import read_srgb8

# Axes: camera x right, y down, z forward; ego x forward, y left, z up.
EGO_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])


def read(reading: LogReading, find_ego_vehicle: FindEgoVehicle) -> DrivingLog:
    """Return the recording; images are loaded when they are needed."""
    source, described = Path(reading.source), read_json(Path(reading.source) / "dashcam.json")
    camera = PinholeCamera("front", **described["camera"])
    poses = [RigidTransform("world", "camera", np.array(f["pose"])) for f in described["frames"]]
    frames = tuple(
        CameraFrame("front", Path(f["file"]).stem, f["time_ns"], pose, lambda p=path: read_srgb8(p))
        for f, pose in zip(described["frames"], poses, strict=True)
        for path in (source / f["file"],)
    )
    path = np.stack([pose.matrix @ np.linalg.inv(EGO_FROM_CAMERA) for pose in poses])
    ego = Trajectory("world", "ego", np.array([f.time_ns for f in frames]), path)
    masks, notes = find_ego_vehicle([(camera, frames)], ego)
    return DrivingLog(source.name, {"front": camera}, frames, (), ego, (), None, masks, notes)


READER = LogReader(detect=lambda folder: (folder / "dashcam.json").is_file(), read=read)
