"""Procedural textures with variation at scales from centimetres to metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32


@dataclass(frozen=True, eq=False)
class Finish:
    """Surface finish: textures and parameters of the principled BSDF (Burley 2012).

    Args:
        base_colour: linear albedo texture, periodic.
        extent_m: size of the texture along u and v, in metres.
        roughness: one value, or a texture of the same extent.
        specular: specular level; 0.5 is a dielectric of refractive index 1.5.
        lidar_gain: factor on the LiDAR return; low for glass, which transmits the beam.
    """

    base_colour: Float32[np.ndarray, "h w 3"]
    extent_m: tuple[float, float]
    roughness: Float32[np.ndarray, "p q"]
    specular: float = 0.3
    metallic: float = 0.0
    clearcoat: float = 0.0
    lidar_gain: float = 1.0

    def look_up(self, uv_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Interpolate the base colour bilinearly; texel i covers [i, i + 1), row 0 is at v = 0."""
        height, width = self.base_colour.shape[:2]
        x = uv_m[:, 0] / self.extent_m[0] * width - 0.5
        y = uv_m[:, 1] / self.extent_m[1] * height - 0.5
        i, j = np.floor(y).astype(np.int64), np.floor(x).astype(np.int64)
        fy, fx = (y - i)[:, None], (x - j)[:, None]
        i, j, i1, j1 = i % height, j % width, (i + 1) % height, (j + 1) % width
        t = self.base_colour
        top = t[i, j] * (1 - fx) + t[i, j1] * fx
        return top * (1 - fy) + (t[i1, j] * (1 - fx) + t[i1, j1] * fx) * fy


def noise(
    rng: np.random.Generator, height: int, width: int, slope: float = 1.2
) -> Float[np.ndarray, "{height} {width}"]:
    """Return periodic noise, amplitude ~ 1 / frequency^slope, mean 0, standard deviation 1."""
    # The spectrum is filtered white noise: its inverse transform is periodic by construction.
    fy, fx = np.fft.fftfreq(height) * height, np.fft.rfftfreq(width) * width
    frequency = np.hypot(fy[:, None] * width / height, fx[None, :])
    frequency[0, 0] = np.inf
    spectrum = rng.standard_normal(frequency.shape) + 1j * rng.standard_normal(frequency.shape)
    field = np.fft.irfft2(spectrum / frequency**slope, s=(height, width))
    return (field - field.mean()) / field.std()


def constant(value: float) -> Float32[np.ndarray, "1 1"]:
    """Return a texture of one texel."""
    return np.full((1, 1), value, dtype=np.float32)


def coloured(
    albedo: Float[np.ndarray, "h w"], rgb: tuple[float, float, float]
) -> Float32[np.ndarray, "h w 3"]:
    """Multiply relative albedo by a colour, clipped to the range of real albedos."""
    return np.clip(albedo[..., None] * np.asarray(rgb), 0.02, 0.88).astype(np.float32)


def plaster(rng: np.random.Generator, rgb: tuple[float, float, float]) -> Finish:
    """Return painted plaster with grain, stains and vertical streaks."""
    grain = 0.05 * noise(rng, 512, 512, 0.5) + 0.06 * noise(rng, 512, 512, 1.4)
    streaks = 0.05 * np.repeat(noise(rng, 8, 512, 0.8), 64, axis=0)
    return Finish(coloured(1 + grain + streaks, rgb), (9.6, 9.6), constant(0.8))


