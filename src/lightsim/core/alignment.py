"""Corrections of sensor poses, ego path and actor boxes, as the alignment stage estimates them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int64

from lightsim.core.actors import ActorTrack
from lightsim.core.frames import RigidTransform, Trajectory, rotation_from_vector, turned_by
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import CameraFrame, LazySweep, LidarSweep


@dataclass(frozen=True, eq=False)
class PathCorrection:
    """Small rigid motion that corrects the recorded world at each time. It is linear between knots
    and constant beyond them, and applies to all data located by the ego pose of that time.

    Args:
        times_ns: of the knots, increasing.
        pivot_world: point about which it turns, metres.
        rotations_rad: rotation vectors, frame `world`.
        shifts_m: frame `world`.
    """

    times_ns: Int64[np.ndarray, " n"]
    pivot_world: Float[np.ndarray, "3"]
    rotations_rad: Float[np.ndarray, "n 3"]
    shifts_m: Float[np.ndarray, "n 3"]

    def _between(
        self, values: Float[np.ndarray, "n 3"], times_ns: Int64[np.ndarray, " m"]
    ) -> Float[np.ndarray, "m 3"]:
        # Relative times: nanoseconds since 1970 exceed the precision of a double. Rotation vectors
        # may be interpolated linearly, because corrections are far below a radian.
        knots = (self.times_ns - self.times_ns[0]) * 1e-9
        seconds = (times_ns - self.times_ns[0]) * 1e-9
        return np.stack([np.interp(seconds, knots, values[:, k]) for k in range(3)], axis=1)

    def transformed(
        self, points_world: Float[np.ndarray, "m 3"], times_ns: Int64[np.ndarray, " m"]
    ) -> Float[np.ndarray, "m 3"]:
        """Correct points, each of which was located at the given time."""
        turned = turned_by(
            points_world - self.pivot_world, self._between(self.rotations_rad, times_ns)
        )
        return turned + self.pivot_world + self._between(self.shifts_m, times_ns)

    def undone(
        self, points_world: Float[np.ndarray, "m 3"], times_ns: Int64[np.ndarray, " m"]
    ) -> Float[np.ndarray, "m 3"]:
        """Inverse of `transformed`: from the corrected world to the world as recorded."""
        shifted = points_world - self.pivot_world - self._between(self.shifts_m, times_ns)
        return turned_by(shifted, -self._between(self.rotations_rad, times_ns)) + self.pivot_world

    def at(self, time_ns: int) -> RigidTransform:
        """Return the correction at a time, from the recorded to the corrected world."""
        times = np.array([time_ns], dtype=np.int64)
        rotation = rotation_from_vector(self._between(self.rotations_rad, times)[0])
        # The rotation about the pivot, written as a rotation about the origin and a shift.
        shift = self.pivot_world - rotation @ self.pivot_world
        shift += self._between(self.shifts_m, times)[0]
        return RigidTransform.from_rotation("world", "world", rotation, shift)


@dataclass(frozen=True, eq=False)
class CameraCorrection:
    """Constant error of the mounting pose and the clock of one camera.

    Args:
        rotation_rad: rotation vector of the true camera's axes, in frame `camera`.
        shift_m: true position, in frame `camera` as recorded.
        time_offset_s: true time minus recorded time; the pose is then that of the true time.
    """

    rotation_rad: Float[np.ndarray, "3"]
    shift_m: Float[np.ndarray, "3"]
    time_offset_s: float

    def recorded_from_true(self) -> RigidTransform:
        """Return the transform from the true frame `camera` to the recorded one."""
        rotation = rotation_from_vector(self.rotation_rad)
        return RigidTransform.from_rotation("camera", "camera", rotation, self.shift_m)


@dataclass(frozen=True, eq=False)
class Alignment:
    """All corrections of a log; None or an absent name means no correction.

    Args:
        path: of the ego; sweeps, cameras and boxes move along with it.
        cameras: by camera name.
        actors: corrected `world_from_actor` of each pose of a track, by actor id.
        has_rolling_shutter: whether frames keep the shutter that the log's reader gave them.
        has_point_times: whether returns keep their own times and origins, not their sweep's.
        has_ego_vehicle_masks: whether the log keeps its masks of the ego vehicle.
        numbers: measured values for reports, by name.
        notes: sentences for reports.
    """

    path: PathCorrection | None = None
    cameras: Mapping[str, CameraCorrection] = field(default_factory=dict)
    actors: Mapping[str, Float[np.ndarray, "_ 4 4"]] = field(default_factory=dict)
    has_rolling_shutter: bool = True
    has_point_times: bool = True
    has_ego_vehicle_masks: bool = True
    numbers: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def applied_to(self, log: DrivingLog) -> DrivingLog:
        """Return the log with all corrections; sweeps are corrected when they are read."""
        frames = [self._frame(log, frame) for frame in log.frames]
        # Corrected clocks may change the order of frames of different cameras.
        frames.sort(key=lambda frame: (frame.time_ns, frame.camera_name))
        return replace(
            log,
            frames=tuple(frames),
            sweeps=tuple(self._sweep(sweep) for sweep in log.sweeps),
            ego=self._trajectory(log.ego),
            actors=tuple(self._actor(actor) for actor in log.actors),
            ego_vehicle_masks=log.ego_vehicle_masks if self.has_ego_vehicle_masks else {},
        )

    def _trajectory(self, trajectory: Trajectory) -> Trajectory:
        if self.path is None:
            return trajectory
        moves = np.stack([self.path.at(int(t)).matrix for t in trajectory.times_ns])
        return replace(trajectory, matrices=moves @ trajectory.matrices)

    def _actor(self, actor: ActorTrack) -> ActorTrack:
        if actor.actor_id in self.actors:
            # These poses were fitted to corrected sweeps: the path correction is contained.
            matrices = self.actors[actor.actor_id]
            return replace(actor, trajectory=replace(actor.trajectory, matrices=matrices))
        return replace(actor, trajectory=self._trajectory(actor.trajectory))

    def _sweep(self, sweep: LazySweep) -> LazySweep:
        # Times are replaced before the path is corrected, so that one correction, that of the
        # sweep's time, applies to all returns.
        load = sweep.load if self.has_point_times else _timeless_loader(sweep.load)
        if self.path is not None:
            load = _corrected_loader(load, self.path)
        return replace(sweep, load=load)

    def _frame(self, log: DrivingLog, frame: CameraFrame) -> CameraFrame:
        # The camera's clock comes first: it moves the frame along the recorded ego path
        # (`log.ego`), and the path is then corrected at the frame's true time.
        correction = self.cameras.get(frame.camera_name)
        if correction is not None:
            frame = corrected_frame(frame, correction, log.ego)
        if self.path is not None:
            pose = self.path.at(frame.time_ns) @ frame.world_from_camera
            frame = replace(frame, world_from_camera=pose)
        return frame if self.has_rolling_shutter else replace(frame, shutter=None)


def corrected_frame(
    frame: CameraFrame, correction: CameraCorrection, ego: Trajectory
) -> CameraFrame:
    """Return the frame with its true time and with the true camera pose at that time."""
    later_ns = frame.time_ns + round(correction.time_offset_s * 1e9)
    pose = _carried(ego, frame.world_from_camera, frame.time_ns, later_ns)
    pose = pose @ correction.recorded_from_true()
    return replace(frame, time_ns=later_ns, world_from_camera=pose)


def _carried(
    ego: Trajectory, world_from_camera: RigidTransform, from_ns: int, to_ns: int
) -> RigidTransform:
    """Return the pose of a camera fixed to the vehicle at another time.

    Beyond the ends of the ego path, the motion of an interval of the same length at that end is
    repeated; the pose is unchanged if the path is shorter than this interval.
    """
    inner_ns = min(max(from_ns, ego.start_ns), ego.end_ns)
    outer_ns = inner_ns + (to_ns - from_ns)
    if ego.covers(outer_ns):
        return ego.at(outer_ns) @ ego.at(inner_ns).inverse() @ world_from_camera
    back_ns = 2 * inner_ns - outer_ns
    if not ego.covers(back_ns):
        return world_from_camera
    # The motion from `back` to `inner`, applied in frame `world` from `inner` onwards.
    return ego.at(inner_ns) @ ego.at(back_ns).inverse() @ world_from_camera


def _timeless_loader(load: Callable[[], LidarSweep]) -> Callable[[], LidarSweep]:
    """Return a loader that replaces the times of all returns by the sweep's time, and their origins
    by the mean origin."""

    def load_timeless() -> LidarSweep:
        sweep = load()
        origins = np.broadcast_to(sweep.origins_world.mean(axis=0), sweep.origins_world.shape)
        still = np.zeros_like(sweep.time_offset_s)
        return replace(sweep, origins_world=origins.astype(np.float32).copy(), time_offset_s=still)

    return load_timeless


def _corrected_loader(
    load: Callable[[], LidarSweep], path: PathCorrection
) -> Callable[[], LidarSweep]:
    def load_corrected() -> LidarSweep:
        sweep = load()
        times_ns = sweep.time_ns + (sweep.time_offset_s.astype(np.float64) * 1e9).astype(np.int64)
        points = path.transformed(sweep.points_world.astype(np.float64), times_ns)
        origins = path.transformed(sweep.origins_world.astype(np.float64), times_ns)
        return replace(
            sweep,
            points_world=points.astype(np.float32),
            origins_world=origins.astype(np.float32),
        )

    return load_corrected
