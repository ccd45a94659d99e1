"""Reflections of smooth surfaces, traced for each sample of each pixel.

Reflections of rough surfaces are traced with the diffuse light, at the traced pixels. Energy that a
smooth surface reflects is subtracted from its diffuse reflection.
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

# Surfaces smoother than this roughness show sharp reflections, which are not averaged over
# neighbouring pixels. Chosen; sensitivity not measured.
_SMOOTHED_ROUGHNESS = 0.2


def glossy_lobes(samples: PixelSamples) -> Lobes:
    """Return the specular lobes of the samples on smooth surfaces."""
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
    """Trace `glossy_rays` rays per pixel; `face_rows` contains sides
    (`render.transport.sides`)."""
    rows = samples.glossy.rows
    pixel = samples.pixel[rows].astype(np.int64)
    shifts = pixel_shifts(*np.divmod(pixel, samples.coverage.shape[1]), 1, seed + 3)
    part = samples.number[rows].astype(np.int64), samples.per_pixel
    count = max(1, config.glossy_rays // samples.per_pixel)
    return trace_lobes(finder, glossy_lobes(samples), shifts, count, part)


@dataclass(frozen=True, eq=False)
class ReflectionSmoothing:
    """Average of the reflections of rough pixels over neighbours on the same surface.

    Their lobes are wide, and the few rays of one pixel are noisy. Pixels at edges are excluded.

    Args:
        pixel: flat numbers of these pixels.
        upsampling: weights among them.
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
    """Return the smoothing of the rough reflecting pixels of a frame."""
    shape = samples.coverage.shape
    # Pixels with rough reflections, without those that also have smooth ones or an edge.
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
    # Radius 2 in full resolution has the size of radius 1 in blocks of 2 x 2.
    wide = replace(config, shading_step_px=1, filter_radius=2)
    return ReflectionSmoothing(pixel, near.upsampling_to_centres(pixel, gbuffers, wide))


def diffuse_fraction(samples: PixelSamples, table: LobeTable) -> Float32[np.ndarray, "g 3"]:
    """Return the fraction of the base colour that remains for diffuse reflection.

    It is 0 for metals, and reduced by the energy that the specular rays reflect, so that a white
    surface in a white furnace has radiance 1.
    """
    metallic = samples.glossy.metallic
    return ((1 - metallic)[:, None] * (1 - table.albedo)).astype(np.float32)
