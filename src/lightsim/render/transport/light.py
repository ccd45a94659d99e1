"""Light of one sky on a traced frame: matrix sums for sky and bounce, rays for the sun."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome, Sun
from lightsim.render.scene import FrameScene
from lightsim.render.transport.faces import FaceSamples
from lightsim.render.transport.lobes import pixel_lobes, sun_in_lobes
from lightsim.render.transport.matrix import PointTransport, TransportConfig, TransportMatrix
from lightsim.render.transport.resolve import resolve
from lightsim.render.transport.sky import EnvironmentCells, prepare_sky
from lightsim.render.transport.sun import sun_in_scene, unshadowed_sun


def light(
    table: TransportMatrix,
    scene: FrameScene,
    gbuffers: GBuffers,
    sky: SkyDome | EnvironmentCells,
    config: TransportConfig,
) -> ShadowBuffers:
    """Return the shaded and unshadowed images of one frame under one sky (paper, Sec. 4).

    The sky part and the bounce are linear in the dome. `unshadowed` sums the same rays as `sky`
    without their visibility. Therefore the shadow ratio S <= 1 holds for every pixel and not only
    on average, with S = 1 without occlusion. Rays below the horizon that meet no geometry have the
    radiance of the dome there.

    Args:
        table: from `trace_transport` with the same scene, buffers and config; with samples, the
            light is the mean over each pixel's surfaces.
        sky: a dome, or the result of `prepare_sky`, which saves time for many frames.
    """
    cells = prepare_sky(sky) if isinstance(sky, SkyDome) else sky
    # The light of the faces comes first, since it is the bounce of the traced points.
    radiosity = face_radiosity(table.points.faces, scene, cells)
    sums = table_sums(table.points, cells, radiosity)
    images = np.zeros((gbuffers.depth_z_m.size, 9), dtype=np.float32)
    table.upsampling.add(sums, images, table.pixel)
    images = images.reshape(*gbuffers.depth_z_m.shape, 9)
    reflected = _reflected(table, cells, radiosity, gbuffers)
    if table.detail is None:
        shadows = _at_centres(images, scene, gbuffers, cells, config)
    else:
        shadows = resolve(table.detail, scene, gbuffers, (cells, radiosity, sums, images), config)
    return shadows if reflected is None else _with_reflections(shadows, *reflected)


def _reflected(
    table: TransportMatrix,
    cells: EnvironmentCells,
    radiosity: Float32[np.ndarray, "f 3"],
    gbuffers: GBuffers,
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"]] | None:
    """Return the radiance that wide lobes reflect at pixel centres: of sky and surfaces, and of the
    sun.

    The sun's part is without visibility. None if no lobe was traced.
    """
    if table.points.reflections is None:
        return None
    shape = gbuffers.depth_z_m.shape
    rest = np.zeros((gbuffers.depth_z_m.size, 3), dtype=np.float32)
    table.upsampling.add(table.points.reflections.light(cells, radiosity), rest, table.pixel)
    sun = np.zeros_like(rest)
    if cells.sun is not None:
        # The highlight of a smooth surface covers few pixels. On a reconstructed body, whose
        # normals have errors of degrees, it would cover many. Samples add it in `resolve`.
        lobes = pixel_lobes(gbuffers, table.pixel, is_rough_only=True)
        assert lobes is not None
        sun[table.pixel] = sun_in_lobes(lobes, cells.sun)
    return rest.reshape(*shape, 3), sun.reshape(*shape, 3)


def _with_reflections(
    shadows: ShadowBuffers, rest: Float32[np.ndarray, "h w 3"], sun: Float32[np.ndarray, "h w 3"]
) -> ShadowBuffers:
    glossy = shadows.reflected + rest + shadows.sun_visibility[..., None] * sun
    return replace(shadows, glossy=glossy, glossy_sun=sun)


def _at_centres(
    images: Float32[np.ndarray, "h w 9"],
    scene: FrameScene,
    gbuffers: GBuffers,
    cells: EnvironmentCells,
    config: TransportConfig,
) -> ShadowBuffers:
    """Return the light at pixel centres: sky, bounce, unshadowed sky, and the sun."""
    open_sky, bounce, sky_unshadowed = (images[..., i : i + 3] for i in (0, 3, 6))
    visibility = np.zeros(gbuffers.depth_z_m.shape, dtype=np.float32)
    sun_image = np.zeros((*visibility.shape, 3), dtype=np.float32)
    if cells.sun is not None:
        has_surface = gbuffers.has_surface
        normals = gbuffers.normal_world[has_surface]
        # The light in shade decides how uncertain shadows of roofs are averaged.
        shade = luminance((open_sky + bounce)[has_surface])
        visibility[has_surface] = sun_in_scene(
            scene, gbuffers.ray_starts_world[has_surface], normals, cells.sun, config, shade
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


def table_sums(
    table: PointTransport, cells: EnvironmentCells, radiosity: Float32[np.ndarray, "f 3"]
) -> Float32[np.ndarray, "n 9"]:
    """Return open sky, bounce and unshadowed sky of each point, irradiance / pi, in three columns
    each."""
    from lightsim.render.transport.kernels import point_light

    if table.on_device is not None:
        return table.on_device.point_light(cells.radiance, radiosity)
    out = np.empty((len(table.sky_cells), 9), dtype=np.float32)
    point_light(table.sky_cells, table.face_rows, cells.radiance, radiosity, out)
    return out


def face_radiosity(
    faces: FaceSamples, scene: FrameScene, cells: EnvironmentCells
) -> Float32[np.ndarray, "f 3"]:
    """Return the radiance of each face: base colour times irradiance / pi of sky, sun and other
    faces.

    With further bounces the radiosity equation F = rho (E + K F) is iterated (Jacobi; Cohen &
    Wallace 1993, ch. 5), one iteration a bounce. K is the mean over each face's own rays, so no ray
    is traced.
    """
    from lightsim.render.transport.kernels import face_bounce, face_light

    if faces.sky_cells.shape[1] == 0:
        return np.zeros_like(faces.base_colour)
    arriving = np.zeros_like(faces.base_colour)
    face_light(faces.sky_cells, cells.radiance, arriving)
    if cells.sun is not None and len(arriving):
        arriving += _sun_on_faces(faces, scene, cells.sun)
    first = (faces.base_colour * arriving).astype(np.float32)
    radiosity = first
    if faces.next_rows is None:
        return first
    from_faces = np.empty_like(first)
    for _ in range(faces.bounces - 1):
        face_bounce(faces.next_rows, radiosity, from_faces)
        radiosity = first + faces.base_colour * from_faces
    return radiosity


def _sun_on_faces(faces: FaceSamples, scene: FrameScene, sun: Sun) -> Float32[np.ndarray, "f 3"]:
    """Return irradiance / pi of the sun's centre, as the mean over each face's sun points."""
    arriving = unshadowed_sun(faces.normals_world, sun)
    # Only faces that face the sun need rays.
    lit = np.flatnonzero(arriving.any(axis=1))
    count = faces.sun_points_world.shape[1]
    origins = faces.sun_points_world[lit].reshape(-1, 3)
    towards = np.broadcast_to(sun.direction_world.astype(np.float32), origins.shape)
    # One ray to the disc's centre: penumbrae on faces average out in the bounce.
    caster, roofs = scene.certain_sun_occluders(sun)
    visible = (~caster.is_occluded(origins, towards)).astype(np.float32)
    if roofs is not None:
        rows = np.flatnonzero(visible)
        visible[rows] *= roofs.open_fraction(origins[rows], sun)
    arriving[lit] *= visible.reshape(-1, count).mean(axis=1)[:, None]
    return arriving