def brick(rng: np.random.Generator, rgb: tuple[float, float, float]) -> Finish:
    """Return a brick wall: running bond, 20 x 8 cm, bricks of various albedo, light mortar."""
    rows, columns, high, wide = 64, 32, 8, 16
    shade = 1 + 0.16 * rng.standard_normal((rows, columns))
    albedo = np.kron(shade, np.ones((high, wide)))
    is_mortar = np.zeros_like(albedo, dtype=bool)
    is_mortar[::high] = True
    is_mortar[:, ::wide] = True
    # Every second row is shifted by half a brick.
    for row in range(1, rows, 2):
        band = slice(row * high, (row + 1) * high)
        albedo[band] = np.roll(albedo[band], wide // 2, axis=1)
        is_mortar[band] = np.roll(is_mortar[band], wide // 2, axis=1)
    albedo *= 1 + 0.07 * noise(rng, 512, 512, 0.4) + 0.09 * noise(rng, 512, 512, 1.4)
    colour = coloured(albedo, rgb)
    mortar = coloured(1 + 0.1 * noise(rng, 512, 512, 0.8), (0.42, 0.40, 0.37))
    colour[is_mortar] = 0.4 * colour[is_mortar] + 0.6 * mortar[is_mortar]
    return Finish(colour, (6.4, 5.12), constant(0.85))


def slabs(rng: np.random.Generator, rgb: tuple[float, float, float], joint_px: int = 64) -> Finish:
    """Return concrete or stone slabs with dark joints; 1.6 cm per texel."""
    count = 512 // joint_px
    albedo = np.kron(1 + 0.07 * rng.standard_normal((count, count)), np.ones((joint_px, joint_px)))
    albedo *= 1 + 0.05 * noise(rng, 512, 512, 0.3) + 0.1 * noise(rng, 512, 512, 1.3)
    albedo[::joint_px] *= 0.55
    albedo[:, ::joint_px] *= 0.55
    return Finish(coloured(albedo, rgb), (8.192, 8.192), constant(0.75))


def speckled(
    rng: np.random.Generator,
    rgb: tuple[float, float, float],
    amount: float = 0.15,
    extent_m: float = 4.0,
    roughness: float = 0.8,
) -> Finish:
    """Return one colour with fine variation, for bark, leaves, cloth or rubber."""
    albedo = 1 + amount * (0.7 * noise(rng, 256, 256, 0.5) + 0.7 * noise(rng, 256, 256, 1.3))
    return Finish(coloured(albedo, rgb), (extent_m, extent_m), constant(roughness))


def paint(rng: np.random.Generator, rgb: tuple[float, float, float]) -> Finish:
    """Return car paint: a glossy base under clear coat, with some dust."""
    albedo = 1 + 0.03 * noise(rng, 128, 128, 1.0) + 0.02 * noise(rng, 128, 128, 0.3)
    colour = coloured(albedo, rgb)
    return Finish(colour, (3.0, 3.0), constant(0.35), specular=0.6, metallic=0.2, clearcoat=1.0)


def glass(rng: np.random.Generator, is_lit_room: bool) -> Finish:
    """Return window glass: dark and smooth, with curtains and rooms as patches of albedo."""
    albedo = 0.045 + 0.02 * np.abs(noise(rng, 256, 256, 1.0))
    if is_lit_room:
        curtain = np.kron(rng.random((16, 16)) < 0.3, np.ones((16, 16)))
        albedo = albedo + 0.28 * curtain * (1 + 0.15 * noise(rng, 256, 256, 0.6))
    colour = coloured(albedo, (0.95, 1.0, 1.02))
    return Finish(colour, (24.0, 24.0), constant(0.12), specular=0.7, lidar_gain=0.08)


@dataclass(frozen=True)
class Line:
    """Line of paint along a road; a dash as long as the period makes it continuous."""

    across_m: float
    half_width_m: float
    period_m: float
    dash_m: float


def road(
    rng: np.random.Generator,
    size_m: tuple[float, float],
    tracks_m: Sequence[float],
    lines: Sequence[Line],
    rgb: tuple[float, float, float] = (0.190, 0.186, 0.182),
) -> Finish:
    """Return asphalt with repairs, cracks, wheel tracks, manholes and markings; 3 cm per texel.

    Args:
        size_m: length and width.
        tracks_m: distances of the wheel tracks from the middle of the road.
        lines: markings, also relative to the middle.
    """
    texel_m = 0.03
    w, h = (round(extent_m / texel_m) for extent_m in size_m)
    grain = rng.standard_normal((h, w))
    albedo = 1 + 0.09 * grain + 0.05 * noise(rng, h, w, 0.6) + 0.07 * noise(rng, h, w, 1.5)
    _add_repairs(rng, albedo)
    across_m = (np.arange(h) + 0.5) * texel_m - size_m[1] / 2
    for centre in tracks_m:
        albedo *= 1 - 0.12 * np.exp(-(((across_m - centre) / 0.3) ** 2))[:, None]
    _add_cracks(rng, albedo)
    colour = coloured(albedo, rgb)
    roughness = np.clip(0.7 + 0.08 * noise(rng, h, w, 1.3), 0.4, 0.95).astype(np.float32)
    wear = 0.8 + 0.12 * noise(rng, h, w, 0.8)
    along_m = (np.arange(w) + 0.5) * texel_m
    is_mark = np.zeros((h, w), dtype=bool)
    for line in lines:
        is_near = np.abs(across_m - line.across_m) < line.half_width_m
        is_mark |= is_near[:, None] & ((along_m % line.period_m) < line.dash_m)[None]
    mark = coloured(wear, (0.62, 0.61, 0.57))
    colour[is_mark] = mark[is_mark]
    return Finish(colour, size_m, roughness, specular=0.4)


def _add_repairs(rng: np.random.Generator, albedo: Float[np.ndarray, "h w"]) -> None:
    h, w = albedo.shape
    for _ in range(max(1, w // 500)):
        i, j = int(rng.integers(0, h - 30)), int(rng.integers(0, w - 130))
        di, dj = int(rng.integers(25, 90)), int(rng.integers(40, 130))
        albedo[i : i + di, j : j + dj] *= float(rng.uniform(0.68, 1.25))
    for _ in range(max(1, w // 900)):
        i, j = int(rng.integers(60, h - 60)), int(rng.integers(20, w - 20))
        y, x = np.ogrid[:h, :w]
        albedo[np.hypot(y - i, x - j) < 11] *= 0.5


def _add_cracks(rng: np.random.Generator, albedo: Float[np.ndarray, "h w"]) -> None:
    h, w = albedo.shape
    for _ in range(w // 130):
        steps = int(rng.integers(60, 220))
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.15, steps))
        i = (rng.uniform(0, h) + np.cumsum(np.sin(heading))).astype(np.int64)
        j = (rng.uniform(0, w) + np.cumsum(np.cos(heading))).astype(np.int64)
        albedo[np.clip(i, 0, h - 1), j % w] *= 0.55
