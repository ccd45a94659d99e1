"""A recording: cameras, frames, sweeps, ego motion, actors and place on Earth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64

from lightsim.core.actors import ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.sensors import CameraFrame, LazySweep
from lightsim.core.solar import azimuth_elevation
from lightsim.errors import InputError


@dataclass(frozen=True, eq=False)
class GeoReference:
    """Place, time and heading. `enu_from_world` is a rotation about z, or None where the log
    never moves and no heading was given."""

    latitude_deg: float
    longitude_deg: float
    utc_start_ns: int
    enu_from_world: RigidTransform | None
    heading_origin: str
    """Source of the heading: "gps track", "given" or "unknown"."""
    heading_residual_deg: float | None
    """One standard deviation of the heading, degrees, where it was fitted."""
    heading_residual_m: float | None = None
    """RMS distance between the rotated ego path and the GPS track."""

    @property
    def heading_deg(self) -> float | None:
        """Azimuth of world +x, clockwise from true north."""
        if self.enu_from_world is None:
            return None
        # The first column is the world x axis in frame `enu`.
        return azimuth_elevation(self.enu_from_world.matrix[:3, 0]).azimuth_deg


@dataclass(frozen=True, eq=False)
class DrivingLog:
    """One recording. Frames and sweeps are in time order; all times are of one clock."""

    name: str
    cameras: Mapping[str, PinholeCamera]
    frames: tuple[CameraFrame, ...]
    sweeps: tuple[LazySweep, ...]
    ego: Trajectory
    actors: tuple[ActorTrack, ...]
    geo: GeoReference | None
    ego_vehicle_masks: Mapping[str, Bool[np.ndarray, "h w"]]
    """True where a camera shows the ego vehicle itself; cameras without an entry show none of
    it."""
    notes: tuple[str, ...] = ()
    """Unusual or substituted input: printed once and recorded in the artefact."""
    semantic_names: Mapping[int, str] = field(default_factory=dict[int, str])
    """Name of each id of `LidarSweep.semantic_class` in the recording; empty if unlabelled."""

    def frames_of(self, camera_name: str) -> tuple[CameraFrame, ...]:
        """Return the frames of one camera, in time order.

        Raises:
            InputError: no such camera.
        """
        if camera_name not in self.cameras:
            raise InputError(
                f"camera '{camera_name}' is not in the log",
                where=self.name,
                expected=f"one of {', '.join(self.cameras)}",
            )
        return tuple(f for f in self.frames if f.camera_name == camera_name)

    def actors_at(self, time_ns: int) -> tuple[ActorTrack, ...]:
        """Return the actors that are present at a time (`ActorTrack.is_present`)."""
        return tuple(actor for actor in self.actors if actor.is_present(time_ns))

    def with_frames(self, frames: tuple[CameraFrame, ...]) -> DrivingLog:
        """Return the log with other camera frames; sweeps, ego and actors are unchanged."""
        return replace(self, frames=frames)

    @cached_property
    def number_by_actor(self) -> dict[str, int]:
        """Number of each actor, the same in fields, buffers and files."""
        return {actor.actor_id: number for number, actor in enumerate(self.actors)}

    @property
    def camera_positions_m(self) -> Float64[np.ndarray, "n 3"]:
        """Position of the camera at each frame, frame `world`."""
        positions = [frame.world_from_camera.translation_m for frame in self.frames]
        return np.array(positions, dtype=np.float64).reshape(-1, 3)

    @property
    def stems(self) -> tuple[str, ...]:
        """Distinct frame stems in time order."""
        return tuple(dict.fromkeys(f.stem for f in self.frames))


FindEgoVehicle = Callable[
    [Sequence[tuple[PinholeCamera, Sequence[CameraFrame]]], Trajectory],
    tuple[dict[str, Bool[np.ndarray, "h w"]], tuple[str, ...]],
]
"""(cameras with their frames, world_from_ego) -> masks of the ego vehicle, notes."""


def without_ego_vehicle(
    views: Sequence[tuple[PinholeCamera, Sequence[CameraFrame]]], ego: Trajectory
) -> tuple[dict[str, Bool[np.ndarray, "h w"]], tuple[str, ...]]:
    """Return no masks; for readers that do not search for the ego vehicle."""
    return {}, ()
