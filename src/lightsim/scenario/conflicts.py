"""Conflicts of a scenario: overlaps with actors, ego vehicle or walls, and places without ground.

Only edited actors are tested: labelled boxes of a recording may touch each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float64

from lightsim.core.actors import ActorTrack
from lightsim.core.casting import RayCaster
from lightsim.core.frames import Trajectory
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.scenario.apply import EGO_BODY
from lightsim.scenario.ground import StandingGround

# Overlap below which boxes merely touch, as labelled boxes do, in metres.
_TOUCH_M = 0.1
# Height up to which static surface in a box is ignored, in metres: kerbs, and noise of the road.
_KERB_M = 0.35
# Rays along each axis of a box: about 0.3 m apart in a car.
_GRID = 6
# Cross products of edges below this length belong to parallel edges, which define no axis.
_PARALLEL = 1e-6

Cause = Literal["ground", "static", "ego", "actor"]
_WORDS: dict[Cause, str] = {
    "ground": "'{0}' is off the reconstructed ground",
    "static": "'{0}' overlaps a wall or another static object",
    "ego": "'{0}' and the ego vehicle overlap",
    "actor": "'{0}' and '{1}' overlap",
}


@dataclass(frozen=True)
class Conflict:
    """Impossible pose of an edited actor.

    Args:
        actor_id: the edited actor.
        cause: no measured ground below, static surface in the box, the ego vehicle, another actor.
        other_id: the other actor; empty for other causes.
        stems: first and last frame of the conflict.
    """

    actor_id: str
    cause: Cause
    other_id: str
    stems: tuple[str, str]

    def __str__(self) -> str:
        first, last = self.stems
        frames = f"frame {first}" if first == last else f"frames {first} to {last}"
        return f"{_WORDS[self.cause].format(self.actor_id, self.other_id)}: {frames}"


class ConflictSearch:
    """Search for conflicts at the times of frames.

    Unedited actors are sampled once, so that many edits can be tried quickly.
    """

    def __init__(self, frames: Sequence[CameraFrame], ground: StandingGround) -> None:
        by_time = {frame.time_ns: frame.stem for frame in frames}
        self._times_ns = np.array(sorted(by_time), dtype=np.int64)
        self._stems = [by_time[int(time_ns)] for time_ns in self._times_ns]
        self.ground = ground
        """The ground on which edited actors stand."""
        self._kept: dict[ActorTrack, _Sampled] = {}

    def find(self, scenario: Scenario, edited: Sequence[ActorTrack]) -> tuple[Conflict, ...]:
        """Return one conflict for each actor and cause, in the order of their first frames.

        Args:
            edited: tracks that differ from the log.
        """
        first = {stem: number for number, stem in reversed([*enumerate(self._stems)])}
        found = self.each(scenario, edited)
        return tuple(sorted(found, key=lambda conflict: first[conflict.stems[0]]))

    def each(self, scenario: Scenario, edited: Sequence[ActorTrack]) -> Iterator[Conflict]:
        """Yield the conflicts of one edited actor after the other; arguments as of `find`."""
        there = [t for t in scenario.tracks if t.actor_id not in scenario.removed]
        names = {track.actor_id for track in edited}
        sampled = [self._sample(t, is_kept=t.actor_id not in names) for t in there]
        for number, track in enumerate(there):
            if track.actor_id not in names:
                continue
            # Each pair of edited actors is tested once.
            others = [s for s in sampled[:number] if s.track.actor_id not in names]
            others += sampled[number + 1 :]
            for cause, other_id, is_now in self._of(sampled[number], others, scenario.ego):
                now = np.flatnonzero(is_now)
                if len(now):
                    stems = self._stems[now[0]], self._stems[now[-1]]
                    yield Conflict(track.actor_id, cause, other_id, stems)

    def _sample(self, track: ActorTrack, *, is_kept: bool) -> _Sampled:
        if track not in self._kept:
            sampled = _Sampled.of(track, self._times_ns)
            if not is_kept:
                return sampled
            self._kept[track] = sampled
        return self._kept[track]

    def _of(
        self, one: _Sampled, others: Sequence[_Sampled], ego: Trajectory | None
    ) -> Iterator[tuple[Cause, str, Bool[np.ndarray, " t"]]]:
        """Yield causes, other actors and the times at which they hold."""
        now = np.flatnonzero(one.is_present)
        if not len(now):
            return
        size = one.track.size_lwh_m
        # A standing actor is tested once; interpolation leaves noise below a micrometre.
        poses, which = np.unique(one.poses[now].round(6), axis=0, return_inverse=True)
        which = which.reshape(-1)
        is_known = self.ground.is_known(poses[:, :2, 3])
        yield "ground", "", self._at(now, ~is_known[which])
        if self.ground.background is not None:
            is_in = cuts_static(self.ground.background, poses, size)
            yield "static", "", self._at(now, is_in[which])
        if ego is not None:
            yield (
                "ego",
                "",
                self._at(now, _meets_ego(one.poses[now], size, ego, self._times_ns[now])),
            )
        if others:
            yield from self._pairs(one, others)

    def _pairs(
        self, one: _Sampled, others: Sequence[_Sampled]
    ) -> Iterator[tuple[Cause, str, Bool[np.ndarray, " t"]]]:
        """Yield the actors whose boxes overlap that of another one, and when."""
        away = np.stack([other.poses[:, :3, 3] for other in others]) - one.poses[:, :3, 3]
        reach = np.array([other.reach_m for other in others]) + one.reach_m
        is_near = np.linalg.norm(away, axis=2) <= reach[:, None]
        is_near &= np.stack([other.is_present for other in others]) & one.is_present
        for k in np.flatnonzero(is_near.any(axis=1)).tolist():
            other, now = others[k], np.flatnonzero(is_near[k])
            is_overlap = boxes_overlap(
                one.poses[now],
                one.track.size_lwh_m,
                other.poses[now],
                other.track.size_lwh_m,
            )
            yield "actor", other.track.actor_id, self._at(now, is_overlap)

    def _at(self, now: np.ndarray, holds: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " t"]:
        """Expand values at some of the times to all times."""
        everywhere = np.zeros(len(self._times_ns), dtype=bool)
        everywhere[now] = holds
        return everywhere


@dataclass(frozen=True, eq=False)
class _Sampled:
    """Poses of an actor at the times of a search; while absent, it has the pose of the nearest
    end."""

    track: ActorTrack
    is_present: Bool[np.ndarray, " t"]
    poses: Float64[np.ndarray, "t 4 4"]
    reach_m: float

    @classmethod
    def of(cls, track: ActorTrack, times_ns: np.ndarray) -> _Sampled:
        """Sample a track."""
        is_present = np.array([track.is_present(int(t)) for t in times_ns], dtype=bool)
        path = track.trajectory
        if (path.matrices == path.matrices[0]).all():
            # A standing actor needs no interpolation.
            poses = np.repeat(path.matrices[:1].astype(np.float64), len(times_ns), axis=0)
        else:
            poses = path.held_at(times_ns)
        return cls(track, is_present, poses, float(np.linalg.norm(track.size_lwh_m)) / 2)


def _meets_ego(
    poses: Float64[np.ndarray, "n 4 4"],
    size: Float[np.ndarray, "3"],
    ego: Trajectory,
    times_ns: np.ndarray,
) -> Bool[np.ndarray, " n"]:
    """Test for overlap with the ego vehicle's box.

    It has the height of the other box, because the height of the ego frame differs between logs.
    """
    ego_poses = ego.held_at(times_ns).copy()
    ego_poses[:, 2, 3] = poses[:, 2, 3]
    return boxes_overlap(poses, size, ego_poses, EGO_BODY[1])


def boxes_overlap(
    a_poses: Float[np.ndarray, "n 4 4"],
    a_size: Float[np.ndarray, "3"],
    b_poses: Float[np.ndarray, "n 4 4"],
    b_size: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, " n"]:
    """Test whether two boxes overlap by more than touching labels do, for n pairs of poses.

    Method of separating axes (Gottschalk, Lin & Manocha 1996, doi:10.1145/237170.237244): two boxes
    are apart if their projections onto a face normal or a cross product of two edges are.

    Args:
        a_poses, b_poses: world_from_actor of the boxes.
        a_size, b_size: (length, width, height) in metres.
    """
    between = b_poses[:, :3, 3] - a_poses[:, :3, 3]
    # Rows are directions of edges.
    a_edges, b_edges = (np.swapaxes(p[:, :3, :3], 1, 2) for p in (a_poses, b_poses))
    products = np.cross(a_edges[:, :, None], b_edges[:, None]).reshape(-1, 9, 3)
    length = np.linalg.norm(products, axis=2, keepdims=True)
    is_axis = np.concatenate(
        [np.ones((len(between), 6), dtype=bool), length[..., 0] > _PARALLEL], 1
    )
    products = products / np.where(length > _PARALLEL, length, 1.0)
    axes = np.concatenate([a_edges, b_edges, products], axis=1)
    reach = sum(
        np.abs(np.einsum("nac,nec->nae", axes, edges)) @ (size / 2)
        for edges, size in ((a_edges, a_size), (b_edges, b_size))
    )
    apart = np.abs(np.einsum("nac,nc->na", axes, between)) >= reach - _TOUCH_M
    return ~(apart & is_axis).any(axis=1)


def cuts_static(
    background: RayCaster, poses: Float[np.ndarray, "n 4 4"], size: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, " n"]:
    """Test whether static surface lies within a box, above what wheels roll over, at n poses.

    Rays run through the box along its length and across it, from side to side.

    Args:
        poses: world_from_actor.
        size: (length, width, height) in metres.
    """
    size = np.maximum(size - 2 * _TOUCH_M, 0.02)
    low = -size[2] / 2 + _KERB_M
    is_cut = np.zeros(len(poses), dtype=bool)
    if low > size[2] / 2:
        return is_cut
    height = np.linspace(low, size[2] / 2, _GRID)
    for along, across in ((0, 1), (1, 0)):
        starts = _face_points(along, size, height, np.linspace(-0.5, 0.5, _GRID) * size[across])
        starts = starts @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
        directions = np.broadcast_to(poses[:, None, :3, along], starts.shape)
        hits = background.intersect(starts.reshape(-1, 3), directions.reshape(-1, 3))
        is_cut |= (hits.distance_m.reshape(len(poses), -1) < size[along]).any(axis=1)
    return is_cut


def _face_points(
    along: int,
    size: Float[np.ndarray, "3"],
    height: Float[np.ndarray, " n"],
    sideways: Float[np.ndarray, " n"],
) -> Float64[np.ndarray, "_ 3"]:
    """Return a grid of points on the rear face (along = 0) or the right face (1), frame `actor`."""
    points = np.empty((len(height) * len(sideways), 3))
    points[:, along] = -size[along] / 2
    points[:, 1 - along] = np.repeat(sideways, len(height))
    points[:, 2] = np.tile(height, len(sideways))
    return points
