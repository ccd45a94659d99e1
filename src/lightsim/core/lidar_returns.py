"""Division of LiDAR returns into those of actors, of the ego vehicle and of the static scene."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from lightsim.core.actors import ActorTrack
from lightsim.core.frames import Trajectory
from lightsim.core.sensors import LidarSweep


@dataclass(frozen=True, eq=False)
class LidarReturns:
    """LiDAR returns of several sweeps from surfaces that do not move, in one frame.

    Args:
        points: ends of the beams, in metres.
        origins: positions of the sensor, in metres.
        is_on_actor: True for returns from actors at rest.
    """

    points: Float32[np.ndarray, "n 3"]
    origins: Float32[np.ndarray, "n 3"]
    is_on_actor: Bool[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class EgoBox:
    """Box of the ego vehicle, from above its wheels up to its highest sensor. Its returns are never
    of the scene.

    Args:
        low_m: lower corner, frame `ego`, metres.
        high_m: upper corner.
    """

    low_m: Float[np.ndarray, "3"]
    high_m: Float[np.ndarray, "3"]

    def contains(self, points_ego: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return a mask of the points inside the box."""
        return np.all((points_ego > self.low_m) & (points_ego < self.high_m), axis=1)


def points_on_ego(
    sweep: LidarSweep, ego: Trajectory, box: EgoBox
) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, "k 3"]]:
    """Return indices of the returns inside the ego vehicle's box, each tested at its own time, and
    their positions in frame `ego`.

    Args:
        ego: trajectory `world_from_ego`.
    """
    # A cheap test first: all returns of the box have beams shorter than its diagonal.
    near = np.flatnonzero(sweep.distances_m < np.linalg.norm(box.high_m - box.low_m))
    local = ego.to_src(sweep.points_world[near], sweep.times_ns[near])
    is_inside = box.contains(local)
    return near[is_inside], local[is_inside]


def is_on_actors(sweep: LidarSweep, actors: Iterable[ActorTrack]) -> Bool[np.ndarray, " n"]:
    """Return the returns inside the box of an actor, each tested at its own time.

    Boxes are grown by `ActorTrack.box_margin_m`; ground inside of them counts as actor.
    """
    is_inside, times_ns = np.zeros(len(sweep.points_world), dtype=bool), sweep.times_ns
    for actor in actors:
        is_inside[actor.returns_inside(sweep.points_world, times_ns)[0]] = True
    return is_inside


def is_static(sweep: LidarSweep, actors: Iterable[ActorTrack]) -> Bool[np.ndarray, " n"]:
    """Return the returns of surfaces that do not move: the static scene and actors at rest."""
    return ~is_on_actors(sweep, (actor for actor in actors if actor.is_moving))


def actor_labels(sweep: LidarSweep, actors: Sequence[ActorTrack]) -> Int64[np.ndarray, " n"]:
    """Label returns: i + 1 on actor i, else 0. Ground inside of boxes has label 0."""
    labels, times_ns = np.zeros(len(sweep.points_world), dtype=np.int64), sweep.times_ns
    for index, actor in enumerate(actors):
        inside, points_actor = actor.returns_inside(sweep.points_world, times_ns)
        labels[inside[actor.is_above_ground(points_actor)]] = index + 1
    return labels
