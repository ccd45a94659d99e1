"""Light transport matrix: light is linear in the sky, so rays are traced once for all skies.

For every traced pixel, N cosine-distributed rays are stored as the environment cell they point at
and the face they meet, if any. For every face met, M rays are stored likewise. A sky then costs
sums of table look-ups and a few sun rays (`render.transport.light`). One bounce between surfaces or
more; further rays over the points' specular lobes (`render.transport.lobes`). This is precomputed
radiance transfer (Sloan et al. 2002, doi:10.1145/566654.566612) with environment cells as its
basis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64, UInt16

from lightsim.core.buffers import GBuffers
from lightsim.render.casters.embree import offset_origins
from lightsim.render.scene import FrameScene
from lightsim.render.transport.faces import (
    SKY_CELL_ROWS,
    TILE_RAYS,
    FaceSamples,
    FaceTable,
    TransportConfig,
    hemisphere_directions,
    pixel_shifts,
)
from lightsim.render.transport.glossy import (
    ReflectionSmoothing,
    diffuse_fraction,
    reflection_smoothing,
    trace_glossy,
)
from lightsim.render.transport.lobes import Lobes, LobeTable, pixel_lobes, trace_lobes
from lightsim.render.transport.matrix_torch import TorchTransport
from lightsim.render.transport.samples import PixelSamples
from lightsim.render.transport.sides import OPEN, SideFinder
from lightsim.render.transport.upsampling import BilateralUpsampling, TracedPixels


def exact() -> TransportConfig:
    """Return a config that traces every pixel and smooths nothing, for tests and comparisons."""
    return TransportConfig(sky_rays=64, shading_step_px=1, filter_radius=0)


@dataclass(frozen=True, eq=False)
class PointTransport:
    """Rays of n points.

    Args:
        sky_cells: environment cell that each ray points at.
        face_rows: row in `faces` of the face that each ray meets, or OPEN.
        faces: all faces that the rays meet.
        on_device: the rays on another device, if it computes their sums.
        reflections: further rays of the same points, over their specular lobes.
    """

    sky_cells: UInt16[np.ndarray, "n k"]
    face_rows: Int32[np.ndarray, "n k"]
    faces: FaceSamples
    on_device: TorchTransport | None = None
    reflections: LobeTable | None = None

    @property
    def sky_view_factor(self) -> Float32[np.ndarray, " n"]:
        """Cosine-weighted open fraction of the hemisphere."""
        return (self.face_rows == OPEN).mean(axis=1, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class SampleTable:
    """Light transport to the samples of pixels; see `render.transport.samples`.

    Args:
        samples: of the frame.
        edge_upsampling: from the traced pixels to samples at edges.
        base_colour: of diffuse reflection, mean over each pixel's samples.
        edge_colour: base colour of diffuse reflection of each sample at edges.
        glossy: rays of reflecting samples and the smoothing of their noise; None without
            reflections.
    """

    samples: PixelSamples
    edge_upsampling: BilateralUpsampling
    base_colour: Float32[np.ndarray, "h w 3"]
    edge_colour: Float32[np.ndarray, "e 3"]
    glossy: tuple[LobeTable, ReflectionSmoothing] | None


@dataclass(frozen=True, eq=False)
class TransportMatrix:
    """Light transport matrix of one frame.

    Args:
        points: rays of the traced pixels.
        pixel: flat numbers of the pixels with a surface at their centre.
        upsampling: from the traced pixels to these pixels.
        ambient_occlusion: open fraction of the hemisphere of every pixel; sky 1.
        detail: transport to pixel samples, for anti-aliased images and reflections.
    """

    points: PointTransport
    pixel: Int64[np.ndarray, " p"]
    upsampling: BilateralUpsampling
    ambient_occlusion: Float32[np.ndarray, "h w"]
    detail: SampleTable | None = None


def static_face_table(scene: FrameScene, config: TransportConfig, seed: int = 0) -> FaceTable:
    """Return a new face table for all frames of a static scene."""
    return FaceTable(scene.static.meshes, scene.static.caster, config, seed)


def actor_face_table(scene: FrameScene, config: TransportConfig) -> FaceTable:
    """Return a new face table of a scene's actors, whose rays meet the whole scene."""
    return FaceTable(scene.actors, scene.caster, config, seed=1)


