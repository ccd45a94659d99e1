"""Pictures and sweeps in nuScenes' layout, with their poses and calibrations."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame, LazySweep, LidarSweep
from lightsim.export.nuscenes.names import LIDAR, channel_by_camera
from lightsim.export.nuscenes.samples import Samples
from lightsim.export.nuscenes.tables import Tables, link, microseconds, pose_entries
from lightsim.export.projection import intrinsic_matrix
from lightsim.export.scenario_log import ScenarioLog
from lightsim.progress import Progress
from lightsim.store.atomic import whole_file
from lightsim.store.images import write_jpeg

# Quality of pictures, with full chroma. Chosen; sensitivity not measured.
_JPEG_QUALITY = 95
# nuScenes' LiDAR frame has x to the right and y ahead.
_LEVEL_FROM_LIDAR = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


class SensorWriter:
    """Writer of samples/ and sweeps/ with their rows in the tables.

    Args:
        folder: the export.
    """

    def __init__(self, log: ScenarioLog, folder: Path, tables: Tables, samples: Samples) -> None:
        self._log, self._folder = log, folder
        self._tables, self._samples = tables, samples
        self._channels = channel_by_camera(log)

    def write_pictures(self, progress: Progress) -> list[tuple[str, CameraFrame]]:
        """Write all pictures as JPEG; return the file of each."""
        found: list[tuple[str, CameraFrame]] = []
        for name, channel in self._channels.items():
            camera = self._log.log.cameras[name]
            ego_from_camera = self._log.ego_from_camera(name)
            sensor = self._add_sensor(
                channel, "camera", ego_from_camera, intrinsic_matrix(camera).tolist()
            )
            rows: list[dict[str, Any]] = []
            frames = self._log.log.frames_of(name)
            for frame in progress.track(frames, f"write {channel}", len(frames)):
                # The ego pose is that of the camera's own pose: boxes project as in the picture.
                pose = frame.world_from_camera @ ego_from_camera.inverse()
                facts = {"height": camera.height_px, "width": camera.width_px, "fileformat": "jpg"}
                row = self._data(channel, frame, sensor, pose, facts)
                rows.append(row)
                found.append((row["filename"], frame))
                path = self._folder / row["filename"]
                # A complete file of an interrupted export is not written again.
                if not path.is_file():
                    path.parent.mkdir(parents=True, exist_ok=True)
                    write_jpeg(path, frame.load_srgb8(), quality=_JPEG_QUALITY)
            link(rows)
        return found

    def write_sweeps(self, progress: Progress) -> None:
        """Write all sweeps as .pcd.bin: x, y, z in metres, intensity from 0 to 255, and ring."""
        sweeps = self._log.log.sweeps
        if not sweeps:
            return
        ego_from_lidar = self._log.ego_from_lidar
        ego_from_lidar = RigidTransform.from_rotation(
            "ego", "lidar", _LEVEL_FROM_LIDAR, ego_from_lidar.translation_m
        )
        sensor = self._add_sensor(LIDAR, "lidar", ego_from_lidar, [])
        rows: list[dict[str, Any]] = []
        for lazy in progress.track(sweeps, f"write {LIDAR}", len(sweeps)):
            pose = self._log.log.ego.held(lazy.time_ns)
            facts = {"height": 0, "width": 0, "fileformat": "pcd"}
            row = self._data(LIDAR, lazy, sensor, pose, facts)
            rows.append(row)
            path = self._folder / row["filename"]
            if not path.is_file():
                path.parent.mkdir(parents=True, exist_ok=True)
                points = point_rows(lazy.load(), (pose @ ego_from_lidar).inverse())
                with whole_file(path) as temporary:
                    points.tofile(temporary)
        link(rows)

    def _add_sensor(
        self, channel: str, modality: str, pose: RigidTransform, intrinsic: list[list[float]]
    ) -> str:
        """Add a sensor with its calibration; return the calibration's token."""
        tables = self._tables
        sensor, token = tables.token("sensor", channel), tables.token("calibrated", channel)
        tables.add("sensor", sensor, {"channel": channel, "modality": modality})
        row = {"sensor_token": sensor, **pose_entries(pose), "camera_intrinsic": intrinsic}
        tables.add("calibrated_sensor", token, row)
        return token

    def _data(
        self,
        channel: str,
        item: CameraFrame | LazySweep,
        sensor: str,
        world_from_ego: RigidTransform,
        facts: Mapping[str, Any],
    ) -> dict[str, Any]:
        """Add the rows of one picture or sweep; return its row of `sample_data`."""
        tables = self._tables
        time_us = microseconds(item.time_ns)
        token = tables.token("data", channel, item.stem)
        is_key = self._samples.is_key(item.stem)
        part = "samples" if is_key else "sweeps"
        suffix = "jpg" if facts["fileformat"] == "jpg" else "pcd.bin"
        tables.add("ego_pose", token, {"timestamp": time_us, **pose_entries(world_from_ego)})
        row = {
            "sample_token": self._samples.token_of(item.stem, item.time_ns),
            "ego_pose_token": token,
            "calibrated_sensor_token": sensor,
            "timestamp": time_us,
            "is_key_frame": is_key,
            "filename": f"{part}/{channel}/{self._samples.scene}__{channel}__{time_us}.{suffix}",
            **facts,
        }
        tables.add("sample_data", token, row)
        return tables.rows["sample_data"][-1]


def point_rows(sweep: LidarSweep, lidar_from_world: RigidTransform) -> Float32[np.ndarray, "n 5"]:
    """Return x, y, z, intensity from 0 to 255 and ring of each return.

    Static points are free of the ego vehicle's motion during the sweep, as in nuScenes.
    """
    points = lidar_from_world.apply(sweep.points_world.astype(np.float64))
    columns = [points, 255.0 * sweep.intensity[:, None], sweep.ring[:, None]]
    return np.concatenate(columns, axis=1).astype(np.float32)
