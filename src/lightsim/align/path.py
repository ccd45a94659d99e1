"""Correction of a path by the agreement of all sweeps, by point-to-plane distances.

For the ego path, static returns are compared in frame `world`; for a moving actor, the returns
inside its box in frame `actor` (movers.py). Method: Chen & Medioni 1992,
doi:10.1016/0262-8856(92)90066-C.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import KDTree

from lightsim.align.config import HELD_BACK, AlignConfig
from lightsim.align.planes import (
    BATCH,
    Cloud,
    Matches,
    first_of_voxels,
    is_sampled,
    match_planes,
    robust_weights,
)
from lightsim.core.alignment import PathCorrection
from lightsim.core.frames import Trajectory

# The correction of the path is measured as a whole (docs/decisions/0004-alignment-stage.md), these
# constants are not.

# Time between knots of the correction, in seconds: one sweep at 10 Hz.
_KNOT_S = 0.1
# Scale of the Cauchy loss, in metres.
_SCALE_M = 0.03
# Variance of a residual, m2: noise of 2 cm, times 50 neighbouring returns whose errors are
# correlated and count as one measurement.
_VARIANCE_M2 = 0.02**2 * 50.0
# Rounds of matching and solving.
_PATH_ROUNDS = 3


@dataclass(frozen=True)
class MotionPrior:
    """Standard deviations of a correction, and the flatness of the planes it is estimated from.

    Args:
        turns_deg: rotation at a knot, about each axis of the frame.
        shifts_m: shift at a knot, along each axis.
        turn_changes_deg: second differences of the rotation between knots, about each axis.
        shift_changes_m: second differences of the shift, along each axis.
        flat_m: largest deviation of uncorrected returns from a plane.
        coarse_flat_m: the same in rounds that precede the others, for large errors.
    """

    turns_deg: tuple[float, float, float]
    shifts_m: tuple[float, float, float]
    turn_changes_deg: tuple[float, float, float]
    shift_changes_m: tuple[float, float, float]
    flat_m: float
    coarse_flat_m: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class PathFit:
    """Correction of a path, and the median distance of held-back returns from the map's planes."""

    correction: PathCorrection
    residual_before_m: float
    residual_after_m: float
    is_kept: bool

    @property
    def shifts_m(self) -> Float64[np.ndarray, " n"]:
        """Length of the correction's shift at each knot, in metres."""
        return np.linalg.norm(self.correction.shifts_m, axis=1)

    @property
    def turns_deg(self) -> Float64[np.ndarray, " n"]:
        """Angle of the correction's rotation at each knot, in degrees."""
        return np.degrees(np.linalg.norm(self.correction.rotations_rad, axis=1))


def align_path(
    cloud: Cloud,
    ego: Trajectory,
    config: AlignConfig,
    rng: np.random.Generator,
    *,
    has_heights: bool = True,
) -> PathFit:
    """Estimate the correction of the ego path; every `HELD_BACK`-th sweep only tests it.

    Args:
        has_heights: `DrivingLog.has_heights`; without them, height, pitch and roll are estimated
            in a wide range.
    """
    is_held_back = cloud.sweep % HELD_BACK == HELD_BACK // 2
    zero = zero_correction(cloud, ego.positions_m.mean(axis=0))
    # Standard deviations of 0.1 degrees and 5 cm are those of the path as a whole. A prior of equal
    # total information on n knots has sqrt(n) times these values at each knot.
    whole = float(np.sqrt(len(zero.times_ns)))
    turn_deg, shift_m = 0.1 * whole, 0.05 * whole
    if not has_heights:
        # A car pitches by about a degree, and hills raise it by metres. Heights also change by the
        # rotation about a distant pivot, hence their large second differences.
        prior = MotionPrior(
            (1.5 * whole, 1.5 * whole, turn_deg),
            (shift_m, shift_m, whole),
            (0.3, 0.3, 0.01),
            (0.02, 0.02, 0.3),
            0.05,
            (0.2, 0.1),
        )
    else:
        turns, shifts = (turn_deg, turn_deg, turn_deg), (shift_m, shift_m, shift_m)
        prior = MotionPrior(turns, shifts, (0.01, 0.01, 0.01), (0.01, 0.01, 0.01), 0.05)
    return align_returns(cloud, is_held_back, zero, prior, config, rng)


def align_returns(
    cloud: Cloud,
    is_held_back: Bool[np.ndarray, " n"],
    zero: PathCorrection,
    prior: MotionPrior,
    config: AlignConfig,
    rng: np.random.Generator,
) -> PathFit:
    """Estimate a correction that makes the returns of all sweeps agree.

    All knots are solved for at once, and both ends of each match move: a sweep must not be fitted
    to a map with the same errors as its own.

    Args:
        cloud: returns in a frame in which the surface is static.
        is_held_back: returns that only test the correction.
        zero: knots and pivot of the correction, all zero.
        prior: expected size and smoothness of the correction.
    """
    fitted, held_back = cloud.rows(~is_held_back), cloud.rows(is_held_back)
    compared = fitted.rows(is_sampled(fitted.sweep, config.points_per_sweep, rng))
    reference = _thinned(fitted, config.plane_voxel_m, rng)
    held_back = held_back.rows(is_sampled(held_back.sweep, config.points_per_sweep, rng))
    correction = zero
    before = _residual_m(held_back, reference, correction, prior.flat_m)
    rounds = [(flat_m, 0.5 * flat_m) for flat_m in prior.coarse_flat_m]
    rounds += [(prior.flat_m, _SCALE_M)] * _PATH_ROUNDS
    for flat_m, scale_m in rounds:
        coarse = replace(prior, flat_m=flat_m)
        correction = _solved(correction, compared, reference, coarse, scale_m)
    after = _residual_m(held_back, reference, correction, prior.flat_m)
    return PathFit(correction, before, after, after < before * (1.0 - config.least_gain))


