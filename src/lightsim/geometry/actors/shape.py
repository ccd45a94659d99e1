"""Closed surface of an actor: measured where observed, the shape of its kind elsewhere."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64
from scipy import ndimage

from lightsim.core.actors import ActorTrack
from lightsim.core.fields import BLOCK, TsdfGrid
from lightsim.core.mesh import TriMesh
from lightsim.geometry.actors.evidence import ActorEvidence
from lightsim.geometry.actors.fit import HAS_BODY, VehicleMeasurements, fit_body
from lightsim.geometry.actors.proxy import proxy_distance_m
from lightsim.geometry.surface import extract_surface

# Chosen on log 002 and synthetic street 0; only the combination is measured
# (docs/benchmarks/reconstruction.md).

# Margin of the grid around the box.
_PADDING_M = 0.2
# Distance between samples of default shapes.
_PROXY_VOXEL_M = 0.12
# Distance between samples of bodies, for vehicles up to the number of samples below.
_BODY_VOXEL_M = 0.06
# Most samples of a body's grid; the grids of larger vehicles are coarser.
_MAX_SAMPLES = 400_000
# Weight of measurements on the mirrored half, relative to measurements of the half itself.
_MIRROR_WEIGHT = 0.2
# Weight of the default shape: small, so that it has an effect only in unmeasured places.
_PRIOR_WEIGHT = 0.03
# Number of returns at which the body moves half of the measured offset.
_BODY_RETURNS = 4.0
# Number of returns around a point from which it counts as measured.
_MEASURED_RETURNS = 1.0
# Standard deviation of the Gaussian that smooths offsets from the body.
_DETAIL_M = 0.08
# Largest offset from the body; returns at larger offsets belong to other surfaces.
_DETAIL_REACH_M = 0.2
# Depth inside the body from which returns of the cabin's height have passed a pane.
_THROUGH_GLASS_M = 0.06
# Returns drawn for the fit of the proportions; bounds the time.
_FIT_SAMPLES = 800
# Fraction of the box's height above which beams may pass through panes.
_SILL_FRACTION = 0.55


def actor_surface(
    track: ActorTrack,
    grid: TsdfGrid | None,
    returns: Float32[np.ndarray, "n 3"] | None = None,
) -> tuple[TriMesh, ActorEvidence]:
    """Return a closed mesh in frame `actor`, and the evidence of each part of it.

    Vehicles with a cabin have a fitted body (`fit_body`) that measured details deform; each half
    also uses the mirrored measurements of the other. All other actors have the fused surface, and
    the default shape of their kind where it was not observed.

    Args:
        track: the actor with its kind and box.
        grid: signed distances of the fused beams; None if there were too few.
        returns: LiDAR returns in frame `actor`.
    """
    if track.kind in HAS_BODY:
        none = np.zeros((0, 3), dtype=np.float32)
        return _vehicle(track, grid, none if returns is None else returns)
    if grid is None:
        grid = _empty_grid(track, _PROXY_VOXEL_M)
    sdf, seen = _dense(grid)
    weight = seen
    if track.kind.is_vehicle:
        sdf, weight = mirrored(sdf, seen, _MIRROR_WEIGHT)
    low, points = _lattice(grid, sdf.shape)
    prior = proxy_distance_m(track.kind, track.size_lwh_m, points)
    prior = np.clip(prior, -grid.truncation_m, grid.truncation_m)
    total = weight + _PRIOR_WEIGHT
    closed = ((sdf * weight + prior * _PRIOR_WEIGHT) / total).astype(np.float32)
    mesh = extract_surface(_from_dense(grid, closed, total.astype(np.float32)))
    return mesh, ActorEvidence(low, grid.voxel_m, seen, weight - seen, _PRIOR_WEIGHT)


def _vehicle(
    track: ActorTrack, grid: TsdfGrid | None, returns: Float32[np.ndarray, "n 3"]
) -> tuple[TriMesh, ActorEvidence]:
    """Return the fitted body, deformed towards the returns by smooth offsets."""
    extent = track.size_lwh_m + 2 * _PADDING_M
    voxel = max(_BODY_VOXEL_M, float(np.prod(extent) / _MAX_SAMPLES) ** (1 / 3))
    fine = _empty_grid(track, voxel)
    low, points = _lattice(fine, _dense(fine)[0].shape)
    body = fit_body(track.kind, track.size_lwh_m, _measured(track, grid, returns))
    shape = body.distance_m(points)
    # Beams that pass a pane end inside the cabin and do not measure the body.
    outside = body.distance_m(returns.astype(np.float64))
    is_body = np.abs(outside) < _DETAIL_REACH_M
    is_body &= (outside > -_THROUGH_GLASS_M) | (returns[:, 2] < _sill_m(track))
    count, moved = _gaussian_splats(returns[is_body], outside[is_body], low, voxel, shape.shape)
    # The grid is symmetric about y = 0, so reversal of axis 1 mirrors it.
    count_across, moved_across = count[:, ::-1], moved[:, ::-1]
    total = count + _MIRROR_WEIGHT * count_across
    detail = (moved + _MIRROR_WEIGHT * moved_across) / (total + _BODY_RETURNS)
    closed = (shape - detail).astype(np.float32)
    mesh = extract_surface(_from_dense(fine, closed, np.ones_like(closed)))
    evidence = ActorEvidence(low, voxel, count, 0.5 * count_across, _MEASURED_RETURNS, body)
    return mesh, evidence


def _sill_m(track: ActorTrack) -> float:
    """Return the height z in frame `actor` above which beams may pass through panes."""
    return (_SILL_FRACTION - 0.5) * float(track.size_lwh_m[2])


def _measured(
    track: ActorTrack, grid: TsdfGrid | None, returns: Float32[np.ndarray, "n 3"]
) -> VehicleMeasurements:
    """Return a sample of the returns, and half as many points in free space within the box."""
    rng = np.random.default_rng(0)
    surface = returns[rng.choice(len(returns), min(_FIT_SAMPLES, len(returns)), replace=False)]
    if grid is None:
        return VehicleMeasurements(surface, np.zeros((0, 3)), np.zeros(0))
    sdf, weight = _dense(grid)
    _, points = _lattice(grid, sdf.shape)
    is_free = (weight > _PRIOR_WEIGHT) & (sdf >= 0.9 * grid.truncation_m)
    is_free &= (np.abs(points) <= track.size_lwh_m / 2).all(axis=-1)
    rows = np.flatnonzero(is_free)
    rows = rng.choice(rows, min(_FIT_SAMPLES // 2, len(rows)), replace=False)
    free = points.reshape(-1, 3)[rows]
    free_weight = np.minimum(weight.ravel()[rows], 1.0)
    # Free space behind panes is inside the body: such points have less weight.
    return VehicleMeasurements(
        surface, free, np.where(free[:, 2] > _sill_m(track), 0.3 * free_weight, free_weight)
    )


def _gaussian_splats(
    points_actor: Float32[np.ndarray, "n 3"],
    values: Float64[np.ndarray, " n"],
    low_m: Float64[np.ndarray, "3"],
    voxel_m: float,
    shape: tuple[int, ...],
) -> tuple[Float64[np.ndarray, "x y z"], Float64[np.ndarray, "x y z"]]:
    """Return the number of points around each sample, weighted by a Gaussian, and the sum of
    their values."""
    index = np.round((points_actor - low_m) / voxel_m).astype(np.int64)
    index = np.clip(index, 0, np.array(shape) - 1)
    flat = np.ravel_multi_index(tuple(index.T), shape)
    sigma = _DETAIL_M / voxel_m
    peak = (np.sqrt(2 * np.pi) * sigma) ** 3
    count, total = (
        peak * ndimage.gaussian_filter(grid.reshape(shape), sigma, mode="constant")
        for grid in (
            np.bincount(flat, minlength=int(np.prod(shape))).astype(np.float64),
            np.bincount(flat, values, minlength=int(np.prod(shape))),
        )
    )
    return count, total


def mirrored(
    sdf: Float32[np.ndarray, "x y z"], weight: Float32[np.ndarray, "x y z"], fraction: float
) -> tuple[Float32[np.ndarray, "x y z"], Float32[np.ndarray, "x y z"]]:
    """Return the weighted mean of a field and its mirror image about the middle of axis 1.

    The weights of the image are multiplied by `fraction`; the second array is the sum of weights.
    """
    other_weight = fraction * weight[:, ::-1]
    total = weight + other_weight
    mixed = sdf * weight + sdf[:, ::-1] * other_weight
    mixed = np.where(total > 0, mixed / np.where(total > 0, total, 1), 0)
    return mixed.astype(np.float32), total.astype(np.float32)


def _empty_grid(track: ActorTrack, voxel_m: float) -> TsdfGrid:
    extent = track.size_lwh_m + 2 * _PADDING_M
    shape = np.ceil(extent / (voxel_m * BLOCK)).astype(np.int64)
    coords = np.argwhere(np.ones(tuple(shape.tolist()), dtype=bool)).astype(np.int32)
    origin = -voxel_m * (BLOCK * shape - 1) / 2
    empty = np.zeros((len(coords), BLOCK, BLOCK, BLOCK), dtype=np.float32)
    return TsdfGrid("actor", origin, voxel_m, 3 * voxel_m, coords, empty, empty)


def _lattice(
    grid: TsdfGrid, shape: tuple[int, ...]
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "x y z 3"]]:
    """Return the positions of the dense field's first sample and of all samples."""
    low = grid.origin_m + grid.voxel_m * BLOCK * grid.block_coords.min(axis=0)
    steps = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), axis=-1)
    return low, low + grid.voxel_m * steps


def _dense(
    grid: TsdfGrid,
) -> tuple[Float32[np.ndarray, "x y z"], Float32[np.ndarray, "x y z"]]:
    local = grid.block_coords - grid.block_coords.min(axis=0)
    shape = tuple((BLOCK * (local.max(axis=0) + 1)).tolist())
    sdf, weight = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    for block, corner in enumerate((BLOCK * local).tolist()):
        where = tuple(slice(c, c + BLOCK) for c in corner)
        sdf[where], weight[where] = grid.sdf_m[block], grid.weight[block]
    return sdf, weight


def _from_dense(
    grid: TsdfGrid, sdf: Float32[np.ndarray, "x y z"], weight: Float32[np.ndarray, "x y z"]
) -> TsdfGrid:
    low = grid.block_coords.min(axis=0)
    wheres = [
        tuple(slice(c, c + BLOCK) for c in corner)
        for corner in (BLOCK * (grid.block_coords - low)).tolist()
    ]
    return TsdfGrid(
        grid.frame,
        grid.origin_m,
        grid.voxel_m,
        grid.truncation_m,
        grid.block_coords,
        np.stack([sdf[w] for w in wheres]),
        np.stack([weight[w] for w in wheres]),
    )
