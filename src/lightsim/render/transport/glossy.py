"""Reflections of smooth surfaces, sample by sample of each pixel; those of rough ones are found
where diffuse light is, at the traced pixels.

What smooth surfaces reflect is missing from their diffuse reflection.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Int64

from lightsim.core.buffers import GBuffers
from lightsim.render.transport.faces import TransportConfig, pixel_shifts
from lightsim.render.transport.lobes import Lobes, LobeTable, normal_reflectance, trace_lobes
from lightsim.render.transport.samples import PixelSamples
from lightsim.render.transport.sides import SideFinder
from lightsim.render.transport.upsampling import BilateralUpsampling, TracedPixels

_SMOOTHED_ROUGHNESS = 0.2
"""Surfaces smoother than this show sharp reflections, which must stay sharp."""


def glossy_lobes(samples: PixelSamples) -> Lobes:
    """Lobes of the samples on smooth surfaces."""
    points = samples.glossy
    return Lobes(
        samples.ray_starts_world[points.rows],
        points.normal_world,
        points.towards_camera,
        points.roughness,
        normal_reflectance(points.base_colour, points.metallic),
    )


def trace_glossy(
    finder: SideFinder, samples: PixelSamples, config: TransportConfig, seed: int
) -> LobeTable:
    """Trace `glossy_rays` per pixel; `face_rows` still holds sides (`render.transport.sides`)."""
    rows = samples.glossy.rows
    pixel = samples.pixel[rows].astype(np.int64)
    shifts = pixel_shifts(*np.divmod(pixel, samples.coverage.shape[1]), 1, seed + 3)
    share = samples.number[rows].astype(np.int64), samples.per_pixel
    count = max(1, config.glossy_rays // samples.per_pixel)
    return trace_lobes(finder, glossy_lobes(samples), shifts, count, share)


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


def diffuse_fraction(samples: PixelSamples, table: LobeTable) -> Float32[np.ndarray, "g 3"]:
    """What diffuse reflection keeps of the base colour: no metal has any, and the energy that the
    rays reflect is missing, so that a white surface in a white furnace shows 1."""
    metallic = samples.glossy.metallic
    return ((1 - metallic)[:, None] * (1 - table.albedo)).astype(np.float32)
