"""Light of one sky on the samples of pixels, averaged to pixels."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.dome import Sun
from lightsim.render.embree import offset_origins
from lightsim.render.faces import TransportConfig, hashed_shifts
from lightsim.render.glossy import reflected_sun
from lightsim.render.light import (
    PATTERNS,
    TILE_RAYS,
    SkyCells,
    disc_patterns,
)
from lightsim.render.samples import PixelSamples
from lightsim.render.scene import FrameScene
from lightsim.render.transport import SampleTable


def resolve(
    detail: SampleTable,
    scene: FrameScene,
    gbuffers: GBuffers,
    arrived: tuple[
        SkyCells,
        Float32[np.ndarray, "f 3"],
        Float32[np.ndarray, "t 9"],
        Float32[np.ndarray, "h w 9"],
    ],
    config: TransportConfig,
) -> ShadowBuffers:
    """Means over the samples of each pixel.

    Sky and bounce light at pixel centres hold for all samples of a pixel, except at edges, where
    every sample gets its own. Sun rays start from every sample.

    Args:
        arrived: the sky; light of the faces met, of the traced points, and at pixel centres.
    """
    cells, radiosity, sums, images = arrived
    samples = detail.samples
    share = samples.share
    edge_rows = samples.edge.rows
    edge_light = detail.edge_spread(sums)
    at_edge = samples.pixel[edge_rows]
    flat = images.reshape(-1, 9)
    flat[at_edge] = 0
    images += samples.pixel_mean(edge_rows, edge_light, share)
    open_sky, bounce, sky_unshadowed = (images[..., i : i + 3] for i in (0, 3, 6))
    visible = np.zeros(len(samples.pixel), dtype=np.float32)
    sun = np.zeros((*samples.coverage.shape, 3), dtype=np.float32)
    edge_sun = np.zeros((len(edge_rows), 3), dtype=np.float32)
    if cells.sun is not None:
        visible, cosine = _sun_on_samples(samples, scene, gbuffers, cells.sun, config)
        sun = samples.pixel_mean(
            slice(None), np.stack([visible, cosine * visible, cosine], axis=1), share
        )
        edge_sun = (cosine * visible)[edge_rows, None] * (cells.sun.irradiance / np.float32(np.pi))
    irradiance = (
        np.zeros(3, np.float32)
        if cells.sun is None
        else (cells.sun.irradiance / np.pi).astype(np.float32)
    )
    direct_sun = sun[..., 1:2] * irradiance
    shaded = direct_sun + open_sky + bounce
    diffuse = detail.base_colour * shaded
    diffuse.reshape(-1, 3)[at_edge] = 0
    edge_shaded = edge_sun + edge_light[:, :3] + edge_light[:, 3:6]
    diffuse += samples.pixel_mean(edge_rows, detail.edge_colour * edge_shaded, share)
    return ShadowBuffers(
        np.ascontiguousarray(sun[..., 0]),
        direct_sun,
        open_sky,
        bounce,
        shaded,
        sun[..., 2:] * irradiance + sky_unshadowed,
        samples.coverage,
        diffuse,
        _glossy(detail, cells, radiosity, visible, share),
    )


def _sun_on_samples(
    samples: PixelSamples,
    scene: FrameScene,
    gbuffers: GBuffers,
    sun: Sun,
    config: TransportConfig,
) -> tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
    """Fraction of the solar disc that each sample sees, and the sun's cosine (0 behind).

    The samples of a pixel share `sun_rays` points on the disc, at least one each.
    """
    rays = max(1, config.sun_rays // samples.per_pixel)
    patterns = disc_patterns(sun, rays * samples.per_pixel)
    direction = (sun.direction_world / np.linalg.norm(sun.direction_world)).astype(np.float32)
    centre_normals = gbuffers.normal_world.reshape(-1, 3)
    visible = np.zeros(len(samples.pixel), dtype=np.float32)
    cosine = np.maximum(centre_normals @ direction, 0)[samples.pixel]
    cosine[samples.edge.rows] = np.maximum(samples.edge.normal_world @ direction, 0)
    facing = np.flatnonzero(cosine > 0)
    edge_row = np.full(len(samples.pixel), -1, dtype=np.int32)
    edge_row[samples.edge.rows] = np.arange(len(samples.edge.rows), dtype=np.int32)
    tile = max(1, TILE_RAYS // rays)
    for start in range(0, len(facing), tile):
        rows = facing[start : start + tile]
        pixel = samples.pixel[rows]
        normals = centre_normals[pixel]
        at_edge = edge_row[rows] >= 0
        normals[at_edge] = samples.edge.normal_world[edge_row[rows[at_edge]]]
        origins = offset_origins(samples.position_world[rows], normals, config.origin_offset_m)
        chosen = (hashed_shifts(pixel.astype(np.int64), 7)[:, 0] * PATTERNS).astype(np.int64)
        which = samples.number[rows, None] + samples.per_pixel * np.arange(rays)
        directions = patterns[chosen[:, None], which].reshape(-1, 3)
        occluded = scene.caster.is_occluded(np.repeat(origins, rays, axis=0), directions)
        visible[rows] = 1 - occluded.reshape(-1, rays).mean(axis=1, dtype=np.float32)
    return visible, cosine


def _glossy(
    detail: SampleTable,
    cells: SkyCells,
    radiosity: Float32[np.ndarray, "f 3"],
    visible: Float32[np.ndarray, " n"],
    share: Float32[np.ndarray, " p"],
) -> Float32[np.ndarray, "h w 3"] | None:
    """Mean radiance that the samples reflect; None where reflections are left out."""
    from lightsim.render.glossy_kernels import reflected_light

    if detail.glossy is None:
        return None
    table, smoothing = detail.glossy
    samples = detail.samples
    points = samples.glossy
    assert cells.smooth is not None
    rays = np.empty((len(points.rows), 3), dtype=np.float32)
    reflected_light(
        table.directions_uv, table.face_rows, table.weights, table.f0, cells.smooth, radiosity, rays
    )
    image = smoothing(samples.pixel_mean(points.rows, rays, share))
    if cells.sun is not None:
        sun = reflected_sun(points, table.f0, cells.sun) * visible[points.rows, None]
        image += samples.pixel_mean(points.rows, sun, share)
    return image
