"""What cannot be in a street: two actors in one place, one through a wall, one where nothing is.

Only edited actors are looked at: boxes of a recording may touch as they were labelled.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float, Float64

from lightsim.core.actors import ActorTrack
from lightsim.core.casting import RayCaster
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.scenario.ground import StandingGround

# Boxes that interpenetrate by less touch as labelled boxes do.
_TOUCH_M = 0.1
# Kerbs, and the roughness of a measured road, reach this high into a box that stands there.
_KERB_M = 0.35
# Rays over the box, so many along each axis: a pole of 0.3 m between them is not missed by much.
_GRID = 6


def find_conflicts(
    scenario: Scenario, edited: Sequence[ActorTrack], ground: StandingGround
) -> tuple[str, ...]:
    """One line for each pair that is in conflict, with the first and last frame of it.

    Args:
        edited: tracks that differ from the log.
    """
    frames = sorted({f.time_ns: f for f in scenario.frames}.values(), key=lambda f: f.time_ns)
    found: dict[str, list[CameraFrame]] = {}
    for frame in frames:
        for words in _at(scenario, edited, ground, frame.time_ns):
            found.setdefault(words, []).append(frame)
    return tuple(f"{words}: {_frames(seen)}" for words, seen in found.items())


def _frames(seen: Sequence[CameraFrame]) -> str:
    stems = list(dict.fromkeys(f.stem for f in seen))
    return f"frame {stems[0]}" if len(stems) == 1 else f"frames {stems[0]} to {stems[-1]}"


def _at(
    scenario: Scenario, edited: Sequence[ActorTrack], ground: StandingGround, time_ns: int
) -> Iterable[str]:
    there = scenario.tracks_at(time_ns)
    names = {track.actor_id for track in edited}
    for number, track in enumerate(there):
        if track.actor_id not in names:
            continue
        if not ground.is_known(track.world_from_actor(time_ns).translation_m[None, :2])[0]:
            yield f"'{track.actor_id}' is off the reconstructed ground"
        if ground.background is not None and is_cut(ground.background, track, time_ns):
            yield f"'{track.actor_id}' stands in a wall or another fixed thing"
        for k, other in enumerate(there):
            # Of two edited actors the pair is told once.
            if k == number or (other.actor_id in names and k < number):
                continue
            if boxes_overlap(track, other, time_ns):
                yield f"'{track.actor_id}' and '{other.actor_id}' are in one place"


def boxes_overlap(a: ActorTrack, b: ActorTrack, time_ns: int) -> bool:
    """Whether the boxes of two actors share more than touching labels do.

    By separating axes (Gottschalk, Lin & Manocha 1996, doi:10.1145/237170.237244): two boxes are
    apart where their shadows on a face normal or on a product of two edges are.
    """
    now_ns = np.array([time_ns])
    places = [track.trajectory.held_positions_m(now_ns)[0] for track in (a, b)]
    reach_m = float(sum(np.linalg.norm(track.size_lwh_m) for track in (a, b))) / 2
    if np.linalg.norm(places[1] - places[0]) > reach_m:
        # Most of a street: turns need not be known.
        return False
    poses = [track.world_from_actor(time_ns) for track in (a, b)]
    halves = [track.size_lwh_m / 2 for track in (a, b)]
    between = poses[1].translation_m - poses[0].translation_m
    edges = [pose.rotation.T for pose in poses]
    products = np.cross(edges[0][:, None], edges[1][None]).reshape(-1, 3)
    length = np.linalg.norm(products, axis=1)
    axes = np.concatenate([*edges, products[length > 1e-6] / length[length > 1e-6, None]])
    reach = sum(np.abs(axes @ e.T) @ h for e, h in zip(edges, halves, strict=True))
    return bool((np.abs(axes @ between) < reach - _TOUCH_M).all())


def is_cut(background: RayCaster, track: ActorTrack, time_ns: int) -> bool:
    """Whether static surface lies within an actor's box, above what wheels roll over.

    Rays run through the box along its length and across it, from side to side.
    """
    pose = track.world_from_actor(time_ns)
    size = np.maximum(track.size_lwh_m - 2 * _TOUCH_M, 0.02)
    low = -size[2] / 2 + _KERB_M
    if low > size[2] / 2:
        return False
    height = np.linspace(low, size[2] / 2, _GRID)
    for along, across in ((0, 1), (1, 0)):
        starts = _face_points(along, size, height, np.linspace(-0.5, 0.5, _GRID) * size[across])
        direction = np.zeros_like(starts)
        direction[:, along] = 1.0
        hits = background.intersect(pose.apply(starts), pose.rotate(direction))
        if bool((hits.distance_m < size[along]).any()):
            return True
    return False


def _face_points(
    along: int,
    size: Float[np.ndarray, "3"],
    height: Float[np.ndarray, " n"],
    sideways: Float[np.ndarray, " n"],
) -> Float64[np.ndarray, "_ 3"]:
    """A grid on the rear face (along = 0) or the right one (1), frame `actor`."""
    points = np.empty((len(height) * len(sideways), 3))
    points[:, along] = -size[along] / 2
    points[:, 1 - along] = np.repeat(sideways, len(height))
    points[:, 2] = np.tile(height, len(sideways))
    return points