def _residual_m(
    held_back: Cloud, reference: Cloud, correction: PathCorrection, flat_m: float
) -> float:
    """Return the median distance of returns from the planes of a map of other sweeps."""
    reference = _moved(reference, correction)
    tree = KDTree(reference.points_world)
    matches = match_planes(_moved(held_back, correction), reference, tree, flat_m)
    return float(np.median(np.abs(matches.residuals_m))) if len(matches.rows) else float("nan")


def zero_correction(cloud: Cloud, pivot: Float64[np.ndarray, "3"]) -> PathCorrection:
    """Return knots over the time of the returns, without rotation or shift."""
    start, end = int(cloud.times_ns.min()), int(cloud.times_ns.max())
    count = max(2, int(np.ceil((end - start) * 1e-9 / _KNOT_S)) + 1)
    times = np.linspace(start, end, count).astype(np.int64)
    zero = np.zeros((count, 3))
    return PathCorrection(times, pivot, zero, zero.copy())


def _thinned(cloud: Cloud, voxel_m: float, rng: np.random.Generator) -> Cloud:
    """Return one random return of each voxel, so that neighbours extend over some surface."""
    order = rng.permutation(len(cloud.sweep))
    return cloud.rows(order[first_of_voxels(cloud.points_world[order], voxel_m)])


def _moved(cloud: Cloud, correction: PathCorrection) -> Cloud:
    points = correction.transformed(cloud.points_world, cloud.times_ns)
    return Cloud(points, cloud.times_ns, cloud.sweep)


def _solved(
    correction: PathCorrection,
    compared: Cloud,
    reference: Cloud,
    motion: MotionPrior,
    scale_m: float,
) -> PathCorrection:
    """Return the correction after one Gauss-Newton step with the prior; `scale_m` is that of the
    Cauchy loss."""
    compared, reference = _moved(compared, correction), _moved(reference, correction)
    matches = match_planes(compared, reference, KDTree(reference.points_world), motion.flat_m)
    count = len(correction.times_ns)
    weights = robust_weights(matches.residuals_m, scale_m) / _VARIANCE_M2
    hessian, gradient = np.zeros((count * 6, count * 6)), np.zeros(count * 6)
    for start in range(0, len(matches.rows), BATCH):
        part = slice(start, start + BATCH)
        rows = _jacobian(correction, compared, reference, matches, part)
        weighted = rows * weights[part, None].astype(np.float32)
        hessian += weighted.T @ rows
        gradient += weighted.T @ matches.residuals_m[part].astype(np.float32)
    state = np.concatenate([correction.rotations_rad, correction.shifts_m], axis=1).ravel()
    prior = _prior(count, motion)
    step = np.linalg.solve(hessian + prior, -(gradient + prior @ state))
    found = (state + step).reshape(count, 6)
    return PathCorrection(
        correction.times_ns, correction.pivot_world, found[:, :3].copy(), found[:, 3:].copy()
    )


def _jacobian(
    correction: PathCorrection, compared: Cloud, reference: Cloud, matches: Matches, part: slice
) -> np.ndarray:
    """Return the derivative of each residual with respect to the knots, (n, 6 x knots).

    It is the motion of the return minus the mean motion of its neighbours, along the normal.
    """
    normals, near = matches.normals[part], matches.neighbours[part]
    rows = np.zeros((len(normals), len(correction.times_ns), 6), dtype=np.float32)
    weight = (near >= 0) / (near >= 0).sum(axis=1, keepdims=True)
    own = compared.rows(matches.rows[part])
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
    """Add `weight` times the points' motion along the normals, for the two knots around each time.

    Columns are rotation about the pivot, then shift; a point's knots are interpolated linearly.
    """
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


def _prior(count: int, motion: MotionPrior) -> Float64[np.ndarray, "m m"]:
    """Return the information matrix of size and smoothness, for knots of (rotation, shift)."""
    size = np.concatenate([np.radians(motion.turns_deg), motion.shifts_m])
    changes = np.concatenate([np.radians(motion.turn_changes_deg), motion.shift_changes_m])
    second = np.zeros((max(count - 2, 0), count))
    for i in range(len(second)):
        second[i, i : i + 3] = (1.0, -2.0, 1.0)
    return np.kron(np.eye(count), np.diag(size**-2.0)) + np.kron(
        second.T @ second, np.diag(changes**-2.0)
    )
