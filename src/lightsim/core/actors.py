"""Traffic participants as labelled boxes over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.errors import InputError


@dataclass(frozen=True, eq=False)
class ActorTrack:
    """One actor: `trajectory` is world_from_actor; the actor frame sits at the box centre."""

    actor_id: str
    kind: str
    size_lwh_m: Float[np.ndarray, "3"]
    trajectory: Trajectory
    is_moving: bool

    def __post_init__(self) -> None:
        if not np.isfinite(self.size_lwh_m).all() or (self.size_lwh_m <= 0).any():
            raise InputError(
                "the box size must be positive and finite",
                where=f"actor '{self.actor_id}'",
                got=self.size_lwh_m.tolist(),
                expected="length, width and height in metres, each above 0",
            )

    def is_present(self, time_ns: int, hold_s: float = 0.1) -> bool:
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
