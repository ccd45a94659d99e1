"""Boxes of moving vehicles: placed so that the returns of all sweeps agree on one shape."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from lightsim.align.config import HELD_BACK, AlignConfig
from lightsim.align.path import PathFit, Wander, align_returns, still_correction
from lightsim.align.planes import Cloud
from lightsim.align.tracks import TrackFit
from lightsim.core.actors import ActorTrack
from lightsim.core.alignment import PathCorrection

_LEAST_RETURNS = 400
_LEAST_SWEEPS = 4
_RETURNS_PER_SWEEP = 1500
_VOXEL_M = 0.15
_LEAST_GAIN = 0.15
_TICK_NS = 500_000
"""Returns of half a millisecond share a pose: half a centimetre at 20 m/s."""
_JITTER = Wander((0.2, 0.2, 1.5), (0.15, 0.1, 0.05), 3.0, 0.2, 0.12)
"""Labels slide along a vehicle more than across; errors of neighbouring labels differ freely."""


def settle_moving(
    actors: tuple[ActorTrack, ...],
    returns: Mapping[str, Cloud],
    path: PathCorrection | None,
    config: AlignConfig,
    rng: np.random.Generator,
) -> list[TrackFit]:
    """Corrected poses of every moving vehicle whose held-back returns agree better with them.

    A random quarter of the returns judges. Where one side alone was seen, the slide along it
    stays as labelled.

    Args:
        returns: of each actor, frame `world` as recorded.
        path: the ego's correction, which moves boxes and returns alike.
    """
    fits: list[TrackFit] = []
    for actor in actors:
        cloud = returns.get(actor.actor_id)
        if not actor.is_moving or not actor.kind.is_rigid_body or cloud is None:
            continue
        if path is not None:
            actor = _moved(actor, path)
            cloud = replace(
                cloud, points_world=path.transformed(cloud.points_world, cloud.times_ns)
            )
        cloud = _in_box(cloud, actor)
        if len(cloud.sweep) < _LEAST_RETURNS or len(np.unique(cloud.sweep)) < _LEAST_SWEEPS:
            continue
        fit = _fitted(cloud, config, rng)
        if fit.is_kept:
            fits.append(_corrected(actor, fit))
    return fits


def _fitted(cloud: Cloud, config: AlignConfig, rng: np.random.Generator) -> PathFit:
    is_judge = rng.random(len(cloud.sweep)) < 1.0 / HELD_BACK
    fine = replace(
        config,
        plane_voxel_m=_VOXEL_M,
        points_per_sweep=_RETURNS_PER_SWEEP,
        least_gain=_LEAST_GAIN,
    )
    still = still_correction(cloud, np.zeros(3))
    return align_returns(cloud, is_judge, still, _JITTER, fine, rng)


def _in_box(cloud: Cloud, actor: ActorTrack) -> Cloud:
    """Returns in the actor's frame, each by the pose of the moment it was measured."""
    trajectory = actor.trajectory
    is_labelled = (cloud.times_ns >= trajectory.start_ns) & (cloud.times_ns <= trajectory.end_ns)
    cloud = cloud.rows(is_labelled)
    points = np.empty_like(cloud.points_world)
    ticks = cloud.times_ns // _TICK_NS
    for tick in np.unique(ticks):
        rows = ticks == tick
        pose = trajectory.at(int(cloud.times_ns[rows][0]))
        points[rows] = pose.inverse().apply(cloud.points_world[rows])
    return replace(cloud, points_world=points)


def _moved(actor: ActorTrack, path: PathCorrection) -> ActorTrack:
    trajectory = actor.trajectory
    moves = np.stack([path.at(int(t)).matrix for t in trajectory.times_ns])
    return replace(actor, trajectory=replace(trajectory, matrices=moves @ trajectory.matrices))


def _corrected(actor: ActorTrack, fit: PathFit) -> TrackFit:
    """world_from_actor x (recorded from true actor) at every label."""
    times = actor.trajectory.times_ns
    true_from_labelled = np.stack([fit.correction.at(int(t)).matrix for t in times])
    matrices: Float64[np.ndarray, "n 4 4"] = actor.trajectory.matrices @ np.linalg.inv(
        true_from_labelled
    )
    moved = matrices[:, :3, 3] - actor.trajectory.matrices[:, :3, 3]
    yaw_deg = np.degrees(np.arctan2(true_from_labelled[:, 1, 0], true_from_labelled[:, 0, 0]))
    return TrackFit(
        actor.actor_id,
        matrices,
        float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))),
        float(np.sqrt(np.mean(yaw_deg**2))),
    )
