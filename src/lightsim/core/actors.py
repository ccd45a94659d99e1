"""Traffic participants and other things with a label: their kinds, and their boxes over time."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float

from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.errors import InputError


class ActorKind(StrEnum):
    """What an actor is, as far as shape, motion and material depend on it.

    Readers map a data set's own labels to it. Nothing is assumed about OTHER: none of the
    predicates holds.
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
        """Has a body on three wheels or more, whose two halves mirror each other."""
        return self in _VEHICLES

    @property
    def is_person(self) -> bool:
        """Is a person, with or without what carries them."""
        return self in _PERSONS

    @property
    def is_rigid_body(self) -> bool:
        """Keeps its shape while it moves: one pose says where all of it is."""
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

    `label` is the recording's own word for it, for people and outputs; by default the kind's.
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

    def is_present(self, time_ns: int, hold_s: float = 0.1) -> bool:
        """Whether the actor has a pose then: within its labelled times, or `hold_s` beyond them."""
        return self.trajectory.covers(time_ns, hold_s)

    def world_from_actor(self, time_ns: int, hold_s: float = 0.1) -> RigidTransform:
        """Pose at a time; held for `hold_s` beyond the labelled ends (cameras fire between
        labels)."""
        return self.trajectory.at(time_ns, hold_s)

    def contains(
        self, points_world: Float[np.ndarray, "n 3"], time_ns: int, margin_m: float = 0.0
    ) -> Bool[np.ndarray, " n"]:
        """Which points lie inside the box (grown by `margin_m`) at a time."""
        actor_from_world = self.world_from_actor(time_ns).inverse()
        points_actor = actor_from_world.apply(points_world)
        return np.all(np.abs(points_actor) <= self.size_lwh_m / 2 + margin_m, axis=1)
