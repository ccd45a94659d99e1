"""Skies that nobody photographed: analytic clear skies, overcast ones, and clouds over both.

The generator of the synthetic streets' skies (`synthetic.skies`) shares no model and no
parameter with this one, so that streets stay fair for evaluation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Shaped

from lightsim.core.colour import luminance
from lightsim.lighting.sky.clear_sky import clear_sky_parts
from lightsim.progress import Progress, SilentProgress
from lightsim_lab.training import grids
from lightsim_lab.training.grids import level_weights
from lightsim_lab.training.hdr_skies import HdrSky

SUNNY_RATIO = 0.4
"""The sun casts shadows where it brings a surface that faces it at least this much of the sky's
light on level ground."""
NOISE_SIZE = 256
_NOISE_COUNT = 16
_NEAREST = 5
"""Clear skies with suns about as high as asked for, of different turbidities: a few degrees."""
_NOISE_RANGE = 4.0
"""Noise fields are stored as bytes over minus to plus this many standard deviations."""


@dataclass(frozen=True, eq=False)
class Heaven:
    """The upper half of the sphere and its sun, apart from each other.

    Args:
        rest: radiance without the sun.
        sun_direction: unit vector; (0, 0, 1) where there is no sun.
        sun_irradiance: RGB on a surface that faces the sun; 0 without one.
    """

    rest: Float32[np.ndarray, "h w 3"]
    sun_direction: Float[np.ndarray, "3"]
    sun_irradiance: Float[np.ndarray, "3"]

    def level_irradiance(self) -> Float[np.ndarray, "3"]:
        """RGB that the sky without its sun sends onto level ground."""
        return level_irradiance(self.rest)


@dataclass(frozen=True, eq=False)
class ClearSkies:
    """Clear skies of many suns; every sun stands at azimuth 0. Median luminance 1 each.

    Args:
        rest: upper halves without the sun.
    """

    elevation_deg: Float32[np.ndarray, " n"]
    rest: Shaped[np.ndarray, "n h w 3"]
    sun_irradiance: Float32[np.ndarray, "n 3"]


def heaven_of(sky: HdrSky) -> Heaven:
    """The upper half of a measured sky and its sun."""
    rest = sky.rest[: sky.rest.shape[0] // 2]
    if sky.sun is None:
        return Heaven(rest, np.array([0.0, 0.0, 1.0]), np.zeros(3))
    sun = sky.sun
    return Heaven(rest, sun.direction_world.astype(np.float64), sun.irradiance.astype(np.float64))


def is_sunny(heaven: Heaven) -> bool:
    """See SUNNY_RATIO."""
    direct = float(luminance(heaven.sun_irradiance.astype(np.float32)))
    return direct >= SUNNY_RATIO * float(luminance(heaven.level_irradiance().astype(np.float32)))


def level_irradiance(upper: Float32[np.ndarray, "h w 3"]) -> Float[np.ndarray, "3"]:
    """RGB irradiance on level ground of a sky's upper half."""
    return level_weights(2 * upper.shape[0]) @ upper.sum(axis=1, dtype=np.float64)


