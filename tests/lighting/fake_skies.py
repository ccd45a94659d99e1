"""Panoramas under known suns, without a scene: enough to test networks with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lightsim.core.colour import luminance, srgb_from_linear
from lightsim.core.equirect import pixel_directions
from lightsim.lighting.sample import LightingBatch, PanoramaBatch


@dataclass
class FakeSkies:
    """A glow around the sun above, shading away from it below; cameras see a band."""

    height_px: int = 32

    def batch(self, size: int, seed: int, index: int, *, only_sunny: bool) -> LightingBatch:
        rng = np.random.default_rng([seed, index, int(only_sunny)])
        half, width = self.height_px // 2, 2 * self.height_px
        directions = pixel_directions(self.height_px)
        azimuth, elevation = rng.uniform(0, 2 * np.pi, size), rng.uniform(0.1, 1.3, size)
        sun = np.stack(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ],
            axis=1,
        )
        is_sunny = (rng.random(size) < 0.6) | only_sunny
        cosine = np.einsum("hwc,nc->nhw", directions, sun)
        light = 0.2 + 0.4 * np.exp(4 * (cosine - 1))
        light[:, half:] = 0.3 - 0.2 * cosine[:, half:]
        radiance = light[..., None] * np.array([0.8, 0.9, 1.1])
        for k in np.flatnonzero(is_sunny):
            brightest = np.unravel_index(cosine[k].argmax(), cosine[k].shape)
            radiance[k][brightest] = np.exp(rng.uniform(4, 6))
        radiance = radiance.astype(np.float32)
        seen = np.zeros((size, self.height_px, width), bool)
        seen[:, half // 2 : half + half // 2] = True
        return LightingBatch(
            panorama=srgb_from_linear(radiance),
            visibility=seen,
            front=srgb_from_linear(radiance[:, half // 2 : half + half // 2, half : 3 * half]),
            sky=radiance[:, :half],
            sky_seen=np.ones((size, half, width), bool),
            sun_direction=sun.astype(np.float32),
            log_peak=np.log(luminance(radiance[:, :half]).max(axis=(1, 2))).astype(np.float32),
            is_sunny=is_sunny,
        )

    def panoramas(self, size: int, seed: int, index: int) -> PanoramaBatch:
        batch = self.batch(size, seed, index, only_sunny=False)
        return PanoramaBatch(batch.panorama, batch.visibility)
