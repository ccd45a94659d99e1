"""The closed surface of an actor: what was seen of it, and the shape of its kind elsewhere."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64
from scipy import ndimage

from lightsim.core.actors import ActorTrack
from lightsim.core.fields import BLOCK, TsdfGrid
from lightsim.core.mesh import TriMesh
from lightsim.geometry.actors.evidence import ActorEvidence
from lightsim.geometry.actors.fit import HAS_BODY, Measured, fit_body
from lightsim.geometry.actors.proxy import proxy_distance_m
from lightsim.geometry.surface import extract_surface

_PADDING_M = 0.2
_PROXY_VOXEL_M = 0.12
_BODY_VOXEL_M = 0.06
_MOST_SAMPLES = 400_000
"""Of a body's grid; larger vehicles get a coarser one."""


# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/reconstruction.md).

# Evidence from a vehicle's mirrored half counts this much.
_MIRROR_WEIGHT = 0.2
# Evidence of the default shape, decisive only where no ray has been.
_PRIOR_WEIGHT = 0.03
# A fitted body moves half-way to what this many returns say.
_BODY_RETURNS = 4.0
# So many returns around a place: it was seen.
_SEEN_RETURNS = 1.0
# Details of a body are smooth over this distance,
_DETAIL_M = 0.08
# and no larger than this.
_DETAIL_REACH_M = 0.2
# Returns further inside a cabin were let in by a pane.
_THROUGH_GLASS_M = 0.06
# Returns that tell a body's proportions.
_FIT_SAMPLES = 800
# From this part of the box's height on beams may pass through panes.
_GLASS_FROM = 0.55


def actor_surface(
    track: ActorTrack,
    grid: TsdfGrid | None,
    returns: Float32[np.ndarray, "n 3"] | None = None,
) -> tuple[TriMesh, ActorEvidence]:
    """A closed mesh in frame `actor`, and what each part of it rests on.

    Vehicles have the body that fits what was seen of them (`fit_body`), with the details that were
    measured; both halves tell of each other. Of all others the default shape of the kind decides
    where nothing was seen.

    Args:
        grid: of the fused beams; None where there were too few.
        returns: of LiDAR in frame `actor`, if there are any.
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
    """The fitted body, moved to the returns by smooth details."""
    extent = track.size_lwh_m + 2 * _PADDING_M
    voxel = max(_BODY_VOXEL_M, float(np.prod(extent) / _MOST_SAMPLES) ** (1 / 3))
    fine = _empty_grid(track, voxel)
    low, points = _lattice(fine, _dense(fine)[0].shape)
    body = fit_body(track.kind, track.size_lwh_m, _measured(track, grid, returns))
    shape = body.distance_m(points)
    # Beams that pass a pane meet what is inside.
    outside = body.distance_m(returns.astype(np.float64))
    is_body = np.abs(outside) < _DETAIL_REACH_M
    is_body &= (outside > -_THROUGH_GLASS_M) | (returns[:, 2] < _sill_m(track))
    kept, offset = returns[is_body], outside[is_body]
    seen, moved = _spread(kept, offset, low, voxel, shape.shape)
    seen_across, moved_across = seen[:, ::-1], moved[:, ::-1]
    total = seen + _MIRROR_WEIGHT * seen_across
    detail = (moved + _MIRROR_WEIGHT * moved_across) / (total + _BODY_RETURNS)
    closed = (shape - detail).astype(np.float32)
    mesh = extract_surface(_from_dense(fine, closed, np.ones_like(closed)))
    evidence = ActorEvidence(low, voxel, seen, 0.5 * seen_across, _SEEN_RETURNS, body)
    return mesh, evidence


def _sill_m(track: ActorTrack) -> float:
    """From this height on beams may pass through panes, frame `actor`."""
    return (_GLASS_FROM - 0.5) * float(track.size_lwh_m[2])


def _measured(
    track: ActorTrack, grid: TsdfGrid | None, returns: Float32[np.ndarray, "n 3"]
) -> Measured:
    """Returns, and half as many points in free space within the box."""
    rng = np.random.default_rng(0)
    surface = returns[rng.choice(len(returns), min(_FIT_SAMPLES, len(returns)), replace=False)]
    if grid is None:
        return Measured(surface, np.zeros((0, 3)), np.zeros(0))
    sdf, weight = _dense(grid)
    _, points = _lattice(grid, sdf.shape)
    is_free = (weight > _PRIOR_WEIGHT) & (sdf >= 0.9 * grid.truncation_m)
    is_free &= (np.abs(points) <= track.size_lwh_m / 2).all(axis=-1)
    rows = np.flatnonzero(is_free)
    rows = rng.choice(rows, min(_FIT_SAMPLES // 2, len(rows)), replace=False)
    free = points.reshape(-1, 3)[rows]
    trust = np.minimum(weight.ravel()[rows], 1.0)
    return Measured(surface, free, np.where(free[:, 2] > _sill_m(track), 0.3 * trust, trust))


def _spread(
    points_actor: Float32[np.ndarray, "n 3"],
    values: Float64[np.ndarray, " n"],
    low_m: Float64[np.ndarray, "3"],
    voxel_m: float,
    shape: tuple[int, ...],
) -> tuple[Float64[np.ndarray, "x y z"], Float64[np.ndarray, "x y z"]]:
    """How many points lie around each sample, by a Gaussian, and the sum of their values."""
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
    """A field and its mirror image about the middle of axis 1, the image weighing `fraction`."""
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
    """The dense field's first sample, and all of them."""
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
