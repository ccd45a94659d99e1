"""The ray table: light transport is linear in the sky, so rays are traced once for all skies.

For every traced pixel N cosine-distributed rays are stored as the sky cell they point at and the
surface face they meet, if any; for every face met, M rays of its own. A sky then costs sums of
table look-ups and a few sun rays (`render.light`). Diffuse surfaces, one bounce.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64, UInt16

from lightsim.core.buffers import GBuffers
from lightsim.core.casting import RayCaster
from lightsim.core.mesh import TriMesh
from lightsim.render.embree import offset_origins
from lightsim.render.faces import (
    FaceSamples,
    FaceTable,
    TransportConfig,
    hashed_shifts,
    hemisphere_directions,
)
from lightsim.render.scene import FrameScene
from lightsim.render.spread import Spread, TracedPixels

OPEN = -1
"""face_row of a ray that meets nothing."""
_TILE_RAYS = 1 << 20


def exact() -> TransportConfig:
    """Every pixel traced and nothing smoothed: for tests and comparisons."""
    return TransportConfig(sky_rays=64, shading_step_px=1, filter_radius=0)


@dataclass(frozen=True, eq=False)
class PointTable:
    """Rays of n points.

    Args:
        sky_cells: the cell that each ray points at.
        face_rows: row in `faces` of the face it meets, or OPEN.
        faces: what the rays meet.
    """

    sky_cells: UInt16[np.ndarray, "n k"]
    face_rows: Int32[np.ndarray, "n k"]
    faces: FaceSamples

    @property
    def openness(self) -> Float32[np.ndarray, " n"]:
        """Cosine-weighted fraction of the hemisphere that is open."""
        return (self.face_rows == OPEN).mean(axis=1, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class TransportTable:
    """The ray table of one frame.

    Args:
        points: rays of the traced pixels.
        pixel: flat numbers of the pixels whose centre shows a surface.
        spread: how the light of the traced pixels reaches them.
        ambient_occlusion: open fraction of the hemisphere of every pixel; sky 1.
    """

    points: PointTable
    pixel: Int64[np.ndarray, " p"]
    spread: Spread
    ambient_occlusion: Float32[np.ndarray, "h w"]


def static_face_table(scene: FrameScene, config: TransportConfig, seed: int = 0) -> FaceTable:
    """The face table to keep for all frames that share a static scene."""
    return FaceTable(scene.static.meshes, scene.static.caster, config, seed)


def trace_transport(
    scene: FrameScene,
    gbuffers: GBuffers,
    config: TransportConfig,
    seed: int = 0,
    face_table: FaceTable | None = None,
) -> TransportTable:
    """Trace the ray table of one frame.

    Args:
        face_table: from `static_face_table` with the same config, shared by the frames of a
            log; without one it is made for this frame.
    """
    rows, columns, index = _traced_pixels(gbuffers.has_surface, config.shading_step_px)
    positions = gbuffers.position_world[rows, columns]
    normals = gbuffers.normal_world[rows, columns]
    shifts = _pixel_shifts(rows, columns, config.shading_step_px, seed)
    points = trace_points(scene, positions, normals, shifts, config, face_table)
    has_surface = gbuffers.has_surface
    pixel = np.flatnonzero(has_surface)
    traced = TracedPixels(
        index, np.concatenate([positions, normals], axis=1), int(has_surface.shape[1])
    )
    spread = traced.spread(
        pixel,
        gbuffers.position_world[has_surface],
        gbuffers.normal_world[has_surface],
        gbuffers.depth_z_m[has_surface],
        config,
    )
    occlusion = np.ones(has_surface.shape, dtype=np.float32)
    occlusion[has_surface] = spread(points.openness[:, None])[:, 0]
    return TransportTable(points, pixel, spread, occlusion)


def trace_points(
    scene: FrameScene,
    points_world: Float32[np.ndarray, "n 3"],
    normals_world: Float32[np.ndarray, "n 3"],
    shifts: Float32[np.ndarray, "n 2"],
    config: TransportConfig,
    face_table: FaceTable | None = None,
) -> PointTable:
    """Trace the rays of surface points; `shifts` in [0, 1) turn each point's ray pattern."""
    rays = config.sky_rays
    cells = np.empty((len(points_world), rays), dtype=np.uint16)
    sides = np.full((len(points_world), rays), OPEN, dtype=np.int32)
    caster = scene.caster
    first_face = np.cumsum([0] + [len(mesh.faces) for mesh in scene.meshes])[:-1]
    tile = max(1, _TILE_RAYS // rays)
    for start in range(0, len(points_world), tile):
        part = slice(start, start + tile)
        directions, cells[part] = hemisphere_directions(
            normals_world[part], shifts[part], rays, config.sky_cell_rows
        )
        origins = offset_origins(points_world[part], normals_world[part], config.origin_offset_m)
        found = _met_sides(caster, scene, first_face, np.repeat(origins, rays, axis=0), directions)
        sides[part] = found.reshape(-1, rays)
    table = face_table or static_face_table(scene, config)
    return PointTable(cells, *_compact(sides, scene, table, config))


def _met_sides(
    caster: RayCaster,
    scene: FrameScene,
    first_face: Int64[np.ndarray, " m"],
    origins: Float32[np.ndarray, "r 3"],
    directions: Float32[np.ndarray, "n k 3"],
) -> Int32[np.ndarray, " r"]:
    """Side (see `FaceTable.samples`, over all meshes of the scene) that each ray meets."""
    flat = directions.reshape(-1, 3)
    hits = caster.intersect(origins, flat)
    rays = np.flatnonzero(hits.is_hit)
    face = first_face[hits.mesh_index[rays]] + hits.face_index[rays]
    is_back = _is_back(scene.meshes, hits.mesh_index[rays], hits.face_index[rays], flat[rays])
    sides = np.full(len(flat), OPEN, dtype=np.int32)
    sides[rays] = (2 * face + is_back).astype(np.int32)
    return sides


def _is_back(
    meshes: Sequence[TriMesh],
    mesh_index: Int32[np.ndarray, " n"],
    face_index: Int32[np.ndarray, " n"],
    directions: Float32[np.ndarray, "n 3"],
) -> Bool[np.ndarray, " n"]:
    """Whether a ray meets the clockwise side of its face."""
    from lightsim.render.transport_kernels import meets_back

    is_back = np.zeros(len(mesh_index), dtype=np.bool_)
    for k, mesh in enumerate(meshes):
        if len(mesh.faces):
            meets_back(k, mesh.vertices, mesh.faces, mesh_index, face_index, directions, is_back)
    return is_back


def _compact(
    sides: Int32[np.ndarray, "n k"], scene: FrameScene, static: FaceTable, config: TransportConfig
) -> tuple[Int32[np.ndarray, "n k"], FaceSamples]:
    """Sides numbered from 0 as they occur in this frame, and the samples of each."""
    total = 2 * sum(len(mesh.faces) for mesh in scene.meshes)
    is_met = np.zeros(total + 1, dtype=bool)
    is_met[sides.ravel()] = True
    is_met[total] = False
    met = np.flatnonzero(is_met)
    number = np.full(total + 1, OPEN, dtype=np.int32)
    number[met] = np.arange(len(met), dtype=np.int32)
    first_actor = 2 * static.face_count
    split = int(np.searchsorted(met, first_actor))
    actors = FaceTable(scene.actors, scene.caster, config, seed=1)
    parts = [static.samples(met[:split]), actors.samples(met[split:] - first_actor)]
    faces = FaceSamples(
        np.concatenate([p.sun_points_world for p in parts]),
        np.concatenate([p.normals_world for p in parts]),
        np.concatenate([p.base_colour for p in parts]),
        np.concatenate([p.sky_cells for p in parts]),
    )
    return number[sides], faces


def _traced_pixels(
    has_surface: Bool[np.ndarray, "h w"], step: int
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"], Int32[np.ndarray, "hb wb"]]:
    """One pixel with a surface in every block of step x step: the first in reading order from
    the middle. Returns rows, columns, and the number of each block's pixel or -1."""
    height, width = has_surface.shape
    blocks = (-(-height // step), -(-width // step))
    row = np.full(blocks, -1, dtype=np.int64)
    column = np.full(blocks, -1, dtype=np.int64)
    shifts = [(step // 2 + k) % step for k in range(step)]
    base_row, base_column = np.meshgrid(*[np.arange(b) * step for b in blocks], indexing="ij")
    for dr in shifts:
        for dc in shifts:
            r = np.minimum(base_row + dr, height - 1)
            c = np.minimum(base_column + dc, width - 1)
            take = (row < 0) & has_surface[r, c]
            row[take], column[take] = r[take], c[take]
    is_traced = row >= 0
    index = np.full(blocks, -1, dtype=np.int32)
    index[is_traced] = np.arange(int(is_traced.sum()), dtype=np.int32)
    return row[is_traced], column[is_traced], index


def _pixel_shifts(
    rows: Int64[np.ndarray, " n"], columns: Int64[np.ndarray, " n"], step: int, seed: int
) -> Float32[np.ndarray, "n 2"]:
    """One coordinate by interleaved gradient noise (Jimenez 2014), which covers [0, 1) evenly in
    every 3x3 neighbourhood, as the smoothing afterwards wants; the other by hashing, since two
    such patterns together show as stripes."""
    offset = np.random.default_rng(seed).random(2) * 64.0
    i, j = rows // step + offset[0], columns // step + offset[1]
    u = (52.9829189 * ((0.06711056 * j + 0.00583715 * i) % 1.0)) % 1.0
    numbers = (rows // step) * (1 << 20) + columns // step
    return np.stack([u, hashed_shifts(numbers, seed)[:, 0]], axis=1).astype(np.float32)
