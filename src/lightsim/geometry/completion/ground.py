"""Ground that the measured surface lacks: in blind spots (under parked cars, behind them, under the
ego vehicle), and far down the road, where beams are too sparse to draw one."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy import ndimage

from lightsim.core.casting import MakeCaster
from lightsim.core.fields import GroundMap
from lightsim.core.laplace import fill_smoothly
from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.simplify import simplify_planar
from lightsim.geometry.surface import border_vertices, keep_faces, path_distance_m, quad_mesh

_SINK_M = 0.003
_MIN_UP = 0.5
_FINE_M = 0.8
_COARSE_EDGE_M = 0.75


# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/reconstruction.md, where the street of seed 1 is the fair test).

# Grid on which holes in the ground are found and closed.
_GROUND_CELL_M = 0.25
# Holes are closed on it up to this distance from the path.
_GROUND_RADIUS_M = 40.0
# Further out the ground map lies open where no surface covers it, on this grid, up to this far from
# the returns that it knows.
_FAR_CELL_M = 1.0
_FAR_REACH_M = 8.0
# The map tells the height of holes this far from the measured surface; its lowest returns lie some
# millimetres lower than the surface between them.
_TOLD_GAP_M = 2.0
# A surface within this height of the ground map counts as ground.
_GROUND_BAND_M = 0.35
# Holes are closed up to this far from observed ground.
_GROUND_REACH_M = 40.0
# Rounds of taking the ground's open edges away before its holes are closed.
_GROUND_TRIM_ROUNDS = 2


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
    radius_m: float,
    make_caster: MakeCaster,
) -> TriMesh:
    """Ground that the background lacks, up to `radius_m` from the path.

    Rays straight down find the holes. Near the path heights there solve Laplace's equation between
    the surface around them and what the map knows; further out they are the map's. Patches start
    3 mm below their neighbours, so that nothing flickers where both exist.
    """
    near = _near_patches(background, ground, path_m, make_caster)
    far = _far_patches(background, ground, path_m, radius_m, make_caster)
    return concatenate_meshes([near, far]).with_provenance(Provenance.INTERPOLATED)


def _near_patches(
    background: TriMesh,
    ground: GroundMap,
    path_m: Float[np.ndarray, "k 3"],
    make_caster: MakeCaster,
) -> TriMesh:
    xy, shape = _nodes(path_m, _GROUND_RADIUS_M, _GROUND_CELL_M)
    flat = xy.reshape(-1, 2)
    height = ground.look_up(flat)
    observed, is_found = _cast_down(background, flat, height, make_caster)
    is_near = path_distance_m(_at_height(flat, height), path_m) < _GROUND_RADIUS_M
    is_measured, is_near = is_found.reshape(shape), is_near.reshape(shape)
    gap_m = np.asarray(ndimage.distance_transform_edt(~is_measured)) * _GROUND_CELL_M
    is_told = ground.observes(flat).reshape(shape) & (gap_m > _TOLD_GAP_M)
    is_known = is_measured | is_told | ~is_near
    z = np.where(is_measured, observed.reshape(shape), height.reshape(shape))
    z = fill_smoothly(np.where(is_known, z, 0.0), is_known)
    is_hole = ~is_measured & is_near & (gap_m < _GROUND_REACH_M)
    patches, node = _quads_at(is_hole, xy, z - _SINK_M * is_measured)
    # Beside measured ground light changes quickly (edges of vehicles); far inside it is dark.
    edge_m = np.where(gap_m.reshape(-1)[node] < _FINE_M, _GROUND_CELL_M, _COARSE_EDGE_M)
    return simplify_planar(patches, edge_m=edge_m)


def _far_patches(
    background: TriMesh,
    ground: GroundMap,
    path_m: Float[np.ndarray, "k 3"],
    radius_m: float,
    make_caster: MakeCaster,
) -> TriMesh:
    """The ground map itself around the returns that it knows, where nothing was measured."""
    xy, shape = _nodes(path_m, radius_m, _FAR_CELL_M)
    flat = xy.reshape(-1, 2)
    height = ground.look_up(flat)
    observed, is_found = _cast_down(background, flat, height, make_caster)
    away_m = path_distance_m(_at_height(flat, height), path_m)
    is_far = ((away_m > _GROUND_RADIUS_M - 2 * _FAR_CELL_M) & (away_m < radius_m)).reshape(shape)
    is_measured = is_found.reshape(shape)
    is_told = is_measured | ground.observes(flat).reshape(shape)
    reach_m = np.asarray(ndimage.distance_transform_edt(~is_told)) * _FAR_CELL_M
    is_hole = ~is_measured & is_far & (reach_m < _FAR_REACH_M)
    z = np.where(is_found, observed, height).reshape(shape) - _SINK_M
    return simplify_planar(_quads_at(is_hole, xy, z)[0], edge_m=2 * _FAR_CELL_M)


def _nodes(
    path_m: Float[np.ndarray, "k 3"], radius_m: float, cell_m: float
) -> tuple[Float64[np.ndarray, "nx ny 2"], tuple[int, int]]:
    low = path_m[:, :2].min(axis=0) - radius_m
    count = np.ceil((path_m[:, :2].max(axis=0) + radius_m - low) / cell_m).astype(np.int64) + 1
    x, y = (low[k] + cell_m * np.arange(int(count[k])) for k in range(2))
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


def _quads_at(
    is_hole: Bool[np.ndarray, "nx ny"],
    xy: Float64[np.ndarray, "nx ny 2"],
    z: Float64[np.ndarray, "nx ny"],
) -> tuple[TriMesh, Int64[np.ndarray, " n"]]:
    """Squares of the grid that touch a hole, and the node that each vertex is."""
    is_drawn = is_hole[1:, 1:] | is_hole[:-1, 1:] | is_hole[1:, :-1] | is_hole[:-1, :-1]
    index = np.arange(z.size).reshape(z.shape)
    i, j = np.nonzero(is_drawn)
    quads = np.stack([index[i, j], index[i + 1, j], index[i + 1, j + 1], index[i, j + 1]], axis=1)
    points = np.concatenate([xy.reshape(-1, 2), z.reshape(-1, 1)], axis=1)
    return quad_mesh(points, quads), np.unique(quads)
