"""Boxes of parked actors: one constant pose replaces labels that jitter from sweep to sweep."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from lightsim.core.actors import ActorTrack
from lightsim.core.alignment import PathCorrection

# Largest distance of a label from the median position; an actor that moves farther is not parked.
# Labels of log 002 jitter by 2.7 cm rms (docs/decisions/0004-alignment-stage.md).
_LARGEST_MOVE_M = 0.3
# Fewest labels of an actor. Sensitivity not measured.
_LEAST_POSES = 3


@dataclass(frozen=True, eq=False)
class TrackFit:
    """Corrected poses `world_from_actor` of one actor, and the RMS correction of its box."""

    actor_id: str
    matrices: Float64[np.ndarray, "n 4 4"]
    shift_rms_m: float
    yaw_rms_deg: float


def settle_parked(actors: tuple[ActorTrack, ...], path: PathCorrection | None) -> list[TrackFit]:
    """Return one constant pose, after the path's correction, for every parked rigid actor.

    Persons, animals, moving actors and boxes that move by more than 0.3 m stay as labelled.
    """
    fits: list[TrackFit] = []
    for actor in actors:
        poses = actor.trajectory.matrices
        positions = actor.trajectory.positions_m
        move_m = float(np.linalg.norm(positions - np.median(positions, axis=0), axis=1).max())
        is_parked = actor.kind.is_rigid_body and not actor.is_moving
        if not is_parked or len(poses) < _LEAST_POSES or move_m > _LARGEST_MOVE_M:
            continue
        if path is not None:
            moves = [path.at(int(t)).matrix for t in actor.trajectory.times_ns]
            poses = np.stack(moves) @ poses
        fits.append(_settled(actor.actor_id, poses))
    return fits


def _settled(actor_id: str, poses: Float64[np.ndarray, "n 4 4"]) -> TrackFit:
    """Return the median position and mean rotation of all poses, at each of their times."""
    centre = np.median(poses[:, :3, 3], axis=0)
    # The rotation nearest to the mean matrix; the determinant excludes reflections.
    u, _, vt = np.linalg.svd(poses[:, :3, :3].mean(axis=0))
    pose = np.eye(4)
    pose[:3, :3] = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt
    pose[:3, 3] = centre
    shift = np.linalg.norm(poses[:, :3, 3] - centre, axis=1)
    turned = poses[:, :3, 0] @ pose[:3, :2]
    yaw = np.degrees(np.arctan2(turned[:, 1], turned[:, 0]))
    return TrackFit(
        actor_id,
        np.tile(pose, (len(poses), 1, 1)),
        float(np.sqrt(np.mean(shift**2))),
        float(np.sqrt(np.mean(yaw**2))),
    )
