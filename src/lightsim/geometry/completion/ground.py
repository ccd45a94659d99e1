"""Ground that the measured surface lacks: in blind spots (under parked cars, behind them, under the
ego vehicle), and far down the road, where beams are too sparse to draw one."""

from __future__ import annotations

from dataclasses import dataclass

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
    fine = _look_down(background, ground, path_m, _GROUND_RADIUS_M, _GROUND_CELL_M, make_caster)
    coarse = _look_down(background, ground, path_m, radius_m, _FAR_CELL_M, make_caster)
    near, far = _near_patches(fine), _far_patches(coarse, radius_m)
    return concatenate_meshes([near, far]).with_provenance(Provenance.INTERPOLATED)


def _near_patches(nodes: _Nodes) -> TriMesh:
    gap_m = np.asarray(ndimage.distance_transform_edt(~nodes.is_measured)) * _GROUND_CELL_M
    is_near = nodes.away_m < _GROUND_RADIUS_M
    is_told = nodes.is_observed & (gap_m > _TOLD_GAP_M)
    is_known = nodes.is_measured | is_told | ~is_near
    z = fill_smoothly(np.where(is_known, nodes.height_m, 0.0), is_known)
    is_hole = ~nodes.is_measured & is_near & (gap_m < _GROUND_REACH_M)
    patches, node = _quads_at(is_hole, nodes.xy, z - _SINK_M * nodes.is_measured)
    # Beside measured ground light changes quickly (edges of vehicles); far inside it is dark.
    edge_m = np.where(gap_m.reshape(-1)[node] < _FINE_M, _GROUND_CELL_M, _COARSE_EDGE_M)
    return simplify_planar(patches, edge_m=edge_m)


def _far_patches(nodes: _Nodes, radius_m: float) -> TriMesh:
    """The ground map itself around the returns that it knows, where nothing was measured."""
    is_far = (nodes.away_m > _GROUND_RADIUS_M - 2 * _FAR_CELL_M) & (nodes.away_m < radius_m)
    is_told = nodes.is_measured | nodes.is_observed
    reach_m = np.asarray(ndimage.distance_transform_edt(~is_told)) * _FAR_CELL_M
    is_hole = ~nodes.is_measured & is_far & (reach_m < _FAR_REACH_M)
    patches, _ = _quads_at(is_hole, nodes.xy, nodes.height_m - _SINK_M)
    return simplify_planar(patches, edge_m=2 * _FAR_CELL_M)


@dataclass(frozen=True, eq=False)
class _Nodes:
    """A grid around the path, seen from above.

    Args:
        height_m: of the measured surface near the ground map, else of the map.
        is_measured: there is such a surface.
        is_observed: the map knows returns there.
        away_m: from the path.
    """

    xy: Float64[np.ndarray, "nx ny 2"]
    height_m: Float64[np.ndarray, "nx ny"]
    is_measured: Bool[np.ndarray, "nx ny"]
    is_observed: Bool[np.ndarray, "nx ny"]
    away_m: Float64[np.ndarray, "nx ny"]


def _look_down(
    background: TriMesh,
    ground: GroundMap,
    path_m: Float[np.ndarray, "k 3"],
    radius_m: float,
    cell_m: float,
    make_caster: MakeCaster,
) -> _Nodes:
    """Nodes up to `radius_m` from the path, and beyond it to a rectangle."""
    low = path_m[:, :2].min(axis=0) - radius_m
    count = np.ceil((path_m[:, :2].max(axis=0) + radius_m - low) / cell_m).astype(np.int64) + 1
    x, y = (low[k] + cell_m * np.arange(int(count[k])) for k in range(2))
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    flat = xy.reshape(-1, 2)
    height = ground.look_up(flat)
    surface, is_measured = _cast_down(background, flat, height, make_caster)
    away_m = path_distance_m(_at_height(flat, height), path_m)
    found = (surface, is_measured, ground.observes(flat), away_m)
    return _Nodes(xy, *(values.reshape(xy.shape[:2]) for values in found))


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
