"""Reflections of smooth surfaces: rays traced once for all skies, and the sun by the BRDF itself.

Roughness and metallic are the Principled model's (Burley 2012). Dielectrics reflect 4 % at normal
incidence, metals their base colour. What is reflected is missing from diffuse reflection.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Int32, Int64, UInt16

from lightsim.core.buffers import GBuffers
from lightsim.core.dome import Sun
from lightsim.core.equirect import uv_from_directions
from lightsim.render.casters.embree import offset_origins
from lightsim.render.transport.faces import TILE_RAYS, TransportConfig, pixel_shifts
from lightsim.render.transport.samples import PixelSamples, SurfacePoints
from lightsim.render.transport.sides import SideFinder
from lightsim.render.transport.upsampling import BilateralUpsampling, TracedPixels

_DIELECTRIC_F0 = 0.04
_LEAST_ALPHA = 1e-3
_SMOOTHED_ROUGHNESS = 0.2
"""Surfaces smoother than this show sharp reflections, which must stay sharp."""


@dataclass(frozen=True, eq=False)
class GlossyTable:
    """Reflected rays of the glossy samples of one frame.

    Args:
        directions_uv: of each ray, in 65536ths of the dome's width and height.
        face_rows: row in the frame's faces that the ray meets, -1 for the sky.
        weights: factors of F0 and of 1 in the fraction of the ray's radiance that is reflected.
        f0: reflectance at normal incidence.
    """

    directions_uv: UInt16[np.ndarray, "g k 2"]
    face_rows: Int32[np.ndarray, "g k"]
    weights: Float32[np.ndarray, "g k 2"]
    f0: Float32[np.ndarray, "g 3"]

    @property
    def albedo(self) -> Float32[np.ndarray, "g 3"]:
        """Fraction of a uniform light that each sample's rays reflect; at most 1."""
        mean = self.weights.mean(axis=1)
        return self.f0 * mean[:, :1] + mean[:, 1:]


