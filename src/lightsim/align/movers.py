"""Boxes of moving vehicles: smooth tracks, corrected so that the returns of all sweeps agree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import make_smoothing_spline
from scipy.spatial import KDTree

from lightsim.align.config import HELD_BACK, AlignConfig
from lightsim.align.path import MotionPrior, PathFit, align_returns, zero_correction
from lightsim.align.planes import Cloud, is_sampled
from lightsim.align.tracks import TrackFit
from lightsim.core.actors import ActorTrack
from lightsim.core.alignment import PathCorrection
from lightsim.core.frames import Trajectory

# Standard deviation of a label's position, in metres. Labels of log 002 slide along a vehicle by up
# to half a metre in a sawtooth of four or five sweeps: as labelled, four of its cars accelerate by
# 18 to 51 m/s2 (rms), others by less than 6 (no script repeats this).
_LABEL_SLIDE_M = 0.2
# Spectral density of acceleration, m2/s3: 1.5 m/s2 for about one second, as in ordinary traffic.
_ACCELERATION_DENSITY = 2 * 1.5**2
# Fewest poses for a smoothing spline.
_LEAST_POSES = 5
# Returns of each sweep in the test of the smooth track; bounds the time.
_COMPARED_PER_SWEEP = 200
# Distance at which the nearest return of another sweep is clipped: it is on another part.
_FAR_M = 0.5
# Fewest returns of an actor for a fit. Sensitivity not measured.
_LEAST_RETURNS = 400
# Fewest sweeps with returns of an actor for a fit. Sensitivity not measured.
_LEAST_SWEEPS = 4
# Prior on label errors. They slide along a vehicle (x) more than across, and the errors of
# neighbouring labels are nearly independent, hence the large differences between knots.
_LABEL_PRIOR = MotionPrior(
    (0.2, 0.2, 1.5), (0.15, 0.1, 0.05), (3.0, 3.0, 3.0), (0.2, 0.2, 0.2), 0.12
)


def settle_moving(
    actors: tuple[ActorTrack, ...],
    returns: Mapping[str, Cloud],
    path: PathCorrection | None,
    config: AlignConfig,
    rng: np.random.Generator,
) -> list[TrackFit]:
    """Return corrected poses of every moving vehicle whose returns agree better with them.

    A smooth track replaces the labels if it reduces the distances between the sweeps' returns.
    Point-to-plane matching then corrects the track and is accepted by a random quarter of the
    returns. If only one side of a vehicle was observed, an error along that side remains.

    Args:
        returns: returns inside each actor's box by actor id, frame `world`, as recorded.
        path: correction of the ego path, which moves boxes and returns alike.
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
    """Return the mean distance of returns to the nearest return of another sweep, in metres.

    Unlike the distance from planes it grows if a sweep slides along a surface, at the surface's
    edges and ends.
    """
    apart = []
    for number in np.unique(cloud.sweep):
        is_own = cloud.sweep == number
        others = KDTree(cloud.points_world[~is_own])
        apart.append(others.query(cloud.points_world[is_own])[0])
    return float(np.minimum(np.concatenate(apart), _FAR_M).mean())


def drivable(trajectory: Trajectory) -> Trajectory:
    """Smooth the positions of a track; its rotations are unchanged.

    A cubic smoothing spline is the most likely path if label errors and acceleration are white
    noise (Wahba 1978, doi:10.1111/j.2517-6161.1978.tb01050.x).
    """
    seconds = (trajectory.times_ns - trajectory.start_ns) / 1e9
    matrices = trajectory.matrices.copy()
    for axis in range(3):
        spline = make_smoothing_spline(
            seconds, matrices[:, axis, 3], lam=_LABEL_SLIDE_M**2 / _ACCELERATION_DENSITY
        )
        matrices[:, axis, 3] = spline(seconds)
    return replace(trajectory, matrices=matrices)


def _fitted(cloud: Cloud, config: AlignConfig, rng: np.random.Generator) -> PathFit:
    """Fit the correction of one box, with a random quarter of its returns held back."""
    is_held_back = rng.random(len(cloud.sweep)) < 1.0 / HELD_BACK
    # Finer than the static map, since vehicles are small. The least gain is higher, since held-back
    # returns are of the fitted sweeps and so improve by overfitting, too.
    fine = replace(config, plane_voxel_m=0.15, points_per_sweep=1500, least_gain=0.15)
    zero = zero_correction(cloud, np.zeros(3))
    return align_returns(cloud, is_held_back, zero, _LABEL_PRIOR, fine, rng)


def _in_box(cloud: Cloud, actor: ActorTrack) -> Cloud:
    """Return the cloud in frame `actor`, each return by the pose at its own time."""
    trajectory = actor.trajectory
    is_labelled = (cloud.times_ns >= trajectory.start_ns) & (cloud.times_ns <= trajectory.end_ns)
    cloud = cloud.rows(is_labelled)
    return replace(cloud, points_world=trajectory.to_src(cloud.points_world, cloud.times_ns))


def _moved(actor: ActorTrack, path: PathCorrection) -> ActorTrack:
    """Return the actor after the correction of the ego path."""
    trajectory = actor.trajectory
    moves = np.stack([path.at(int(t)).matrix for t in trajectory.times_ns])
    return replace(actor, trajectory=replace(trajectory, matrices=moves @ trajectory.matrices))


def _corrected(labelled: ActorTrack, rolled: ActorTrack, fit: PathFit | None) -> TrackFit:
    """Return the corrected pose at every label, world_from_rolled @ inv(true_from_labelled)."""
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
