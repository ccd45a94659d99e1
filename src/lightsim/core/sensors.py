"""What sensors recorded: camera frames and LiDAR sweeps. Bytes are loaded when asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int16, UInt8

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """One image of one camera. `stem` is the log's own file stem and names every output."""

    camera_name: str
    stem: str
    time_ns: int
    world_from_camera: RigidTransform
    load_srgb8: Callable[[], UInt8[np.ndarray, "h w 3"]]

    def pixel_rays(
        self, camera: PinholeCamera, uv: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Origins and unit directions of the rays through (u, v), frame `world`."""
        directions = self.world_from_camera.rotate(camera.directions(uv))
        origins = np.broadcast_to(self.world_from_camera.translation_m, directions.shape)
        return origins.copy(), directions

    def project(
        self, camera: PinholeCamera, points_world: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
        """(u, v) at which points appear, and whether that lies inside the image; NaN behind it."""
        points = self.world_from_camera.inverse().apply(points_world.astype(np.float64))
        return camera.project(points)


@dataclass(frozen=True, eq=False)
class LidarSweep:
    """The returns of one revolution, in frame `world` (each at its own time of flight).

    Args:
        points_world: returns, metres.
        origins_world: where the sensor stood when each was measured, metres.
        intensity: reflectance as the sensor gives it, scaled to [0, 1].
        time_offset_s: seconds from the sweep's `time_ns`.
        ring: laser index, -1 where unknown.
        semantic_class: the log's own class ids, -1 where unlabelled.
    """

    stem: str
    time_ns: int
    points_world: Float32[np.ndarray, "n 3"]
    origins_world: Float32[np.ndarray, "n 3"]
    intensity: Float32[np.ndarray, " n"]
    time_offset_s: Float32[np.ndarray, " n"]
    ring: Int16[np.ndarray, " n"]
    semantic_class: Int16[np.ndarray, " n"]

    @property
    def distances_m(self) -> Float[np.ndarray, " n"]:
        return np.linalg.norm(self.points_world - self.origins_world, axis=1)


@dataclass(frozen=True, eq=False)
class LazySweep:
    """A sweep that is read from disk when `load` is called."""

    stem: str
    time_ns: int
    load: Callable[[], LidarSweep]