def trace_transport(
    scene: FrameScene,
    gbuffers: GBuffers,
    config: TransportConfig,
    seed: int = 0,
    face_table: FaceTable | None = None,
    samples: PixelSamples | None = None,
    corner_px: tuple[int, int] = (0, 0),
    actor_faces: FaceTable | None = None,
) -> TransportMatrix:
    """Trace the light transport matrix of one frame.

    Args:
        face_table: from `static_face_table` with the same config, common to the frames of a log;
            None: a new one.
        samples: from `render.transport.samples`, for anti-aliased images and reflections.
        corner_px: column and row of the first pixel in the whole image, so that a window has the
            ray pattern of the whole.
        actor_faces: from `actor_face_table`, common to all frames of one scene; None: a new one.
    """
    rows, columns, index = _traced_pixels(gbuffers.has_surface, config.shading_step_px)
    positions = gbuffers.ray_starts_world[rows, columns]
    normals = gbuffers.normal_world[rows, columns]
    left, top = corner_px
    shifts = pixel_shifts(rows + top, columns + left, config.shading_step_px, seed)
    finder = SideFinder(scene.caster)
    cells, sides = _trace(finder, positions, normals, shifts, config)
    glossy = reflections = None
    if samples is not None and len(samples.glossy.rows):
        glossy = trace_glossy(finder, samples, config, seed)
    traced_pixel = rows * gbuffers.has_surface.shape[1] + columns
    lobes = pixel_lobes(gbuffers, traced_pixel, is_rough_only=samples is not None)
    if lobes is not None and config.glossy_rays:
        reflections = trace_lobes(finder, lobes, shifts, config.glossy_rays)
    static = face_table or static_face_table(scene, config)
    # All kinds of rays refer to one list of faces, whose light is computed once per sky.
    met = [sides, *(table.face_rows for table in (glossy, reflections) if table is not None)]
    tables = static, actor_faces or actor_face_table(scene, config)
    faces = _compact(met, scene, tables, config)
    # Only the sums over pixel rays run on the device; the light of faces is summed on the CPU.
    on_device = None
    if config.device != "cpu":
        cell_count = 2 * SKY_CELL_ROWS**2
        on_device = TorchTransport(cells, sides, cell_count, config.device)
    points = PointTransport(cells, sides, faces, on_device, reflections)
    has_surface = gbuffers.has_surface
    traced = TracedPixels(
        index, np.concatenate([positions, normals], axis=1), int(has_surface.shape[1])
    )
    pixel = np.flatnonzero(has_surface)
    upsampling = traced.upsampling_to_centres(pixel, gbuffers, config)
    occlusion = np.ones(has_surface.shape, dtype=np.float32)
    occlusion[has_surface] = upsampling(points.sky_view_factor[:, None])[:, 0]
    detail = None if samples is None else _detail(samples, gbuffers, traced, glossy, config)
    return TransportMatrix(points, pixel, upsampling, occlusion, detail)


def _detail(
    samples: PixelSamples,
    gbuffers: GBuffers,
    traced: TracedPixels,
    glossy: LobeTable | None,
    config: TransportConfig,
) -> SampleTable:
    edge = samples.edge
    upsampling = traced.upsampling(
        samples.pixel[edge.rows],
        samples.ray_starts_world[edge.rows],
        edge.normal_world,
        edge.depth_z_m,
        config,
    )
    if glossy is None:
        return SampleTable(samples, upsampling, samples.base_colour, edge.base_colour, None)
    # Smooth samples lose the energy of their reflections from their diffuse base colour.
    diffuse = samples.glossy.base_colour * diffuse_fraction(samples, glossy)
    lost = diffuse - samples.glossy.base_colour
    # Means over pixels are corrected by the difference, without another sum over all samples.
    colour = samples.add_means(
        samples.base_colour.copy(), samples.glossy.rows, lost, samples.fraction
    )
    by_sample = np.full(len(samples.pixel), OPEN, dtype=np.int32)
    by_sample[samples.glossy.rows] = np.arange(len(diffuse), dtype=np.int32)
    row = by_sample[edge.rows]
    edge_colour = np.where((row >= 0)[:, None], diffuse[row], edge.base_colour)
    smoothing = reflection_smoothing(samples, gbuffers, config)
    return SampleTable(samples, upsampling, np.maximum(colour, 0), edge_colour, (glossy, smoothing))


