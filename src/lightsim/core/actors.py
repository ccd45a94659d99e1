"""Traffic participants and other things with a label: their kinds, and their boxes over time."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.sensors import SWEEP_HOLD_S
from lightsim.errors import InputError

# Margin around the box of a moving actor within which returns belong to it, in metres. On log 002
# (benchmarks/actor_returns.py), its last 5 cm hold 125 returns of classes that move and 110 of
# static objects; the next 5 cm, 71 and 312.
_MOVING_MARGIN_M = 0.25
# The same of an actor at rest, whose box fits better: from 0.1 to 0.2 m there are 45 and 9,100
# returns, which are the same static surface in every sweep.
_RESTING_MARGIN_M = 0.1
# Height above a box's underside, in metres, below which returns may be of the ground. Chosen on log
# 002 and synthetic street 0; sensitivity not measured.
_FLOOR_M = 0.12


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
        reach_m = np.full(2, np.linalg.norm(half))
        near = _beside(points_world, pose.translation_m[:2], reach_m)
        is_inside = np.zeros(len(points_world), dtype=bool)
        points_actor = pose.inverse().apply(points_world[near])
        is_inside[near] = (np.abs(points_actor) <= half).all(axis=1)
        return is_inside

    @property
    def box_margin_m(self) -> float:
        """Margin around the box within which returns belong to the actor, in metres."""
        return _MOVING_MARGIN_M if self.is_moving else _RESTING_MARGIN_M

    def returns_inside(
        self,
        points_world: Float[np.ndarray, "n 3"],
        times_ns: Int64[np.ndarray, " n"],
        margin_m: float | None = None,
    ) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, "k 3"]]:
        """Return the returns inside the box, each tested at its own time.

        Args:
            margin_m: growth of the box on every side; by default `box_margin_m`.

        Returns:
            Indices of the returns, and their positions in frame `actor`.
        """
        half = self.size_lwh_m / 2 + (self.box_margin_m if margin_m is None else margin_m)
        near = self._near_path(points_world, times_ns, float(np.linalg.norm(half)))
        local = self.trajectory.to_src(points_world[near], times_ns[near])
        is_inside = (np.abs(local) <= half).all(axis=1)
        return near[is_inside], local[is_inside]

    def is_above_ground(self, points_actor: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return a mask of the points that are too high above the box's underside to be returns of
        the ground."""
        height_m = float(self.size_lwh_m[2])
        return points_actor[:, 2] > min(_FLOOR_M, 0.2 * height_m) - height_m / 2

    def _near_path(
        self,
        points_world: Float[np.ndarray, "n 3"],
        times_ns: Int64[np.ndarray, " n"],
        reach_m: float,
    ) -> Int64[np.ndarray, " k"]:
        """Return indices of the points measured while the actor is present, less than `reach_m`
        along x and along y from the rectangle around its path in that time."""
        hold_ns, path = int(SWEEP_HOLD_S * 1e9), self.trajectory
        first_ns = max(int(times_ns.min(initial=np.iinfo(np.int64).max)), path.start_ns - hold_ns)
        last_ns = min(int(times_ns.max(initial=0)), path.end_ns + hold_ns)
        if first_ns > last_ns:
            return np.zeros(0, dtype=np.int64)
        is_between = (path.times_ns > first_ns) & (path.times_ns < last_ns)
        knots_ns = np.array([first_ns, *path.times_ns[is_between], last_ns], dtype=np.int64)
        places = path.held_positions_m(knots_ns)[:, :2]
        centre, half_m = (places.max(axis=0) + places.min(axis=0)) / 2, np.ptp(places, axis=0) / 2
        near = _beside(points_world, centre, half_m + reach_m)
        return near[(times_ns[near] >= first_ns) & (times_ns[near] <= last_ns)]


def _beside(
    points_world: Float[np.ndarray, "n 3"],
    centre_world: Float[np.ndarray, "2"],
    reach_m: Float[np.ndarray, "2"],
) -> Int64[np.ndarray, " k"]:
    """Return indices of the points less than `reach_m` from a place along x and along y."""
    # A cheap test first: most points of a sweep are far from any one actor. Height is not tested,
    # as streets are flat. Numbers stay in the type of the points, mostly float32.
    centre, reach = (values.astype(points_world.dtype) for values in (centre_world, reach_m))
    is_near = np.abs(points_world[:, 0] - centre[0]) < reach[0]
    is_near &= np.abs(points_world[:, 1] - centre[1]) < reach[1]
    return np.flatnonzero(is_near)
