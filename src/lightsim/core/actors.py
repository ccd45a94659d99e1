"""Traffic participants and other things with a label: their kinds, and their boxes over time."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.sensors import SWEEP_HOLD_S, LidarSweep
from lightsim.errors import InputError

# Upper bound of an actor's motion during one sweep: 30 m/s for 0.1 s. Only widens a search.
_SWEPT_M = 3.0


class ActorKind(StrEnum):
    """Class of an actor, which decides its default shape, motion model and materials.

    Readers map the labels of a data set to it. All predicates are false for two-wheelers, animals
    and OTHER.
    """

    CAR = "car"
    PICKUP = "pickup"
    TRUCK = "truck"
    BUS = "bus"
    RAIL_VEHICLE = "rail vehicle"
    TRAILER = "trailer"
    CONSTRUCTION_VEHICLE = "construction vehicle"
    OTHER_VEHICLE = "other vehicle"
    MOTORCYCLE = "motorcycle"
    SCOOTER = "scooter"
    BICYCLE = "bicycle"
    PEDESTRIAN = "pedestrian"
    PERSONAL_MOBILITY = "personal mobility"
    ANIMAL = "animal"
    CONE = "cone"
    SIGN = "sign"
    BARRIER = "barrier"
    ROLLING_CONTAINER = "rolling container"
    OTHER = "other"

    @property
    def is_vehicle(self) -> bool:
        """True for rigid vehicles, trailers and trams included, whose left and right halves are
        symmetric; not for two-wheelers."""
        return self in _VEHICLES

    @property
    def is_person(self) -> bool:
        """True for people on foot and on personal mobility devices."""
        return self in _PERSONS

    @property
    def is_rigid_body(self) -> bool:
        """True if one pose describes the position of the whole actor at a time."""
        # Riders and walkers move their limbs; of the other kinds too little is known.
        return self.is_vehicle or self in _STREET_FURNITURE


_VEHICLES = frozenset({
    ActorKind.CAR, ActorKind.PICKUP, ActorKind.TRUCK, ActorKind.BUS, ActorKind.RAIL_VEHICLE,
    ActorKind.TRAILER, ActorKind.CONSTRUCTION_VEHICLE, ActorKind.OTHER_VEHICLE,
})  # fmt: skip
_PERSONS = frozenset({ActorKind.PEDESTRIAN, ActorKind.PERSONAL_MOBILITY})
_STREET_FURNITURE = frozenset(
    {ActorKind.CONE, ActorKind.SIGN, ActorKind.BARRIER, ActorKind.ROLLING_CONTAINER}
)


@dataclass(frozen=True, eq=False)
class ActorTrack:
    """One actor: `trajectory` is world_from_actor; the actor frame sits at the box centre.

    `label` is the name in the recording, used in messages and outputs; by default that of `kind`.
    """

    actor_id: str
    kind: ActorKind
    size_lwh_m: Float[np.ndarray, "3"]
    trajectory: Trajectory
    is_moving: bool
    label: str = ""

    def __post_init__(self) -> None:
        if not self.label:
            object.__setattr__(self, "label", str(self.kind))
        if not np.isfinite(self.size_lwh_m).all() or (self.size_lwh_m <= 0).any():
            raise InputError(
                "the box size must be positive and finite",
                where=f"actor '{self.actor_id}'",
                got=self.size_lwh_m.tolist(),
                expected="length, width and height in metres, each above 0",
            )

    @property
    def corners_actor(self) -> Float64[np.ndarray, "8 3"]:
        """Corners of the box, frame `actor`, metres; bits 1, 2 and 4 of the index are set for
        positive z, y and x."""
        signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        return signs * self.size_lwh_m

    def is_present(self, time_ns: int, hold_s: float = 0.1) -> bool:
        """True from the first to the last labelled time, extended by `hold_s` at both ends."""
        return self.trajectory.covers(time_ns, hold_s)

    def world_from_actor(self, time_ns: int, hold_s: float = 0.1) -> RigidTransform:
        """Pose at a time; held for `hold_s` beyond the labelled ends (cameras fire between
        labels)."""
        return self.trajectory.at(time_ns, hold_s)

    def contains(
        self, points_world: Float[np.ndarray, "n 3"], time_ns: int, margin_m: float = 0.0
    ) -> Bool[np.ndarray, " n"]:
        """Return a mask of the points inside the box, grown by `margin_m`, at a time."""
        pose = self.world_from_actor(time_ns)
        half = self.size_lwh_m / 2 + margin_m
        # The half diagonal bounds the box for every heading, so that no rotation is needed here.
        near = _beside(points_world, pose, float(np.linalg.norm(half)))
        is_inside = np.zeros(len(points_world), dtype=bool)
        points_actor = pose.inverse().apply(points_world[near])
        is_inside[near] = (np.abs(points_actor) <= half).all(axis=1)
        return is_inside

    def returns_beside(
        self, sweep: LidarSweep
    ) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, "k 3"]]:
        """Return indices of the returns near the actor, and their positions in frame `actor` at the
        median time of these returns. The actor must be present at the sweep's time."""
        pose = self.world_from_actor(sweep.time_ns, SWEEP_HOLD_S)
        reach_m = float(np.linalg.norm(self.size_lwh_m)) / 2 + _SWEPT_M
        near = _beside(sweep.points_world, pose, reach_m)
        if len(near):
            # A sweep takes 0.1 s, in which a car moves metres; one actor is scanned in a
            # small part of it.
            time_ns = sweep.time_ns + int(float(np.median(sweep.time_offset_s[near])) * 1e9)
            if self.is_present(time_ns, SWEEP_HOLD_S):
                pose = self.world_from_actor(time_ns, SWEEP_HOLD_S)
        return near, pose.inverse().apply(sweep.points_world[near].astype(np.float64))


def _beside(
    points_world: Float[np.ndarray, "n 3"], pose: RigidTransform, reach_m: float
) -> Int64[np.ndarray, " k"]:
    """Return indices of the points less than `reach_m` from a pose along x and along y."""
    # A cheap test first: most points of a sweep are far from any one actor. Height is not tested,
    # as streets are flat. Differences stay in the type of the points, mostly float32.
    offset = points_world[:, :2] - pose.translation_m[:2].astype(points_world.dtype)
    return np.flatnonzero((np.abs(offset) < reach_m).all(axis=1))
