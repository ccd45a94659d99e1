"""What no ray has seen: the other half of vehicles, default shapes, ground in blind spots."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy import ndimage

from lightsim.core.actors import ActorTrack
from lightsim.core.casting import MakeCaster
from lightsim.core.fields import BLOCK, GroundMap, TsdfGrid
from lightsim.core.laplace import fill_smoothly
from lightsim.core.mesh import Provenance, TriMesh
from lightsim.geometry.actors.cabin import close_cabin
from lightsim.geometry.actors.evidence import ActorEvidence
from lightsim.geometry.actors.proxy import proxy_distance_m
from lightsim.geometry.simplify import simplify_planar
from lightsim.geometry.surface import (
    border_vertices,
    extract_surface,
    keep_faces,
    make_mesh,
    path_distance_m,
)

PROXY_VOXEL_M = 0.12
_PADDING_M = 0.2
_SINK_M = 0.003
_MIN_UP = 0.5
_FINE_M = 0.8
_COARSE_EDGE_M = 0.75


# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/reconstruction.md, where the street of seed 1 is the fair test).

# Evidence from a vehicle's mirrored half counts this much.
_MIRROR_WEIGHT = 0.2
# Evidence of the box's default shape, decisive only where no ray has been.
_PRIOR_WEIGHT = 0.03
# Grid on which holes in the ground are found and closed.
_GROUND_CELL_M = 0.25
# Holes are closed up to this distance from the path.
_GROUND_RADIUS_M = 40.0
# A surface within this height of the ground map counts as ground.
_GROUND_BAND_M = 0.35
# Holes are closed up to this far from observed ground.
_GROUND_REACH_M = 40.0
# Rounds of taking the ground's open edges away before its holes are closed.
_GROUND_TRIM_ROUNDS = 2


def actor_surface(track: ActorTrack, grid: TsdfGrid | None) -> tuple[TriMesh, ActorEvidence]:
    """A closed mesh in frame `actor`, and what each part of it rests on.

    Vehicles seen from one side borrow the mirrored half; the default shape of the kind decides
    where nothing was seen; cabins are closed. Without a grid the mesh is the default shape.
    """
    if grid is None:
        grid = _empty_grid(track)
    sdf, seen = _dense(grid)
    weight = seen
    if track.kind.is_vehicle:
        sdf, weight = mirrored(sdf, seen, _MIRROR_WEIGHT)
    steps = np.stack(np.meshgrid(*[np.arange(n) for n in sdf.shape], indexing="ij"), axis=-1)
    low = grid.origin_m + grid.voxel_m * BLOCK * grid.block_coords.min(axis=0)
    prior = proxy_distance_m(track.kind, track.size_lwh_m, low + grid.voxel_m * steps)
    prior = np.clip(prior, -grid.truncation_m, grid.truncation_m)
    total = weight + _PRIOR_WEIGHT
    measured = ((sdf * weight + prior * _PRIOR_WEIGHT) / total).astype(np.float32)
    closed = close_cabin(track.kind, measured, low, grid.voxel_m, track.size_lwh_m)
    mesh = extract_surface(_from_dense(grid, closed, total.astype(np.float32)))
    filled = measured - closed
    return mesh, ActorEvidence(low, grid.voxel_m, seen, weight - seen, _PRIOR_WEIGHT, filled)


def mirrored(
    sdf: Float32[np.ndarray, "x y z"], weight: Float32[np.ndarray, "x y z"], fraction: float
) -> tuple[Float32[np.ndarray, "x y z"], Float32[np.ndarray, "x y z"]]:
    """A field and its mirror image about the middle of axis 1, the image weighing `fraction`."""
    other_weight = fraction * weight[:, ::-1]
    total = weight + other_weight
    mixed = sdf * weight + sdf[:, ::-1] * other_weight
    mixed = np.where(total > 0, mixed / np.where(total > 0, total, 1), 0)
    return mixed.astype(np.float32), total.astype(np.float32)


def _empty_grid(track: ActorTrack) -> TsdfGrid:
    voxel = PROXY_VOXEL_M
    extent = track.size_lwh_m + 2 * _PADDING_M
    shape = np.ceil(extent / (voxel * BLOCK)).astype(np.int64)
    coords = np.argwhere(np.ones(tuple(shape.tolist()), dtype=bool)).astype(np.int32)
    origin = -voxel * (BLOCK * shape - 1) / 2
    empty = np.zeros((len(coords), BLOCK, BLOCK, BLOCK), dtype=np.float32)
    return TsdfGrid("actor", origin, voxel, 3 * voxel, coords, empty, empty)


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


def trim_ground(mesh: TriMesh, ground: GroundMap, path_m: Float[np.ndarray, "k 3"]) -> TriMesh:
    """Without the open edges of the ground where `ground_patches` will close it.

    The last samples before a blind spot were met by grazing beams or belong to tyres: they stand
    up a few centimetres, and would cast ragged shadows onto the patch beside them.
    """
    corners = mesh.vertices[mesh.faces]
    centres = corners.mean(axis=1).astype(np.float64)
    is_ground = np.abs(centres[:, 2] - ground.look_up(centres[:, :2])) < _GROUND_BAND_M
    is_ground &= path_distance_m(centres.astype(np.float32), path_m) < _GROUND_RADIUS_M
    is_edge = np.zeros(len(mesh.vertices), dtype=bool)
    is_kept = np.ones(len(mesh.faces), dtype=bool)
    for _ in range(_GROUND_TRIM_ROUNDS):
        is_edge[border_vertices(mesh.faces[is_kept])] = True
        is_kept &= ~(is_ground & is_edge[mesh.faces].any(axis=1))
    return keep_faces(mesh, is_kept)


def ground_patches(
    background: TriMesh,
    ground: GroundMap,
    path_m: Float[np.ndarray, "k 3"],
    make_caster: MakeCaster,
) -> TriMesh:
    """Ground that the background lacks: under parked cars, behind them, under the ego vehicle.

    Rays straight down find the holes; heights there solve Laplace's equation between the
    surface around them. Patches start 3 mm below their neighbours, so that nothing
    flickers where both exist.
    """
    xy, shape = _nodes(path_m)
    height = ground.look_up(xy.reshape(-1, 2))
    observed, is_found = _cast_down(background, xy.reshape(-1, 2), height, make_caster)
    is_known = is_found.reshape(shape)
    is_near = path_distance_m(_at_height(xy.reshape(-1, 2), height), path_m) < _GROUND_RADIUS_M
    gap_m = np.asarray(ndimage.distance_transform_edt(~is_known)) * _GROUND_CELL_M
    is_hole = ~is_known & is_near.reshape(shape) & (gap_m < _GROUND_REACH_M)
    z = fill_smoothly(np.where(is_known, observed.reshape(shape), 0.0), is_known)
    corners = is_hole[1:, 1:] | is_hole[:-1, 1:] | is_hole[1:, :-1] | is_hole[:-1, :-1]
    patches, node = _quads(background.frame, xy, z - _SINK_M * is_known, corners)
    # Beside measured ground light changes quickly (edges of vehicles); far inside it is dark.
    edge_m = np.where(gap_m.reshape(-1)[node] < _FINE_M, _GROUND_CELL_M, _COARSE_EDGE_M)
    return simplify_planar(patches, edge_m=edge_m).with_provenance(Provenance.INTERPOLATED)


def _nodes(
    path_m: Float[np.ndarray, "k 3"],
) -> tuple[Float64[np.ndarray, "nx ny 2"], tuple[int, int]]:
    cell, radius = _GROUND_CELL_M, _GROUND_RADIUS_M
    low = path_m[:, :2].min(axis=0) - radius
    count = np.ceil((path_m[:, :2].max(axis=0) + radius - low) / cell).astype(np.int64) + 1
    x = low[0] + cell * np.arange(int(count[0]))
    y = low[1] + cell * np.arange(int(count[1]))
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1), (len(x), len(y))


def _at_height(
    xy: Float64[np.ndarray, "n 2"], height: Float[np.ndarray, " n"]
) -> Float32[np.ndarray, "n 3"]:
    return np.concatenate([xy, height[:, None]], axis=1).astype(np.float32)


def _cast_down(
    background: TriMesh,
    xy: Float64[np.ndarray, "n 2"],
    height: Float[np.ndarray, " n"],
    make_caster: MakeCaster,
) -> tuple[Float64[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Height of the surface near the ground map, and whether an upward-facing one is there."""
    start = _at_height(xy, height + _GROUND_BAND_M).astype(np.float64)
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), start.shape).copy()
    hits = make_caster([background]).intersect(start, down)
    is_found = hits.is_hit & (hits.distance_m < 2 * _GROUND_BAND_M)
    up = background.face_normals()[np.where(is_found, hits.face_index, 0), 2]
    is_found &= up > _MIN_UP
    z = np.where(is_found, start[:, 2] - np.where(is_found, hits.distance_m, 0.0), height)
    return z, is_found


def _quads(
    frame: str,
    xy: Float64[np.ndarray, "nx ny 2"],
    z: Float64[np.ndarray, "nx ny"],
    is_drawn: Bool[np.ndarray, "_mx _my"],
) -> tuple[TriMesh, Int64[np.ndarray, " n"]]:
    """Squares of the grid, and the node that each vertex is."""
    index = np.arange(z.size).reshape(z.shape)
    i, j = np.nonzero(is_drawn)
    a, b, c, d = index[i, j], index[i + 1, j], index[i + 1, j + 1], index[i, j + 1]
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    used, faces = np.unique(faces, return_inverse=True)
    points = np.concatenate([xy.reshape(-1, 2), z.reshape(-1, 1)], axis=1)[used]
    return make_mesh(frame, points, faces.reshape(-1, 3).astype(np.int64)), used
