"""Completion of unmeasured ground.

Ground is unmeasured in blind spots (under and behind parked cars, under the ego vehicle), and at a
distance where beams are too sparse.
"""

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

# Height of a surface above or below the ground map up to which it counts as ground, in metres.
GROUND_BAND_M = 0.35

# The values below were chosen on log 002 and street 0; only their joint effect was measured
# (docs/benchmarks/reconstruction.md).


class _Patch:
    """Grids on which holes of the ground are found, and faces of their patches."""

    cell_m = 0.25  # Edge of the fine grid near the path.
    radius_m = 40.0  # Its reach from the path, and from measured ground.
    far_cell_m = 1.0  # Edge of the coarse grid beyond.
    far_reach_m = 8.0  # Distance from returns up to which the ground map is used there.
    # Distance from measured surface beyond which the map's height is used in a hole: the map is
    # some millimetres lower, which would make a step.
    map_gap_m = 2.0
    trim_rounds = 2  # Rounds of removal of open borders.
    min_up = 0.5  # Least vertical component of the ground's normal.
    sink_m = 0.003  # Depth of patches below measured ground, against flicker.
    fine_m = 0.8  # Width of fine faces beside measured ground, where light changes quickly.
    coarse_edge_m = 0.75  # Edge of the other faces.


def trim_ground(mesh: TriMesh, ground: GroundMap, path_m: Float[np.ndarray, "k 3"]) -> TriMesh:
    """Remove the open borders of the ground near the path, before `ground_patches` closes it.

    The last samples before a blind spot come from grazing beams or from tyres. They rise a few
    centimetres and would cast ragged shadows onto the patch beside them.

    Args:
        mesh: static surface, frame world.
        ground: ground map.
        path_m: positions of the recording vehicle.
    """
    corners = mesh.vertices[mesh.faces]
    centres = corners.mean(axis=1).astype(np.float64)
    is_ground = np.abs(centres[:, 2] - ground.look_up(centres[:, :2])) < GROUND_BAND_M
    is_ground &= path_distance_m(centres.astype(np.float32), path_m) < _Patch.radius_m
    is_edge = np.zeros(len(mesh.vertices), dtype=bool)
    is_kept = np.ones(len(mesh.faces), dtype=bool)
    for _ in range(_Patch.trim_rounds):
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
    """Return the ground that is missing in the background, up to `radius_m` from the path.

    Vertical rays find the holes. Near the path, heights solve Laplace's equation between the
    surrounding surface and the ground map; further out the map is used. Patches start 3 mm below
    adjacent surface, so that overlapping surfaces do not flicker.

    Args:
        background: static surface, frame world.
        ground: ground map.
        path_m: positions of the recording vehicle.
        radius_m: greatest distance from the path.
        make_caster: builds the ray caster.
    """
    fine = _look_down(background, ground, path_m, _Patch.radius_m, _Patch.cell_m, make_caster)
    coarse = _look_down(background, ground, path_m, radius_m, _Patch.far_cell_m, make_caster)
    near, far = _near_patches(fine), _far_patches(coarse, radius_m)
    return concatenate_meshes([near, far]).with_provenance(Provenance.INTERPOLATED)


def _near_patches(nodes: _Nodes) -> TriMesh:
    gap_m = np.asarray(ndimage.distance_transform_edt(~nodes.is_measured)) * _Patch.cell_m
    is_near = nodes.away_m < _Patch.radius_m
    is_mapped = nodes.is_observed & (gap_m > _Patch.map_gap_m)
    is_known = nodes.is_measured | is_mapped | ~is_near
    z = fill_smoothly(np.where(is_known, nodes.height_m, 0.0), is_known)
    is_hole = ~nodes.is_measured & is_near & (gap_m < _Patch.radius_m)
    patches, node = _quads_at(is_hole, nodes.xy, z - _Patch.sink_m * nodes.is_measured)
    edge_m = np.where(gap_m.reshape(-1)[node] < _Patch.fine_m, _Patch.cell_m, _Patch.coarse_edge_m)
    return simplify_planar(patches, edge_m=edge_m)


def _far_patches(nodes: _Nodes, radius_m: float) -> TriMesh:
    """Return the ground map around its returns, where no surface was measured."""
    is_far = (nodes.away_m > _Patch.radius_m - 2 * _Patch.far_cell_m) & (nodes.away_m < radius_m)
    is_mapped = nodes.is_measured | nodes.is_observed
    reach_m = np.asarray(ndimage.distance_transform_edt(~is_mapped)) * _Patch.far_cell_m
    is_hole = ~nodes.is_measured & is_far & (reach_m < _Patch.far_reach_m)
    patches, _ = _quads_at(is_hole, nodes.xy, nodes.height_m - _Patch.sink_m)
    return simplify_planar(patches, edge_m=2 * _Patch.far_cell_m)


@dataclass(frozen=True, eq=False)
class _Nodes:
    """A grid around the path, in plan.

    Args:
        xy: positions of the nodes.
        height_m: height of the measured surface near the ground map, else of the map.
        is_measured: whether there is such a surface.
        is_observed: whether the map has returns at the node.
        away_m: distance from the path.
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
    """Return nodes up to `radius_m` from the path, completed to a rectangle."""
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
    """Return the height of upward-facing surface near the ground map, else the map's; mask."""
    start = _at_height(xy, height + GROUND_BAND_M).astype(np.float64)
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), start.shape).copy()
    hits = make_caster([background]).intersect(start, down)
    is_found = hits.is_hit & (hits.distance_m < 2 * GROUND_BAND_M)
    up = background.face_normals()[np.where(is_found, hits.face_index, 0), 2]
    is_found &= up > _Patch.min_up
    z = np.where(is_found, start[:, 2] - np.where(is_found, hits.distance_m, 0.0), height)
    return z, is_found


def _quads_at(
    is_hole: Bool[np.ndarray, "nx ny"],
    xy: Float64[np.ndarray, "nx ny 2"],
    z: Float64[np.ndarray, "nx ny"],
) -> tuple[TriMesh, Int64[np.ndarray, " n"]]:
    """Return the squares of the grid that touch a hole, and the node of each vertex."""
    # A square is drawn if any corner is a hole, so that patches overlap measured ground by a cell.
    is_drawn = is_hole[1:, 1:] | is_hole[:-1, 1:] | is_hole[1:, :-1] | is_hole[:-1, :-1]
    index = np.arange(z.size).reshape(z.shape)
    i, j = np.nonzero(is_drawn)
    quads = np.stack([index[i, j], index[i + 1, j], index[i + 1, j + 1], index[i, j + 1]], axis=1)
    points = np.concatenate([xy.reshape(-1, 2), z.reshape(-1, 1)], axis=1)
    return quad_mesh(points, quads), np.unique(quads)