def make_clear_skies(
    count: int, height_px: int, rng: np.random.Generator, progress: Progress | None = None
) -> ClearSkies:
    """Hosek-Wilkie skies, elevations from 1 to 85 degrees evenly, turbidities 1.8 to 9 at random.

    The model is that of Hosek & Wilkie 2012 (doi:10.1145/2185520.2185591). It is symmetric about
    the sun's meridian; one half is evaluated per sky.
    """
    elevations = 1.0 + 84.0 * (np.arange(count) + rng.random(count)) / count
    rest = np.zeros((count, height_px // 2, 2 * height_px, 3), np.float16)
    irradiance_rgb = np.zeros((count, 3), np.float32)
    for k in (progress or SilentProgress()).track(range(count), "clear skies"):
        elevation = float(np.radians(elevations[k]))
        direction = np.array([np.cos(elevation), 0.0, np.sin(elevation)])
        turbidity = float(1.8 * 5.0 ** rng.beta(1.2, 1.8))
        sky, sun = clear_sky_parts(direction, turbidity, float(rng.uniform(0.1, 0.4)), height_px)
        upper = sky[: height_px // 2]
        unit = float(np.median(luminance(upper)))
        rest[k] = np.minimum(upper / unit, 6e4)
        irradiance_rgb[k] = sun.irradiance / unit
    return ClearSkies(elevations.astype(np.float32), rest, irradiance_rgb)


def make_noise(rng: np.random.Generator) -> Float32[np.ndarray, "k s s"]:
    """Periodic fields of different roughness, mean 0 and standard deviation 1, as bytes hold."""
    frequency = np.hypot(
        np.fft.fftfreq(NOISE_SIZE)[:, None] * NOISE_SIZE,
        np.fft.rfftfreq(NOISE_SIZE)[None] * NOISE_SIZE,
    )
    frequency[0, 0] = np.inf
    fields = np.empty((_NOISE_COUNT, NOISE_SIZE, NOISE_SIZE), np.float32)
    for k in range(_NOISE_COUNT):
        slope = 1.3 + 1.1 * k / _NOISE_COUNT
        stretch = np.exp(rng.uniform(-0.5, 0.5))
        low = 1.0 - 0.8 * np.exp(-((frequency / (2.0 * stretch)) ** 2))
        phase = np.exp(2j * np.pi * rng.random(frequency.shape))
        field = np.fft.irfft2(phase * low * frequency**-slope, s=(NOISE_SIZE, NOISE_SIZE))
        fields[k] = (field - field.mean()) / field.std()
    return fields


def pack_noise(fields: Float32[np.ndarray, "k s s"]) -> Shaped[np.ndarray, "k s s"]:
    """Noise fields as bytes, values beyond 4 standard deviations clipped."""
    scaled = (fields / _NOISE_RANGE + 1.0) * 127.5
    return np.clip(np.round(scaled), 0, 255).astype(np.uint8)


def unpack_noise(codes: Shaped[np.ndarray, "k s s"]) -> Float32[np.ndarray, "k s s"]:
    """Inverse of `pack_noise` up to its rounding."""
    return ((codes.astype(np.float32) / 127.5) - 1.0) * np.float32(_NOISE_RANGE)


def clear_heaven(
    skies: ClearSkies, rng: np.random.Generator, elevation_deg: float | None = None
) -> Heaven:
    """One of the clear skies, some with whiter haze; its sun about as high as asked for."""
    if elevation_deg is None:
        k = int(rng.integers(len(skies.rest)))
    else:
        nearest = np.argsort(np.abs(skies.elevation_deg - elevation_deg))
        k = int(rng.choice(nearest[:_NEAREST]))
    elevation = np.radians(float(skies.elevation_deg[k]))
    direction = np.array([np.cos(elevation), 0.0, np.sin(elevation)])
    rest = skies.rest[k].astype(np.float32)
    haze = float(rng.beta(1.0, 3.0))
    grey = luminance(rest)[..., None]
    rest = rest * (1 - haze) + haze * grey * np.array([0.97, 1.0, 1.06], np.float32)
    return Heaven(rest.astype(np.float32), direction, skies.sun_irradiance[k].astype(np.float64))


def overcast_heaven(
    noise: Float32[np.ndarray, "k s s"], height_px: int, rng: np.random.Generator
) -> Heaven:
    """A closed cover: darker towards the horizon, brighter towards the hidden sun, structured."""
    directions = grids.directions(height_px)[: height_px // 2]
    elevation = np.radians(float(rng.uniform(5.0, 75.0)))
    towards = np.array([np.cos(elevation), 0.0, np.sin(elevation)])
    steepness = float(rng.uniform(0.3, 2.6))
    shape = (1 + steepness * directions[..., 2]) / (1 + steepness)
    angle = np.arccos(np.clip(directions @ towards, -1, 1))
    bright = float(rng.choice([0.0, 1.0])) * float(rng.uniform(0.1, 1.5))
    shape = shape * (1 + bright * np.exp(-angle / np.radians(float(rng.uniform(15, 45)))))
    field, _ = _cloud_field(noise, directions, towards, rng)
    shape = shape * np.exp(float(rng.uniform(0.02, 0.35)) * np.clip(field, -2.5, 2.5))
    tint = np.exp(rng.normal([-0.03, 0.0, 0.05], 0.04))
    rest = (shape / np.median(shape))[..., None] * tint
    return Heaven(rest.astype(np.float32), towards, np.zeros(3))


def with_clouds(
    heaven: Heaven, noise: Float32[np.ndarray, "k s s"], rng: np.random.Generator
) -> Heaven:
    """Clouds on a layer overhead: they dim, or hide, the sky and the sun behind them.

    Optical depth is noise above a threshold. What passes is exp(-depth); the cloud itself shows
    light of sky and sun scattered on, with a forward peak around the sun.
    """
    height = heaven.rest.shape[0]
    directions = grids.directions(2 * height)[:height]
    towards = heaven.sun_direction
    field, at_sun = _cloud_field(noise, directions, towards, rng)
    threshold = float(rng.uniform(-1.2, 1.6))
    depth_gain = float(np.exp(rng.uniform(np.log(0.4), np.log(6.0))))
    depth = depth_gain * np.maximum(field - threshold, 0.0)
    sun_depth = depth_gain * max(at_sun - threshold, 0.0)
    through = np.exp(-depth)[..., None]
    sky_level = heaven.level_irradiance() / np.pi
    sun_level = heaven.sun_irradiance * max(float(towards[2]), 0.05) / np.pi
    angle = np.arccos(np.clip(directions @ towards, -1, 1))[..., None]
    forward = 0.5 * np.exp(-((angle / np.radians(9.0)) ** 2)) + 0.06 * np.exp(
        -angle / np.radians(25.0)
    )
    lit = sky_level + sun_level * (0.15 + 0.45 * np.exp(-0.4 * depth))[..., None]
    white = luminance(lit.astype(np.float32))[..., None] * np.array([0.98, 1.0, 1.03])
    colour = 0.6 * white + 0.4 * lit
    colour = colour * (0.55 + 0.45 * np.exp(-depth / 4))[..., None]
    glow = heaven.sun_irradiance * forward * (depth * np.exp(-depth))[..., None]
    rest = heaven.rest * through + colour * (1 - through) + glow
    irradiance_rgb = heaven.sun_irradiance * float(np.exp(-sun_depth))
    return Heaven(rest.astype(np.float32), towards, irradiance_rgb)


def _cloud_field(
    noise: Float32[np.ndarray, "k s s"],
    directions: Float[np.ndarray, "h w 3"],
    towards: Float[np.ndarray, "3"],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "h w"], float]:
    """Noise of a cloud layer as seen from below, and its value in front of the sun."""
    field = noise[int(rng.integers(len(noise)))]
    bend = float(rng.uniform(0.08, 0.3))
    scale = float(np.exp(rng.uniform(np.log(8.0), np.log(45.0))))
    offset = rng.random(2) * NOISE_SIZE
    turn = float(rng.uniform(0, 2 * np.pi))
    all_directions = np.concatenate([directions.reshape(-1, 3), towards[None]])
    plane = all_directions[:, :2] / (np.maximum(all_directions[:, 2:], 0.0) + bend)
    c, s = np.cos(turn), np.sin(turn)
    stretch = float(rng.uniform(0.5, 1.0))
    x = (c * plane[:, 0] - s * plane[:, 1]) * scale + offset[0]
    y = (s * plane[:, 0] + c * plane[:, 1]) * scale * stretch + offset[1]
    i, j = np.floor(y).astype(np.int64), np.floor(x).astype(np.int64)
    fy, fx = y - i, x - j
    i0, j0, i1, j1 = (v % NOISE_SIZE for v in (i, j, i + 1, j + 1))
    top = field[i0, j0] * (1 - fx) + field[i0, j1] * fx
    value = top * (1 - fy) + (field[i1, j0] * (1 - fx) + field[i1, j1] * fx) * fy
    return value[:-1].reshape(directions.shape[:2]), float(value[-1])


def turned_heaven(heaven: Heaven, columns: int, *, flip: bool) -> Heaven:
    """The same sky mirrored at the plane through azimuth 0, then shifted by whole columns."""
    rest, direction = heaven.rest, heaven.sun_direction
    if flip:
        rest, direction = rest[:, ::-1], direction * np.array([1.0, -1.0, 1.0])
    width = rest.shape[1]
    angle = -2 * np.pi * columns / width
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = direction
    turned = np.array([c * x - s * y, s * x + c * y, z])
    return Heaven(np.roll(rest, columns, axis=1), turned, heaven.sun_irradiance)


def raised_heaven(heaven: Heaven, elevation_deg: float) -> Heaven:
    """The same sky with its sun at another elevation: rows are stretched between horizon, sun
    and zenith, and the sun is dimmed by the change of air mass (Kasten & Young 1989)."""
    old = float(np.degrees(np.arcsin(np.clip(heaven.sun_direction[2], -1, 1))))
    height = heaven.rest.shape[0]
    rows_deg = 90.0 - (np.arange(height) + 0.5) * 90.0 / height
    source_deg = np.interp(rows_deg, [0.0, elevation_deg, 90.0], [0.0, old, 90.0])
    row = np.clip((90.0 - source_deg) * height / 90.0 - 0.5, 0, height - 1)
    first = np.minimum(row.astype(np.int64), height - 2)
    part = (row - first).astype(np.float32)[:, None, None]
    rest = heaven.rest[first] * (1 - part) + heaven.rest[first + 1] * part
    x, y, _ = heaven.sun_direction
    azimuth, new = np.arctan2(y, x), np.radians(elevation_deg)
    direction = np.array(
        [np.cos(azimuth) * np.cos(new), np.sin(azimuth) * np.cos(new), np.sin(new)]
    )
    change = _air_mass(elevation_deg) - _air_mass(old)
    dimming = np.exp(-np.array([0.10, 0.14, 0.21]) * change)
    return Heaven(rest.astype(np.float32), direction, heaven.sun_irradiance * dimming)


def _air_mass(elevation_deg: float) -> float:
    e = max(elevation_deg, 0.0)
    return float(1.0 / (np.sin(np.radians(e)) + 0.50572 * (e + 6.07995) ** -1.6364))


def clear_arrays(skies: ClearSkies) -> Mapping[str, Shaped[np.ndarray, "..."]]:
    """Arrays for the cache, by name."""
    return {
        "clear_elevation_deg": skies.elevation_deg,
        "clear_rest": skies.rest,
        "clear_sun_irradiance": skies.sun_irradiance,
    }
