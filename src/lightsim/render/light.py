"""One sky's light on a traced frame: table sums for the sky and the bounce, rays for the sun."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.casting import RayCaster
from lightsim.core.dome import SkyDome, Sun, disc_directions, split_sun
from lightsim.core.equirect import solid_angles_sr
from lightsim.core.resample import resize_area
from lightsim.render.embree import offset_origins
from lightsim.render.faces import FaceSamples, hashed_shifts
from lightsim.render.scene import FrameScene
from lightsim.render.transport import PointTable, TransportConfig, TransportTable

TILE_RAYS = 1 << 19
PATTERNS = 64
_REFLECTED_ROWS = 512


@dataclass(frozen=True, eq=False)
class SkyCells:
    """A dome ready for the ray table; make it once for all frames with `prepare_sky`.

    Args:
        radiance: mean radiance of every sky cell, the sun left out.
        sun: the sun, if the dome has one.
        smooth: the sky without its sun at its own resolution (at most 512 rows), for reflections.
    """

    radiance: Float32[np.ndarray, "c 3"]
    sun: Sun | None
    smooth: Float32[np.ndarray, "h w 3"] | None = None


@dataclass(frozen=True, eq=False)
class PointLight:
    """Light on n points, irradiance / pi (see `core.buffers.ShadowBuffers`)."""

    sun_visibility: Float32[np.ndarray, " n"]
    direct_sun: Float32[np.ndarray, "n 3"]
    sky: Float32[np.ndarray, "n 3"]
    bounce: Float32[np.ndarray, "n 3"]
    sky_unshadowed: Float32[np.ndarray, "n 3"]


def prepare_sky(dome: SkyDome, config: TransportConfig) -> SkyCells:
    """Mean radiance of each sky cell by solid angle, and the sun; energy is kept."""
    rest, sun = split_sun(dome)
    rows = config.sky_cell_rows
    solid = np.broadcast_to(
        solid_angles_sr(dome.height_px).astype(np.float32)[..., None], (*rest.shape[:2], 1)
    )
    mean = resize_area(rest * solid, rows, 2 * rows) / resize_area(solid.copy(), rows, 2 * rows)
    smooth = rest
    if len(rest) > _REFLECTED_ROWS:
        smooth = resize_area(rest, _REFLECTED_ROWS, 2 * _REFLECTED_ROWS)
    return SkyCells(mean.astype(np.float32).reshape(-1, 3), sun, smooth)


def light(
    table: TransportTable,
    scene: FrameScene,
    gbuffers: GBuffers,
    sky: SkyDome | SkyCells,
    config: TransportConfig,
) -> ShadowBuffers:
    """Shaded and unshadowed images of one frame under one sky (paper, Sec. 3.3).

    The sky part and the bounce are linear in the dome. `unshadowed` sums the same rays as
    `sky` without their visibility, so that S <= 1, and S = 1 where nothing occludes, hold
    for every pixel and not just on average. Below the horizon the dome's own radiance is used
    where no geometry is met.

    Args:
        table: from `trace_transport` with the same scene, buffers and config; with samples, the
            light is the mean over each pixel's surfaces, and reflections are added.
        sky: a dome, or the result of `prepare_sky`, which saves time for many frames.
    """
    cells = prepare_sky(sky, config) if isinstance(sky, SkyDome) else sky
    radiosity = face_radiosity(table.points.faces, scene.caster, cells)
    sums = table_sums(table.points, cells, radiosity)
    images = np.zeros((gbuffers.depth_z_m.size, 9), dtype=np.float32)
    table.spread.add(sums, images, table.pixel)
    images = images.reshape(*gbuffers.depth_z_m.shape, 9)
    if table.detail is None:
        return _at_centres(images, scene, gbuffers, cells, config)
    from lightsim.render.resolve import resolve

    return resolve(table.detail, scene, gbuffers, (cells, radiosity, sums, images), config)


def _at_centres(
    images: Float32[np.ndarray, "h w 9"],
    scene: FrameScene,
    gbuffers: GBuffers,
    cells: SkyCells,
    config: TransportConfig,
) -> ShadowBuffers:
    """Light at pixel centres: sky, bounce and unshadowed sky, and the sun."""
    open_sky, bounce, sky_unshadowed = (images[..., i : i + 3] for i in (0, 3, 6))
    visibility = np.zeros(gbuffers.depth_z_m.shape, dtype=np.float32)
    sun_image = np.zeros((*visibility.shape, 3), dtype=np.float32)
    if cells.sun is not None:
        has_surface = gbuffers.has_surface
        normals = gbuffers.normal_world[has_surface]
        visibility[has_surface] = sun_visibility(
            scene.caster, gbuffers.ray_starts_world[has_surface], normals, cells.sun, config
        )
        sun_image[has_surface] = unshadowed_sun(normals, cells.sun)
    direct_sun = sun_image * visibility[..., None]
    return ShadowBuffers(
        visibility,
        direct_sun,
        open_sky,
        bounce,
        direct_sun + open_sky + bounce,
        sun_image + sky_unshadowed,
    )


def light_points(
    table: PointTable,
    scene: FrameScene,
    points_world: Float32[np.ndarray, "n 3"],
    normals_world: Float32[np.ndarray, "n 3"],
    cells: SkyCells,
    config: TransportConfig,
) -> PointLight:
    """Light of one sky on traced points."""
    sums = light_table(table, scene.caster, cells, config)
    visibility = np.zeros(len(points_world), dtype=np.float32)
    sun = np.zeros((len(points_world), 3), dtype=np.float32)
    if cells.sun is not None:
        visibility = sun_visibility(scene.caster, points_world, normals_world, cells.sun, config)
        sun = unshadowed_sun(normals_world, cells.sun) * visibility[:, None]
    return PointLight(visibility, sun, sums[:, :3], sums[:, 3:6], sums[:, 6:])


def light_table(
    table: PointTable, caster: RayCaster, cells: SkyCells, config: TransportConfig
) -> Float32[np.ndarray, "n 9"]:
    """Open sky, bounce and unshadowed sky of each point, irradiance / pi."""
    return table_sums(table, cells, face_radiosity(table.faces, caster, cells))


def table_sums(
    table: PointTable, cells: SkyCells, radiosity: Float32[np.ndarray, "f 3"]
) -> Float32[np.ndarray, "n 9"]:
    """The same, with the light of the faces known."""
    from lightsim.render.transport_kernels import point_light

    if table.bag is not None:
        return table.bag.point_light(cells.radiance, radiosity)
    out = np.empty((len(table.sky_cells), 9), dtype=np.float32)
    point_light(table.sky_cells, table.face_rows, cells.radiance, radiosity, out)
    return out


def face_radiosity(
    faces: FaceSamples, caster: RayCaster, cells: SkyCells
) -> Float32[np.ndarray, "f 3"]:
    """Radiance that each face sends out: base colour x (sky + sun + other faces) irradiance / pi.

    With further bounces the radiosity equation F = rho (E + K F) is iterated (Jacobi; Cohen &
    Wallace 1993, ch. 5), one iteration a bounce: K is the mean over each face's own rays, so no
    ray is traced.
    """
    from lightsim.render.transport_kernels import face_bounce, face_light

    if faces.sky_cells.shape[1] == 0:
        return np.zeros_like(faces.base_colour)
    arriving = np.zeros_like(faces.base_colour)
    face_light(faces.sky_cells, cells.radiance, arriving)
    if cells.sun is not None and len(arriving):
        arriving += _sun_on_faces(faces, caster, cells.sun)
    first = (faces.base_colour * arriving).astype(np.float32)
    radiosity = first
    if faces.next_rows is None:
        return first
    from_faces = np.empty_like(first)
    for _ in range(faces.bounces - 1):
        face_bounce(faces.next_rows, radiosity, from_faces)
        radiosity = first + faces.base_colour * from_faces
    return radiosity


def _sun_on_faces(faces: FaceSamples, caster: RayCaster, sun: Sun) -> Float32[np.ndarray, "f 3"]:
    """Irradiance / pi of the sun's centre, mean over each face's sun points."""
    arriving = unshadowed_sun(faces.normals_world, sun)
    lit = np.flatnonzero(arriving.any(axis=1))
    count = faces.sun_points_world.shape[1]
    origins = faces.sun_points_world[lit].reshape(-1, 3)
    towards = np.broadcast_to(sun.direction_world.astype(np.float32), origins.shape)
    is_open = ~caster.is_occluded(origins, towards)
    arriving[lit] *= is_open.reshape(-1, count).mean(axis=1, dtype=np.float32)[:, None]
    return arriving


def unshadowed_sun(normals_world: Float[np.ndarray, "n 3"], sun: Sun) -> Float32[np.ndarray, "n 3"]:
    """Irradiance / pi of the sun by the cosine law."""
    direction = sun.direction_world / np.linalg.norm(sun.direction_world)
    cosine = np.maximum(normals_world @ direction.astype(np.float32), 0.0)
    return (cosine[:, None] * (sun.irradiance / np.pi)).astype(np.float32)


def sun_visibility(
    caster: RayCaster,
    points_world: Float32[np.ndarray, "n 3"],
    normals_world: Float32[np.ndarray, "n 3"],
    sun: Sun,
    config: TransportConfig,
) -> Float32[np.ndarray, " n"]:
    """Fraction of the solar disc that each point sees; 0 where the sun stands behind the surface.

    The disc is sampled at `sun_rays` points, turned by a fixed pseudo-random angle per point:
    neighbouring pixels differ, frames of a sequence do not flicker.
    """
    direction = (sun.direction_world / np.linalg.norm(sun.direction_world)).astype(np.float32)
    facing = np.flatnonzero(normals_world @ direction > 0)
    patterns = disc_patterns(sun, config.sun_rays)
    visible = np.zeros(len(points_world), dtype=np.float32)
    tile = max(1, TILE_RAYS // config.sun_rays)
    for start in range(0, len(facing), tile):
        rows = facing[start : start + tile]
        chosen = (hashed_shifts(rows, 7)[:, 0] * PATTERNS).astype(np.int64)
        origins = offset_origins(points_world[rows], normals_world[rows], config.origin_offset_m)
        occluded = caster.is_occluded(
            np.repeat(origins, config.sun_rays, axis=0), patterns[chosen].reshape(-1, 3)
        )
        visible[rows] = 1 - occluded.reshape(-1, config.sun_rays).mean(axis=1, dtype=np.float32)
    return visible


def disc_patterns(sun: Sun, count: int) -> Float32[np.ndarray, "p k 3"]:
    """Sample directions on the solar disc, turned about its centre by PATTERNS angles."""
    axis = sun.direction_world / np.linalg.norm(sun.direction_world)
    disc = disc_directions(axis, sun.angular_radius_deg, count)
    along = (disc @ axis)[:, None] * axis
    across = disc - along
    angle = (np.arange(PATTERNS) / PATTERNS * 2 * np.pi)[:, None, None]
    turned = along + np.cos(angle) * across + np.sin(angle) * np.cross(axis, across)
    return turned.astype(np.float32)