def trace_glossy(
    finder: SideFinder, samples: PixelSamples, config: TransportConfig, seed: int
) -> GlossyTable:
    """Trace `glossy_rays` per pixel; `face_rows` still holds sides (`render.transport.sides`)."""
    from lightsim.render.transport.glossy_kernels import reflected_rays

    points = samples.glossy
    total = len(points.rows)
    count = max(1, config.glossy_rays // samples.per_pixel)
    table = GlossyTable(
        np.empty((total, count, 2), dtype=np.uint16),
        np.empty((total, count), dtype=np.int32),
        np.empty((total, count, 2), dtype=np.float32),
        normal_reflectance(points),
    )
    pixel = samples.pixel[points.rows].astype(np.int64)
    shifts = pixel_shifts(*np.divmod(pixel, samples.coverage.shape[1]), 1, seed + 3)
    which = samples.number[points.rows].astype(np.int64)
    alphas = _alphas(points.roughness)
    tile = max(1, TILE_RAYS // count)
    for start in range(0, total, tile):
        part = slice(start, start + tile)
        normals = points.normal_world[part]
        directions = np.empty((len(normals), count, 3), dtype=np.float32)
        reflected_rays(
            normals,
            points.towards_camera[part],
            alphas[part],
            shifts[part],
            (which[part], samples.per_pixel, count),
            directions,
            table.weights[part],
        )
        uv = uv_from_directions(directions)
        table.directions_uv[part] = np.minimum(uv * 65536.0, 65535.0).astype(np.uint16)
        positions = samples.ray_starts_world[points.rows[part]]
        origins = offset_origins(positions, normals)
        sides = finder.met(np.repeat(origins, count, axis=0), directions.reshape(-1, 3))
        table.face_rows[part] = sides.reshape(-1, count)
    return table


@dataclass(frozen=True, eq=False)
class ReflectionSmoothing:
    """Reflections of rough pixels without edges are averaged over their neighbours on the same
    surface: their lobes are wide, and a few rays a pixel are noisy.

    Args:
        pixel: flat numbers of these pixels.
        spread: weights among them.
    """

    pixel: Int64[np.ndarray, " p"]
    upsampling: BilateralUpsampling

    def __call__(self, image: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
        out = image.copy()
        out.reshape(-1, 3)[self.pixel] = self.upsampling(image.reshape(-1, 3)[self.pixel])
        return out


def reflection_smoothing(
    samples: PixelSamples, gbuffers: GBuffers, config: TransportConfig
) -> ReflectionSmoothing:
    """Weights of the smoothing, made once for all skies; of no pixel where the config smooths
    nothing (`filter_radius` 0)."""
    shape = samples.coverage.shape
    is_rough = np.zeros(samples.coverage.size, dtype=bool)
    is_rough[samples.pixel[samples.glossy.rows]] = config.filter_radius > 0
    is_smooth = samples.glossy.roughness < _SMOOTHED_ROUGHNESS
    is_rough[samples.pixel[samples.glossy.rows[is_smooth]]] = False
    is_rough[samples.pixel[samples.edge.rows]] = False
    pixel = np.flatnonzero(is_rough & gbuffers.has_surface.reshape(-1))
    index = np.full(len(is_rough), -1, dtype=np.int32)
    index[pixel] = np.arange(len(pixel), dtype=np.int32)
    position = gbuffers.ray_starts_world.reshape(-1, 3)[pixel]
    normal = gbuffers.normal_world.reshape(-1, 3)[pixel]
    near = TracedPixels(
        index.reshape(shape), np.concatenate([position, normal], axis=1), int(shape[1])
    )
    wide = replace(config, shading_step_px=1, filter_radius=2)
    depth = gbuffers.depth_z_m.reshape(-1)[pixel]
    return ReflectionSmoothing(pixel, near.upsampling(pixel, position, normal, depth, wide))


def diffuse_fraction(points: SurfacePoints, table: GlossyTable) -> Float32[np.ndarray, "g 3"]:
    """What diffuse reflection keeps of the base colour: no metal has any, and the energy that the
    rays reflect is missing, so that a white surface in a white furnace shows 1."""
    return ((1 - points.metallic)[:, None] * (1 - table.albedo)).astype(np.float32)


def normal_reflectance(points: SurfacePoints) -> Float32[np.ndarray, "g 3"]:
    """F0: 4 % for dielectrics, the base colour for metals."""
    metallic = points.metallic[:, None]
    return ((1 - metallic) * _DIELECTRIC_F0 + metallic * points.base_colour).astype(np.float32)


def reflected_sun(
    points: SurfacePoints, f0: Float32[np.ndarray, "g 3"], sun: Sun
) -> Float32[np.ndarray, "g 3"]:
    """Radiance of the sun's reflection where nothing stands before it.

    The lobe is widened by the disc, whose radius is halved on half vectors (compare Karis 2013,
    sphere lights), so that a mirror shows a highlight of finite radiance.
    """
    alphas = np.hypot(_alphas(points.roughness), np.radians(sun.angular_radius_deg) / 2)
    direction = sun.direction_world / np.linalg.norm(sun.direction_world)
    out = np.empty_like(f0)
    for start in range(0, len(out), TILE_RAYS):
        part = slice(start, start + TILE_RAYS)
        normals = points.normal_world[part]
        towards = np.broadcast_to(direction.astype(np.float32), normals.shape)
        lobe = specular_lobe(
            normals, points.towards_camera[part], towards, alphas[part].astype(np.float32)
        )
        fresnel = f0[part] * (1 - lobe[:, 1:]) + lobe[:, 1:]
        out[part] = fresnel * lobe[:, :1] * sun.irradiance
    return out


def specular_lobe(
    normals: Float32[np.ndarray, "n 3"],
    towards_camera: Float32[np.ndarray, "n 3"],
    towards_light: Float32[np.ndarray, "n 3"],
    alphas: Float32[np.ndarray, " n"],
) -> Float32[np.ndarray, "n 2"]:
    """BRDF without Fresnel times the light's cosine (1/sr), and Schlick's fraction of white."""
    from lightsim.render.transport.glossy_kernels import reflectance

    out = np.empty((len(normals), 2), dtype=np.float32)
    reflectance(normals, towards_camera, np.ascontiguousarray(towards_light), alphas, out)
    return out


def _alphas(roughness: Float[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
    return np.maximum(np.square(roughness), _LEAST_ALPHA).astype(np.float32)
