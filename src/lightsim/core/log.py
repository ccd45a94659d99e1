"""A recording: cameras, frames, sweeps, ego motion, actors and place on Earth."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from jaxtyping import Bool, Float, Float64

from lightsim.core.actors import ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.lidar_returns import EgoBox, points_on_ego
from lightsim.core.sensors import CameraFrame, LazySweep, LidarSweep
from lightsim.core.solar import (
    SolarPosition,
    azimuth_elevation,
    direction_world,
    solar_position,
)
from lightsim.errors import InputError

# Error of refraction and of the world frame's levelling, in degrees; the ephemeris itself is exact
# to 0.001 degrees.
EPHEMERIS_STD_DEG = 0.05
# Rotation of the sky in one second: 360 degrees in a sidereal day.
SKY_DEG_A_SECOND = 360.0 / 86164.0
# Error of a sun position that the user gives, in degrees; an assumption.
GIVEN_SUN_STD_DEG = 1.0


@dataclass(frozen=True)
class Place:
    """Position on Earth, degrees; `std_deg` is one standard deviation of it, as an angle on
    Earth."""

    latitude_deg: float
    longitude_deg: float
    origin: str = "gps"
    """Source: "gps", "given", or a name such as "origin of the map" or "centre of the city"."""
    std_deg: float = 0.0


@dataclass(frozen=True)
class Clock:
    """UTC time of a log: its own time plus `utc_minus_log_ns`."""

    utc_minus_log_ns: int = 0
    origin: str = "log"
    std_s: float = 1.0
    """One standard deviation of the clock, in seconds."""


@dataclass(frozen=True, eq=False)
class GeoReference:
    """Place, time and north of a log; each may be unknown.

    Args:
        enu_from_world: rotation about z, or None where north is unknown.
        heading_origin: source of north: "gps track", "given", "map" or "unknown".
        heading_residual_deg: one standard deviation of the heading, degrees, where it is known.
        heading_residual_m: RMS distance between the rotated ego path and the GPS track.
        given_sun: position of the recorded sun as given by the user; place and time are then
            not used for it.
    """

    place: Place | None
    clock: Clock | None
    enu_from_world: RigidTransform | None
    heading_origin: str
    heading_residual_deg: float | None
    heading_residual_m: float | None = None
    given_sun: SolarPosition | None = None

    def sun_at(self, time_ns: int) -> SolarPosition | None:
        """Return the recorded sun at a time of the log's clock; None if it is unknown."""
        if self.given_sun is not None:
            return self.given_sun
        if self.clock is None:
            return None
        return self.sun_at_utc(time_ns + self.clock.utc_minus_log_ns)

    def sun_at_utc(self, utc_ns: int) -> SolarPosition | None:
        """Return the sun at the log's place and a UTC time; None if the place is unknown."""
        if self.place is None:
            return None
        return solar_position(self.place.latitude_deg, self.place.longitude_deg, utc_ns)

    def direction_at(self, time_ns: int) -> Float[np.ndarray, "3"] | None:
        """Return the unit vector to the recorded sun, frame `world`; None if it is unknown."""
        sun = self.sun_at(time_ns)
        if sun is None or self.enu_from_world is None:
            return None
        return direction_world(sun.azimuth_deg, sun.elevation_deg, self.enu_from_world)

    @property
    def sun_std_deg(self) -> float:
        """One standard deviation of `sun_at`, without the heading's, in degrees."""
        if self.given_sun is not None:
            return GIVEN_SUN_STD_DEG
        place_deg = 0.0 if self.place is None else self.place.std_deg
        clock_s = 0.0 if self.clock is None else self.clock.std_s
        return math.hypot(EPHEMERIS_STD_DEG, place_deg, clock_s * SKY_DEG_A_SECOND)

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
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Origin of frame `world` in the recording's own world frame, whose axes are parallel; readers
    move it to the first ego position, because float32 has steps of 0.25 m in UTM coordinates."""
    licence: str = ""
    """Licence of the recording, which exports repeat."""
    has_heights: bool = True
    """Whether the ego path contains heights. A localisation on a map, as of nuScenes, does not:
    slopes are missing, and pitch and roll are uncertain."""
    ego_box: EgoBox | None = None
    """Box of the ego vehicle around its own LiDAR returns, which are no part of the scene; None:
    there are none."""

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

    @cached_property
    def ahead_by_camera(self) -> dict[str, float]:
        """Cosine of the angle between each camera's optical axis and the ego vehicle's direction,
        at its first frame, in descending order."""
        first = {frame.camera_name: frame for frame in reversed(self.frames)}
        cosines = {
            name: float(
                frame.world_from_camera.rotation[:, 2] @ self.ego.held(frame.time_ns).rotation[:, 0]
            )
            for name, frame in first.items()
        }
        return dict(sorted(cosines.items(), key=lambda item: -item[1]))

    def actors_at(self, time_ns: int) -> tuple[ActorTrack, ...]:
        """Return the actors that are present at a time (`ActorTrack.is_present`)."""
        return tuple(actor for actor in self.actors if actor.is_present(time_ns))

    def without_ego_returns(self) -> DrivingLog:
        """Return the log with sweeps that do not contain returns on the ego vehicle."""
        box = self.ego_box
        if box is None:
            return self

        def load_scene(load: Callable[[], LidarSweep]) -> LidarSweep:
            sweep = load()
            is_scene = np.ones(len(sweep.points_world), dtype=bool)
            is_scene[points_on_ego(sweep, self.ego, box)[0]] = False
            return sweep.rows(is_scene)

        sweeps = (replace(lazy, load=partial(load_scene, lazy.load)) for lazy in self.sweeps)
        return replace(self, sweeps=tuple(sweeps))

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
