"""How what was located sweep by sweep wanders, by the agreement of all sweeps.

For the ego's path the sweeps of the whole street are compared in frame `world`; for a moving actor
the returns inside its box, in its own frame (movers.py). The distance is that of point to plane
(Chen & Medioni 1992, doi:10.1016/0262-8856(92)90066-C).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import KDTree

from lightsim.align.config import HELD_BACK, AlignConfig
from lightsim.align.planes import (
    Cloud,
    Matches,
    first_of_voxels,
    is_sampled,
    match_planes,
    robust_weights,
)
from lightsim.core.alignment import PathCorrection
from lightsim.core.frames import Trajectory

_KNOT_S = 0.1
_SCALE_M = 0.03
_NOISE_M = 0.02
_CORRELATED = 50.0
"""So many neighbouring returns are worth one independent measurement."""
_BATCH = 20_000


# Each part as a whole is measured (docs/decisions/0004-alignment-stage.md), none of these alone.

# Rounds of matching and solving for the path.
_PATH_ROUNDS = 3
# Expected size of a correction of the path (one standard deviation).
_PATH_SHIFT_M = 0.05
# The same for its rotation.
_PATH_ROTATION_DEG = 0.1


@dataclass(frozen=True)
class Wander:
    """What is expected of a correction, one standard deviation for each axis of its frame.

    Args:
        turns_deg: rotation at a knot.
        shifts_m: shift at a knot.
        turn_changes_deg: second differences of the rotation between knots.
        shift_changes_m: second differences of the shift.
        flat_m: deviation of returns from a plane before they are corrected.
    """

    turns_deg: tuple[float, float, float]
    shifts_m: tuple[float, float, float]
    turn_changes_deg: float
    shift_changes_m: float
    flat_m: float


@dataclass(frozen=True, eq=False)
class PathFit:
    """The correction and the held-back returns' median distance from the map's planes."""

    correction: PathCorrection
    residual_before_m: float
    residual_after_m: float
    is_kept: bool

    @property
    def shifts_m(self) -> Float64[np.ndarray, " n"]:
        """How far the correction moves the path at each of its knots."""
        return np.linalg.norm(self.correction.shifts_m, axis=1)

    @property
    def turns_deg(self) -> Float64[np.ndarray, " n"]:
        """By what angle the correction turns the path at each of its knots."""
        return np.degrees(np.linalg.norm(self.correction.rotations_rad, axis=1))


def align_path(
    cloud: Cloud, ego: Trajectory, config: AlignConfig, rng: np.random.Generator
) -> PathFit:
    """Correct the path by the sweeps; every `config.held_back`-th sweep only judges."""
    is_judge = cloud.sweep % HELD_BACK == HELD_BACK // 2
    still = still_correction(cloud, ego.positions_m.mean(axis=0))
    # The size is expected of the path as a whole, not of each knot.
    whole = float(np.sqrt(len(still.times_ns)))
    turn_deg, shift_m = _PATH_ROTATION_DEG * whole, _PATH_SHIFT_M * whole
    wander = Wander((turn_deg, turn_deg, turn_deg), (shift_m, shift_m, shift_m), 0.01, 0.01, 0.05)
    return align_returns(cloud, is_judge, still, wander, config, rng)


def align_returns(
    cloud: Cloud,
    is_judge: Bool[np.ndarray, " n"],
    still: PathCorrection,
    wander: Wander,
    config: AlignConfig,
    rng: np.random.Generator,
) -> PathFit:
    """Correct what wanders by the agreement of the sweeps.

    All knots are solved for at once, both ends of each match moving: a sweep may not simply
    follow a map that is as wrong as itself.

    Args:
        cloud: returns in a frame in which the scene should stand still.
        is_judge: returns that shape nothing; the correction is kept if they agree better with it.
        still: knots and pivot of the correction, all zero.
        wander: how large corrections may be.
    """
    fitted, judging = cloud.rows(~is_judge), cloud.rows(is_judge)
    asked = fitted.rows(is_sampled(fitted.sweep, config.points_per_sweep, rng))
    reference = _thinned(fitted, config.plane_voxel_m, rng)
    judging = judging.rows(is_sampled(judging.sweep, config.points_per_sweep, rng))
    correction = still
    before = held_back_residual_m(judging, reference, correction, wander.flat_m)
    for _ in range(_PATH_ROUNDS):
        correction = _solved(correction, asked, reference, wander)
    after = held_back_residual_m(judging, reference, correction, wander.flat_m)
    return PathFit(correction, before, after, after < before * (1.0 - config.least_gain))


def held_back_residual_m(
    judging: Cloud, reference: Cloud, correction: PathCorrection, flat_m: float
) -> float:
    """Median distance of returns from the planes of a map of other sweeps."""
    reference = _moved(reference, correction)
    tree = KDTree(reference.points_world)
    matches = match_planes(_moved(judging, correction), reference, tree, flat_m)
    return float(np.median(np.abs(matches.residuals_m))) if len(matches.rows) else float("nan")


def still_correction(cloud: Cloud, pivot: Float64[np.ndarray, "3"]) -> PathCorrection:
    """Knots over the time of the returns, with no correction yet."""
    start, end = int(cloud.times_ns.min()), int(cloud.times_ns.max())
    count = max(2, int(np.ceil((end - start) * 1e-9 / _KNOT_S)) + 1)
    times = np.linspace(start, end, count).astype(np.int64)
    zero = np.zeros((count, 3))
    return PathCorrection(times, pivot, zero, zero.copy())


def _thinned(cloud: Cloud, voxel_m: float, rng: np.random.Generator) -> Cloud:
    """One return in each voxel, of whichever sweep: neighbours then span a stretch of surface."""
    order = rng.permutation(len(cloud.sweep))
    return cloud.rows(order[first_of_voxels(cloud.points_world[order], voxel_m)])


def _moved(cloud: Cloud, correction: PathCorrection) -> Cloud:
    points = correction.transformed(cloud.points_world, cloud.times_ns)
    return Cloud(points, cloud.times_ns, cloud.sweep)


def _solved(
    correction: PathCorrection, asked: Cloud, reference: Cloud, wander: Wander
) -> PathCorrection:
    """One Gauss-Newton step with the priors; information of dense returns is discounted."""
    asked, reference = _moved(asked, correction), _moved(reference, correction)
    matches = match_planes(asked, reference, KDTree(reference.points_world), wander.flat_m)
    count = len(correction.times_ns)
    weights = robust_weights(matches.residuals_m, _SCALE_M) / (_NOISE_M**2 * _CORRELATED)
    hessian, gradient = np.zeros((count * 6, count * 6)), np.zeros(count * 6)
    for start in range(0, len(matches.rows), _BATCH):
        part = slice(start, start + _BATCH)
        rows = _jacobian(correction, asked, reference, matches, part)
        weighted = rows * weights[part, None].astype(np.float32)
        hessian += weighted.T @ rows
        gradient += weighted.T @ matches.residuals_m[part].astype(np.float32)
    state = np.concatenate([correction.rotations_rad, correction.shifts_m], axis=1).ravel()
    prior = _prior(count, wander)
    step = np.linalg.solve(hessian + prior, -(gradient + prior @ state))
    found = (state + step).reshape(count, 6)
    return PathCorrection(
        correction.times_ns, correction.pivot_world, found[:, :3].copy(), found[:, 3:].copy()
    )


def _jacobian(
    correction: PathCorrection, asked: Cloud, reference: Cloud, matches: Matches, part: slice
) -> np.ndarray:
    """Change of each residual with the knots: its return's minus the mean of its neighbours'."""
    normals, near = matches.normals[part], matches.neighbours[part]
    rows = np.zeros((len(normals), len(correction.times_ns), 6), dtype=np.float32)
    weight = (near >= 0) / (near >= 0).sum(axis=1, keepdims=True)
    own = asked.rows(matches.rows[part])
    _add_motion(rows, correction, own, normals, np.ones(len(normals)))
    for k in range(near.shape[1]):
        _add_motion(rows, correction, reference.rows(near[:, k]), normals, -weight[:, k])
    return rows.reshape(len(normals), -1)


def _add_motion(
    rows: np.ndarray,
    correction: PathCorrection,
    points: Cloud,
    normals: Float64[np.ndarray, "n 3"],
    weight: Float64[np.ndarray, " n"],
) -> None:
    """Add how `weight` of points moves along the normals with the two knots around their time."""
    spacing = float(correction.times_ns[1] - correction.times_ns[0])
    place = (points.times_ns - correction.times_ns[0]) / spacing
    last = len(correction.times_ns) - 2
    knot = np.clip(np.floor(place), 0, last).astype(np.int64)
    fraction = np.clip(place - knot, 0.0, 1.0)
    turn = np.cross(points.points_world - correction.pivot_world, normals)
    motion = np.concatenate([turn, normals], axis=1) * weight[:, None]
    index = np.arange(len(rows))
    rows[index, knot] += motion * (1.0 - fraction)[:, None]
    rows[index, knot + 1] += motion * fraction[:, None]


def _prior(count: int, wander: Wander) -> Float64[np.ndarray, "m m"]:
    """Information of the expected size and smoothness, for knots of (rotation, shift)."""
    size = np.concatenate([np.radians(wander.turns_deg), wander.shifts_m])
    changes = [np.radians(wander.turn_changes_deg)] * 3 + [wander.shift_changes_m] * 3
    second = np.zeros((max(count - 2, 0), count))
    for i in range(len(second)):
        second[i, i : i + 3] = (1.0, -2.0, 1.0)
    return np.kron(np.eye(count), np.diag(size**-2.0)) + np.kron(
        second.T @ second, np.diag(np.array(changes) ** -2.0)
    )
