"""Light of one sky on the samples of pixels, averaged to pixels."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.colour import luminance
from lightsim.core.dome import Sun
from lightsim.render.casters.embree import offset_origins
from lightsim.render.scene import FrameScene
from lightsim.render.transport.faces import TransportConfig
from lightsim.render.transport.glossy import glossy_lobes
from lightsim.render.transport.lobes import sun_in_lobes
from lightsim.render.transport.matrix import SampleTable
from lightsim.render.transport.samples import PixelSamples
from lightsim.render.transport.sky import EnvironmentCells
from lightsim.render.transport.sun import (
    TILE_RAYS,
    disc_patterns,
    pattern_numbers,
    unshadowed_sun,
    visibility_of_expected_code,
)


def resolve(
    detail: SampleTable,
    scene: FrameScene,
    gbuffers: GBuffers,
    arrived: tuple[
        EnvironmentCells,
        Float32[np.ndarray, "f 3"],
        Float32[np.ndarray, "t 9"],
        Float32[np.ndarray, "h w 9"],
    ],
    config: TransportConfig,
) -> ShadowBuffers:
    """Return means over the samples of each pixel.

    Sky and bounce light at pixel centres are used for all samples of a pixel, except at edges,
    where each sample has its own. Sun rays start from every sample.

    Args:
        arrived: the sky; radiance of the faces met; sums of the traced points, and at pixel
            centres.
    """
    cells, radiosity, sums, images = arrived
    samples = detail.samples
    fraction = samples.fraction
    edge_light = detail.edge_upsampling(sums)
    # Pixels at edges are replaced by the mean of their samples.
    images.reshape(-1, 9)[samples.pixel[samples.edge.rows]] = 0
    samples.add_means(images, samples.edge.rows, edge_light, fraction)
    open_sky, bounce, sky_unshadowed = (images[..., i : i + 3].copy() for i in (0, 3, 6))
    # Released before the sun's arrays are allocated: images of 9 channels are large.
    del images
    visible = np.zeros(len(samples.pixel), dtype=np.float32)
    sun = samples.black
    edge_shaded = edge_light[:, :3] + edge_light[:, 3:6]
    sunlight = np.zeros(3, np.float32)
    if cells.sun is not None:
        sunlight = (cells.sun.irradiance / np.pi).astype(np.float32)
        shade = luminance(open_sky + bounce).reshape(-1)
        visible = _add_sun(sun, fraction, (samples, scene, gbuffers), (cells.sun, shade), config)
        edge_sun = unshadowed_sun(samples.edge.normal_world, cells.sun)
        edge_shaded += edge_sun * visible[samples.edge.rows, None]
    direct_sun = sun[..., 1:2] * sunlight
    shaded = direct_sun + open_sky + bounce
    return ShadowBuffers(
        sun[..., 0].copy(),
        direct_sun,
        open_sky,
        bounce,
        shaded,
        sun[..., 2:] * sunlight + sky_unshadowed,
        samples.coverage,
        _diffuse(detail, shaded, edge_shaded, fraction),
        _glossy(detail, cells, radiosity, visible, fraction),
    )


def _diffuse(
    detail: SampleTable,
    shaded: Float32[np.ndarray, "h w 3"],
    edge_shaded: Float32[np.ndarray, "e 3"],
    fraction: Float32[np.ndarray, " p"],
) -> Float32[np.ndarray, "h w 3"]:
    """Return mean radiance of diffuse reflection: colours differ within a pixel, light only at
    edges."""
    samples = detail.samples
    # Within a surface the mean of colour times light is the product of the means; not at edges.
    image = detail.base_colour * shaded
    image.reshape(-1, 3)[samples.pixel[samples.edge.rows]] = 0
    return samples.add_means(image, samples.edge.rows, detail.edge_colour * edge_shaded, fraction)


def _add_sun(
    image: Float32[np.ndarray, "h w 3"],
    fraction: Float32[np.ndarray, " p"],
    frame: tuple[PixelSamples, FrameScene, GBuffers],
    arriving: tuple[Sun, Float32[np.ndarray, " p"]],
    config: TransportConfig,
) -> Float32[np.ndarray, " n"]:
    """Return the visible fraction of the solar disc of each sample, 0 if it faces away from the
    sun.

    Three channels of `image` receive the means of that fraction, of it times the sun's cosine, and
    of the cosine. The samples of a pixel divide `sun_rays` points on the disc among them, at least
    one each.

    Args:
        fraction: weight of a sample in the mean of its pixel.
        arriving: the sun, and the luminance of other light at each pixel.
    """
    samples, scene, gbuffers = frame
    sun, shade = arriving
    # The rays are divided among the samples, so that a pixel costs the same with and without them.
    rays = max(1, config.sun_rays // samples.per_pixel)
    patterns = disc_patterns(sun, rays * samples.per_pixel)
    direction = (sun.direction_world / np.linalg.norm(sun.direction_world)).astype(np.float32)
    centre_normals = gbuffers.normal_world.reshape(-1, 3)
    caster, roofs = scene.certain_sun_occluders(sun)
    visible = np.zeros(len(samples.pixel), dtype=np.float32)
    edge_rows = samples.edge.rows
    tile = max(1, TILE_RAYS // rays)
    for start in range(0, len(visible), tile):
        part = slice(start, start + tile)
        # Samples of inner pixels have the normal of the pixel's centre; those at edges their own.
        normals = centre_normals[samples.pixel[part]]
        edges = slice(*np.searchsorted(edge_rows, (start, start + tile)))
        normals[edge_rows[edges] - start] = samples.edge.normal_world[edges]
        cosine = np.maximum(normals @ direction, 0)
        facing = np.flatnonzero(cosine > 0)
        pixel = samples.pixel[part][facing]
        origins = offset_origins(samples.ray_starts_world[part][facing], normals[facing])
        chosen = pattern_numbers(pixel.astype(np.int64))
        # Each sample takes other points of its pixel's pattern.
        which = samples.number[part][facing, None] + samples.per_pixel * np.arange(rays)
        directions = patterns[chosen[:, None], which].reshape(-1, 3)
        occluded = caster.is_occluded(np.repeat(origins, rays, axis=0), directions)
        open_rays = 1 - occluded.reshape(-1, rays).mean(axis=1, dtype=np.float32)
        if roofs is not None:
            sunlight = float(luminance(sun.irradiance / np.pi)) * cosine[facing] * open_rays
            open_rays *= visibility_of_expected_code(
                roofs.open_fraction(origins, sun), shade[pixel], sunlight
            )
        visible[start + facing] = open_rays
        disc = visible[part]
        samples.add_means(image, part, np.stack([disc, cosine * disc, cosine], axis=1), fraction)
    return visible


def _glossy(
    detail: SampleTable,
    cells: EnvironmentCells,
    radiosity: Float32[np.ndarray, "f 3"],
    visible: Float32[np.ndarray, " n"],
    fraction: Float32[np.ndarray, " p"],
) -> Float32[np.ndarray, "h w 3"] | None:
    """Return the mean radiance that smooth samples reflect; None without such samples."""
    if detail.glossy is None:
        return None
    table, smoothing = detail.glossy
    samples = detail.samples
    points = samples.glossy
    rays = table.light(cells, radiosity)
    # The sun's highlight is added after the smoothing, because it has no noise.
    image = smoothing(samples.add_means(samples.black, points.rows, rays, fraction))
    if cells.sun is not None:
        sun = sun_in_lobes(glossy_lobes(samples), cells.sun) * visible[points.rows, None]
        samples.add_means(image, points.rows, sun, fraction)
    return image
