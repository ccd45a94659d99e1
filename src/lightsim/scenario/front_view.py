"""Visibility of boxes in the pictures of the camera that looks ahead."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Float64

from lightsim.core.actors import ActorTrack
from lightsim.core.casting import RayCaster
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import CameraFrame

_MOST_FRAMES = 16
"""Frames that are looked at, evenly over the log: at 50 km/h every 7 m of an 8 s log."""
_POINTS = np.stack(np.meshgrid(*[(-0.4, 0.0, 0.4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
"""Points of a box that sight lines lead to, as fractions of its size from the middle."""
_SEEN = 0.25
"""Fraction of the points that a picture must show: less is a bumper behind another car, or at the
picture's border. Chosen, not measured."""
_SURFACE_M = 0.05
"""Static surface this close before a point is what the box stands on or beside."""


class FrontView:
    """Tests which actors the front camera sees, past static surfaces and the log's actors.

    Args:
        background: caster over the twin's static meshes.
        tracks: actors that can hide others.
    """

    def __init__(
        self, log: DrivingLog, background: RayCaster, tracks: Sequence[ActorTrack]
    ) -> None:
        self.camera_name = _front_camera(log)
        frames = log.frames_of(self.camera_name)
        chosen = np.linspace(0, len(frames) - 1, min(len(frames), _MOST_FRAMES))
        self._frames = [frames[k] for k in np.rint(chosen).astype(int).tolist()]
        self._camera = log.cameras[self.camera_name]
        self._vehicle = log.ego_vehicle_masks.get(self.camera_name)
        self._background = background
        self._others = [
            {t.actor_id: _Box.of(t, f.time_ns) for t in tracks if t.is_present(f.time_ns)}
            for f in self._frames
        ]

    def sees(self, track: ActorTrack, absent: Collection[str] = ()) -> bool:
        """Return whether a picture shows a quarter of an actor or more.

        Args:
            absent: actors of the log that hide nothing because they are removed.
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
            for name, box in others.items():
                if name not in absent:
                    is_seen &= ~box.hides(origin, points)
            away = points - origin
            distance = np.linalg.norm(away, axis=1)
            origins = np.broadcast_to(origin, away.shape)
            hits = self._background.intersect(origins, away / distance[:, None])
            yield is_seen & (hits.distance_m > distance - _SURFACE_M)

    def _in_picture(
        self, frame: CameraFrame, points: Float[np.ndarray, "p 3"]
    ) -> Bool[np.ndarray, " p"]:
        """Points that project into the picture, beside the ego vehicle's own pixels."""
        uv, is_inside = self._camera.project(frame.world_from_camera.inverse().apply(points))
        if self._vehicle is not None:
            u, v = np.where(is_inside[:, None], uv, 0.0).astype(int).T
            is_inside = is_inside & ~self._vehicle[v, u]
        return is_inside


class _Box:
    """An actor's box at one time, as an occluder."""

    def __init__(
        self, actor_from_world: Float64[np.ndarray, "4 4"], half: Float[np.ndarray, "3"]
    ) -> None:
        self._rotation, self._shift, self._half = (
            actor_from_world[:3, :3],
            actor_from_world[:3, 3],
            half,
        )

    @classmethod
    def of(cls, track: ActorTrack, time_ns: int) -> _Box:
        """The box of a track."""
        return cls(track.world_from_actor(time_ns).inverse().matrix, track.size_lwh_m / 2)

    def hides(
        self, origin: Float[np.ndarray, "3"], points: Float[np.ndarray, "p 3"]
    ) -> Bool[np.ndarray, " p"]:
        """Test which sight lines from the origin to points pass through the box (by slabs)."""
        start = self._rotation @ origin + self._shift
        way = points @ self._rotation.T + self._shift - start
        way = np.where(np.abs(way) < 1e-9, 1e-9, way)
        ends = (-self._half - start) / way, (self._half - start) / way
        enter, leave = np.minimum(*ends).max(axis=1), np.maximum(*ends).min(axis=1)
        return (leave > np.maximum(enter, 0.0)) & (enter < 1.0)


def _front_camera(log: DrivingLog) -> str:
    """The camera whose optical axis is nearest to the ego vehicle's direction."""

    def ahead(name: str) -> float:
        frame = log.frames_of(name)[0]
        return float(
            frame.world_from_camera.rotation[:, 2] @ log.ego.held(frame.time_ns).rotation[:, 0]
        )

    return max((name for name in log.cameras if log.frames_of(name)), key=ahead)
