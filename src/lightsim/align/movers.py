"""Boxes of moving vehicles: on a path that a vehicle can drive, and placed so that the returns of
all sweeps agree on one shape."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import make_smoothing_spline
from scipy.spatial import KDTree

from lightsim.align.config import HELD_BACK, AlignConfig
from lightsim.align.path import PathFit, Wander, align_returns, still_correction
from lightsim.align.planes import Cloud, is_sampled
from lightsim.align.tracks import TrackFit
from lightsim.core.actors import ActorTrack
from lightsim.core.alignment import PathCorrection
from lightsim.core.frames import Trajectory

# Labels of log 002 slide along a vehicle by up to half a metre in a sawtooth of four or five
# sweeps: as labelled, four of its cars brake and speed up by 18 to 51 m/s2 (rms), others by less
# than 6.
_LABEL_SLIDE_M = 0.2
# Vehicles in traffic: 1.5 m/s2, for about a second.
_ACCELERATION_M_S2, _ACCELERATING_S = 1.5, 1.0
_LEAST_POSES = 5
"""That a smoothing spline needs."""
_COMPARED_PER_SWEEP = 200
_FAR_M = 0.5
"""Farther returns of other sweeps are of another part of the vehicle."""
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

    First a path that a vehicle can drive along the labels takes their place, if the sweeps lie
    nearer to each other with it. Of what is then fitted to returns, a random quarter of them
    judges. Where one side alone was seen, the slide along it stays as it is.

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
        local = _in_box(cloud, actor)
        if len(local.sweep) < _LEAST_RETURNS or len(np.unique(local.sweep)) < _LEAST_SWEEPS:
            continue
        rolled = actor
        if len(actor.trajectory) >= _LEAST_POSES:
            smooth = replace(actor, trajectory=drivable(actor.trajectory))
            smoothed = _in_box(cloud, smooth)
            compared = is_sampled(local.sweep, _COMPARED_PER_SWEEP, rng)
            if _apart_m(smoothed.rows(compared)) < _apart_m(local.rows(compared)):
                rolled, local = smooth, smoothed
        fit = _fitted(local, config, rng)
        if fit.is_kept or rolled is not actor:
            fits.append(_corrected(actor, rolled, fit if fit.is_kept else None))
    return fits


def _apart_m(cloud: Cloud) -> float:
    """Mean distance of returns to the nearest one of another sweep. Unlike distances from planes it
    tells how far sweeps slid along a surface, by its edges and ends."""
    apart = []
    for number in np.unique(cloud.sweep):
        is_own = cloud.sweep == number
        others = KDTree(cloud.points_world[~is_own])
        apart.append(others.query(cloud.points_world[is_own])[0])
    return float(np.minimum(np.concatenate(apart), _FAR_M).mean())


def drivable(trajectory: Trajectory) -> Trajectory:
    """The positions of a track as a vehicle can have driven them; its rotations are kept.

    The most likely path where labels err by white noise and acceleration is white noise: a cubic
    smoothing spline (Wahba 1978, doi:10.1111/j.2517-6161.1978.tb01050.x).
    """
    seconds = (trajectory.times_ns - trajectory.start_ns) / 1e9
    density = 2 * _ACCELERATION_M_S2**2 * _ACCELERATING_S
    matrices = trajectory.matrices.copy()
    for axis in range(3):
        spline = make_smoothing_spline(
            seconds, matrices[:, axis, 3], lam=_LABEL_SLIDE_M**2 / density
        )
        matrices[:, axis, 3] = spline(seconds)
    return replace(trajectory, matrices=matrices)


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


def _corrected(labelled: ActorTrack, rolled: ActorTrack, fit: PathFit | None) -> TrackFit:
    """world_from_actor x (recorded from true actor) at every label."""
    times, was = labelled.trajectory.times_ns, labelled.trajectory.matrices
    matrices: Float64[np.ndarray, "n 4 4"] = rolled.trajectory.matrices
    if fit is not None:
        true_from_labelled = np.stack([fit.correction.at(int(t)).matrix for t in times])
        matrices = matrices @ np.linalg.inv(true_from_labelled)
    moved = matrices[:, :3, 3] - was[:, :3, 3]
    ahead = np.einsum("nji,nj->ni", was[:, :3, :3], matrices[:, :3, 0])
    yaw_deg = np.degrees(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return TrackFit(
        labelled.actor_id,
        matrices,
        float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))),
        float(np.sqrt(np.mean(yaw_deg**2))),
    )