def trace_points(
    scene: FrameScene,
    surface: Lobes,
    shifts: Float32[np.ndarray, "n 2"],
    config: TransportConfig,
    face_table: FaceTable | None = None,
) -> PointTransport:
    """Trace the rays of surface points, and those over the specular lobes of reflecting points.

    `shifts` in [0, 1) offset each point's ray pattern.
    """
    finder = SideFinder(scene.caster)
    cells, sides = _trace(finder, surface.ray_starts_world, surface.normal_world, shifts, config)
    met, reflections = [sides], None
    if config.glossy_rays and surface.f0.any():
        reflections = trace_lobes(finder, surface, shifts, config.glossy_rays)
        met.append(reflections.face_rows)
    # Actors move, so their faces are traced for each scene.
    tables = face_table or static_face_table(scene, config), actor_face_table(scene, config)
    faces = _compact(met, scene, tables, config)
    return PointTransport(cells, sides, faces, None, reflections)


def _trace(
    finder: SideFinder,
    points_world: Float32[np.ndarray, "n 3"],
    normals_world: Float32[np.ndarray, "n 3"],
    shifts: Float32[np.ndarray, "n 2"],
    config: TransportConfig,
) -> tuple[UInt16[np.ndarray, "n k"], Int32[np.ndarray, "n k"]]:
    """Return the environment cell of each ray, and the side that it meets or OPEN."""
    rays = config.sky_rays
    cells = np.empty((len(points_world), rays), dtype=np.uint16)
    sides = np.full((len(points_world), rays), OPEN, dtype=np.int32)
    tile = max(1, TILE_RAYS // rays)
    for start in range(0, len(points_world), tile):
        part = slice(start, start + tile)
        directions, cells[part] = hemisphere_directions(normals_world[part], shifts[part], rays)
        origins = offset_origins(points_world[part], normals_world[part])
        found = finder.met(np.repeat(origins, rays, axis=0), directions.reshape(-1, 3))
        sides[part] = found.reshape(-1, rays)
    return cells, sides


def _compact(
    sides: Sequence[Int32[np.ndarray, "_ _"]],
    scene: FrameScene,
    tables: tuple[FaceTable, FaceTable],
    config: TransportConfig,
) -> FaceSamples:
    """Return samples of the sides that occur in this frame; `sides` become rows of them, in
    place."""
    from lightsim.render.transport.kernels import UNLISTED, fill_unlisted, mark_rows, renumber

    static, actors = tables
    # A mask over all sides is faster than sorting the sides of all rays.
    is_met = np.zeros(2 * sum(len(mesh.faces) for mesh in scene.meshes), dtype=np.bool_)
    for array in sides:
        mark_rows(array, is_met)
    met = np.flatnonzero(is_met)
    next_rows = None
    if config.bounces > 1:
        # The second level: faces that the rays of met faces meet.
        mark_rows(_next_sides(met, static, actors), is_met)
        met = np.flatnonzero(is_met)
        next_rows = _next_sides(met, static, actors)
    # Sides of a third level of faces are not listed; `fill_unlisted` replaces them.
    number = np.full(len(is_met), UNLISTED, dtype=np.int32)
    number[met] = np.arange(len(met), dtype=np.int32)
    for array in sides if next_rows is None else [*sides, next_rows]:
        renumber(array, number)
    if next_rows is not None:
        fill_unlisted(next_rows)
    # Sides of actors follow those of the static meshes.
    split = int(np.searchsorted(met, 2 * static.face_count))
    parts = [static.samples(met[:split]), actors.samples(met[split:] - 2 * static.face_count)]
    return FaceSamples(
        np.concatenate([p.sun_points_world for p in parts]),
        np.concatenate([p.normals_world for p in parts]),
        np.concatenate([p.base_colour for p in parts]),
        np.concatenate([p.sky_cells for p in parts]),
        np.concatenate([p.confidence for p in parts]),
        next_rows,
        config.bounces,
    )


def _next_sides(
    met: Int64[np.ndarray, " f"], static: FaceTable, actors: FaceTable
) -> Int32[np.ndarray, "f m"]:
    """Return the sides that the rays of met sides meet, numbered over all meshes of the scene."""
    first_actor = 2 * static.face_count
    split = int(np.searchsorted(met, first_actor))
    return np.concatenate(
        [static.next_sides(met[:split]), actors.next_sides(met[split:] - first_actor)]
    )


def _traced_pixels(
    has_surface: Bool[np.ndarray, "h w"], step: int
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"], Int32[np.ndarray, "hb wb"]]:
    """Return one pixel with a surface of every block of step x step.

    It is the first in reading order from the middle. Returns rows, columns, and the number of each
    block's pixel or -1.
    """
    height, width = has_surface.shape
    blocks = (-(-height // step), -(-width // step))
    row = np.full(blocks, -1, dtype=np.int64)
    column = np.full(blocks, -1, dtype=np.int64)
    # The middle pixel represents its block best; others are used at the border of a surface.
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
