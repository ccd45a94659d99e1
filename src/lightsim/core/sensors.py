"""Camera frames and LiDAR sweeps. Pixels and points are loaded on demand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int16, Int64, UInt8

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform, turned_by

# Time for which the first and last pose of an actor remain valid beyond its labels, in seconds:
# labels are made once a sweep. Of the returns of log 002 in the boxes of moving actors, those of
# classes that move are at most 0.075 s beyond the labels; from 0.15 s on, other classes prevail
# (benchmarks/actor_returns.py).
SWEEP_HOLD_S = 0.15
# Fixed-point iterations of `CameraFrame.project`: the error shrinks to a few percent in each.
_PROJECTION_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class RollingShutter:
    """Motion of a camera while its rows or columns are read one after another.

    The time of a pixel is an affine function of u and v, and 0 in the image's centre, whose time
    and pose are those of the frame. Rows from the bottom up, and columns from right to left, have
    a negative time.

    Args:
        readout_s: seconds from the top edge of the image to the bottom edge.
        velocity_m_s: of the camera, frame `world`.
        angular_velocity_rad_s: of the camera, frame `world`, right-handed.
        readout_across_s: seconds from the left edge of the image to the right edge.
    """

    readout_s: float
    velocity_m_s: Float[np.ndarray, "3"]
    angular_velocity_rad_s: Float[np.ndarray, "3"]
    readout_across_s: float = 0.0

    def seconds(
        self, uv: Float[np.ndarray, "n 2"], camera: PinholeCamera
    ) -> Float[np.ndarray, " n"]:
        """Return the readout time of pixels relative to the frame's time; u and v are clamped to
        the image."""
        down = np.clip(uv[:, 1] / camera.height_px, 0.0, 1.0) - 0.5
        if self.readout_across_s == 0.0:
            return down * self.readout_s
        across = np.clip(uv[:, 0] / camera.width_px, 0.0, 1.0) - 0.5
        return down * self.readout_s + across * self.readout_across_s

    def rotated(
        self, vectors_world: Float[np.ndarray, "n 3"], seconds: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n 3"]:
        """Rotate vectors that are fixed to the camera from the frame's time to `seconds` later."""
        return turned_by(vectors_world, seconds[:, None] * self.angular_velocity_rad_s)


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """One image of one camera. `stem` is the file stem in the log and names all outputs.

    Args:
        world_from_camera: pose at `time_ns`.
        shutter: motion during the readout; None where all rows are read at once. Whatever maps
            pixels to rays or points to pixels goes through `pixel_rays` and `project`.
    """

    camera_name: str
    stem: str
    time_ns: int
    world_from_camera: RigidTransform
    load_srgb8: Callable[[], UInt8[np.ndarray, "h w 3"]]
    shutter: RollingShutter | None = None

    def pixel_rays(
        self, camera: PinholeCamera, uv: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Return origins and unit directions of the rays through (u, v), frame `world`."""
        directions = self.world_from_camera.rotate(camera.directions(uv))
        origins = np.broadcast_to(self.world_from_camera.translation_m, directions.shape).copy()
        if self.shutter is None:
            return origins, directions
        seconds = self.shutter.seconds(uv, camera)
        origins += seconds[:, None] * self.shutter.velocity_m_s
        return origins, self.shutter.rotated(directions, seconds)

    def project(
        self, camera: PinholeCamera, points_world: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
        """Return (u, v) of points, NaN behind the camera, and whether they lie inside the image.

        With a rolling shutter, row and pose depend on each other. Fixed-point iteration solves for
        both; each round reduces the error to a few percent.
        """
        points = points_world.astype(np.float64)
        uv, inside = camera.project(self.world_from_camera.inverse().apply(points))
        if self.shutter is None:
            return uv, inside
        # The inverse of `pixel_rays`: the camera's motion since the frame's time is undone, then
        # the world is rotated into frame `camera` (rows times the matrix apply its transpose).
        relative = points - self.world_from_camera.translation_m
        rotation = self.world_from_camera.rotation
        for _ in range(_PROJECTION_ROUNDS):
            seconds = self.shutter.seconds(np.where(np.isnan(uv), 0.0, uv), camera)
            moved = relative - seconds[:, None] * self.shutter.velocity_m_s
            uv, inside = camera.project(self.shutter.rotated(moved, -seconds) @ rotation)
        return uv, inside


@dataclass(frozen=True, eq=False)
class LidarSweep:
    """The returns of one revolution, in frame `world`, each at the time when it was measured.

    Args:
        points_world: returns, metres.
        origins_world: position of the sensor at the time of each return, metres.
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
    def times_ns(self) -> Int64[np.ndarray, " n"]:
        """Time of each return. In sweeps without times of their own it is that of the sweep."""
        offsets_ns = np.rint(self.time_offset_s.astype(np.float64) * 1e9).astype(np.int64)
        return self.time_ns + offsets_ns

    def rows(self, chosen: Bool[np.ndarray, " n"]) -> LidarSweep:
        """Return the sweep with the chosen returns alone."""
        values = {
            field.name: getattr(self, field.name)[chosen]
            for field in fields(self)
            if field.name not in ("stem", "time_ns")
        }
        return replace(self, **values)

    @property
    def distances_m(self) -> Float[np.ndarray, " n"]:
        """Length of each beam, in metres."""
        return np.linalg.norm(self.points_world - self.origins_world, axis=1)


@dataclass(frozen=True, eq=False)
class LazySweep:
    """A sweep that is read from disk when `load` is called."""

    stem: str
    time_ns: int
    load: Callable[[], LidarSweep]
