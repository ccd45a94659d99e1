"""Division of LiDAR returns into those of actors and of the static scene."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64

from lightsim.core.actors import ActorTrack
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
