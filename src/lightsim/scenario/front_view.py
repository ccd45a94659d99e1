"""Visibility of boxes in the pictures of the cameras that look ahead."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from lightsim.core.actors import ActorTrack
from lightsim.core.casting import RayCaster
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import CameraFrame

# Largest angle between the optical axis of a forward camera and the driving direction, in degrees:
# PandaSet's front, front left and front right cameras.
_AHEAD_DEG = 75.0
# Number of tested frames of a camera, evenly over the log: every 7 m at 50 km/h in 8 s.
_MOST_FRAMES = 16
# Target points of sight lines in a box, as fractions of its size from the centre.
_POINTS = np.stack(np.meshgrid(*[(-0.4, 0.0, 0.4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
# Least visible fraction of these points: less is a bumper behind another car, or at the border of
# the picture. Chosen; sensitivity not measured.
_SEEN = 0.25
# Replaces a zero component of a direction in the slab test, which divides by it.
_LEAST_M = 1e-9
# Distance in front of a point within which static surface does not hide it, in metres: the ground
# or wall that the box touches.
_SURFACE_M = 0.05


class FrontView:
    """Test of the visibility of actors for forward cameras, with occlusion by the scene and by
    actors.

    Args:
        background: caster over the twin's static meshes.
        tracks: actors that can hide others.
    """

    def __init__(
        self, log: DrivingLog, background: RayCaster, tracks: Sequence[ActorTrack]
    ) -> None:
        self._log, self._background = log, background
        self.camera_names = _looking_ahead(log)
        self._frames: list[CameraFrame] = []
        for name in self.camera_names:
            frames = log.frames_of(name)
            chosen = np.linspace(0, len(frames) - 1, min(len(frames), _MOST_FRAMES))
            self._frames += [frames[k] for k in np.rint(chosen).astype(int).tolist()]
        self._others = [_Boxes.of(tracks, frame.time_ns) for frame in self._frames]

    def sees(self, track: ActorTrack, absent: Collection[str] = ()) -> bool:
        """Return whether a picture shows at least a quarter of an actor.

        Args:
            absent: removed actors of the log, which hide nothing.
        """
        return any(
            is_seen.mean() >= _SEEN for is_seen in self._seen(track, {*absent, track.actor_id})
        )

    def _seen(self, track: ActorTrack, absent: set[str]) -> Iterator[Bool[np.ndarray, " p"]]:
        for frame, others in zip(self._frames, self._others, strict=True):
            if not track.is_present(frame.time_ns):
                continue
            points = track.world_from_actor(frame.time_ns).apply(_POINTS * track.size_lwh_m)
            is_seen = self._in_picture(frame, points)
            if is_seen.mean() < _SEEN:
                continue
            origin = frame.world_from_camera.translation_m
            is_seen &= ~others.hide(origin, points, absent)
            away = points - origin
            distance = np.linalg.norm(away, axis=1)
            origins = np.broadcast_to(origin, away.shape)
            hits = self._background.intersect(origins, away / distance[:, None])
            yield is_seen & (hits.distance_m > distance - _SURFACE_M)

    def _in_picture(
        self, frame: CameraFrame, points: Float[np.ndarray, "p 3"]
    ) -> Bool[np.ndarray, " p"]:
        """Return the points that project into the picture and not onto the ego vehicle."""
        camera = self._log.cameras[frame.camera_name]
        # Without the rolling shutter: it moves points by few pixels, and a fraction is estimated.
        uv, is_inside = camera.project(frame.world_from_camera.inverse().apply(points))
        vehicle = self._log.ego_vehicle_masks.get(frame.camera_name)
        if vehicle is not None:
            u, v = np.where(is_inside[:, None], uv, 0.0).astype(int).T
            is_inside = is_inside & ~vehicle[v, u]
        return is_inside


@dataclass(frozen=True, eq=False)
class _Boxes:
    """Boxes of actors at one time, as occluders."""

    names: tuple[str, ...]
    rotation: Float64[np.ndarray, "k 3 3"]
    shift_m: Float64[np.ndarray, "k 3"]
    half_m: Float64[np.ndarray, "k 3"]

    @classmethod
    def of(cls, tracks: Sequence[ActorTrack], time_ns: int) -> _Boxes:
        """Return the boxes of all actors that are present."""
        there = [t for t in tracks if t.is_present(time_ns)]
        to_actor = np.array([t.world_from_actor(time_ns).inverse().matrix for t in there])
        to_actor = to_actor.reshape(-1, 4, 4)
        half = np.array([t.size_lwh_m / 2 for t in there], dtype=np.float64).reshape(-1, 3)
        names = tuple(t.actor_id for t in there)
        return cls(names, to_actor[:, :3, :3], to_actor[:, :3, 3], half)

    def hide(
        self,
        origin: Float[np.ndarray, "3"],
        points: Float[np.ndarray, "p 3"],
        absent: Collection[str],
    ) -> Bool[np.ndarray, " p"]:
        """Test which sight lines from the origin to points pass through a box, by slabs."""
        # In the frame of each box, where its faces are planes of constant coordinates. `enter` and
        # `leave` are fractions of the way from origin to point; a box hides if it is entered
        # before.
        start = (self.rotation @ origin + self.shift_m)[:, None]
        way = np.einsum("kij,pj->kpi", self.rotation, points) + self.shift_m[:, None] - start
        way = np.where(np.abs(way) < _LEAST_M, _LEAST_M, way)
        half = self.half_m[:, None]
        ends = (-half - start) / way, (half - start) / way
        enter, leave = np.minimum(*ends).max(axis=2), np.maximum(*ends).min(axis=2)
        is_there = np.array([name not in absent for name in self.names], dtype=bool)
        is_hidden = (leave > np.maximum(enter, 0.0)) & (enter < 1.0)
        return is_hidden[is_there].any(axis=0)


def _looking_ahead(log: DrivingLog) -> list[str]:
    """Return the cameras whose optical axes lie within an angle of the ego vehicle's direction,
    the nearest first; at least one."""
    ahead, least = log.ahead_by_camera, np.cos(np.radians(_AHEAD_DEG))
    return [name for name, cosine in ahead.items() if cosine > least] or list(ahead)[:1]
