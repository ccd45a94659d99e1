"""Procedural skies for training: analytic clear skies, overcast skies, and clouds over both.

This module has no model and no parameter in common with the skies of the synthetic streets
(`synthetic.skies`), so that the streets remain independent for evaluation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Shaped

from lightsim.core.colour import luminance
from lightsim.lighting.sky.clear_sky import clear_sky_parts
from lightsim.progress import Progress, SilentProgress
from lightsim_lab.training import grids
from lightsim_lab.training.grids import level_weights
from lightsim_lab.training.hdr_skies import HdrSky

# Smallest ratio of the irradiance facing the sun to that of level ground under the sky alone at
# which the sun counts as casting shadows. Sensitivity not measured.
SUNNY_RATIO = 0.4
# Texels of a noise field along each axis.
NOISE_SIZE = 256
# Number of noise fields, which differ in roughness.
_NOISE_COUNT = 16
# Number of clear skies, nearest in sun elevation, from which one is drawn: they differ in
# turbidity, and by a few degrees in elevation.
_NEAREST = 5
# Noise fields are stored as bytes that cover plus and minus this many standard deviations.
_NOISE_RANGE = 4.0


@dataclass(frozen=True, eq=False)
class UpperSky:
    """Upper half of a sky, and its sun.

    Args:
        rest: radiance without the sun.
        sun_direction: unit vector towards the sun; (0, 0, 1) without a sun.
        sun_irradiance: RGB irradiance of a surface that faces the sun; 0 without a sun.
    """

    rest: Float32[np.ndarray, "h w 3"]
    sun_direction: Float[np.ndarray, "3"]
    sun_irradiance: Float[np.ndarray, "3"]

    def level_irradiance(self) -> Float[np.ndarray, "3"]:
        """Return the RGB irradiance of level ground from the sky without its sun."""
        weights = level_weights(2 * self.rest.shape[0])
        return weights @ self.rest.sum(axis=1, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class ClearSkies:
    """Clear skies with suns at azimuth 0 and various elevations; the median luminance of each is 1.

    Args:
        rest: radiance of the upper halves without the sun.
    """

    elevation_deg: Float32[np.ndarray, " n"]
    rest: Shaped[np.ndarray, "n h w 3"]
    sun_irradiance: Float32[np.ndarray, "n 3"]


def upper_sky_of(sky: HdrSky) -> UpperSky:
    """Return the upper half of a measured sky and its sun."""
    rest = sky.rest[: sky.rest.shape[0] // 2]
    if sky.sun is None:
        return UpperSky(rest, np.array([0.0, 0.0, 1.0]), np.zeros(3))
    sun = sky.sun
    return UpperSky(rest, sun.direction_world.astype(np.float64), sun.irradiance.astype(np.float64))


def is_sunny(upper: UpperSky) -> bool:
    """Return True if the sun casts shadows (SUNNY_RATIO)."""
    direct = float(luminance(upper.sun_irradiance.astype(np.float32)))
    return direct >= SUNNY_RATIO * float(luminance(upper.level_irradiance().astype(np.float32)))


def make_clear_skies(
    count: int, height_px: int, rng: np.random.Generator, progress: Progress | None = None
) -> ClearSkies:
    """Return Hosek-Wilkie skies, sun elevations 1 to 85 degrees, random turbidities 1.8 to 9.

    The model is that of Hosek & Wilkie 2012 (doi:10.1145/2185520.2185591).
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
        # Stored in half precision, whose largest number is 65504.
        rest[k] = np.minimum(upper / unit, 6e4)
        irradiance_rgb[k] = sun.irradiance / unit
    return ClearSkies(elevations.astype(np.float32), rest, irradiance_rgb)


def make_noise(rng: np.random.Generator) -> Float32[np.ndarray, "k s s"]:
    """Return periodic noise fields of increasing smoothness, mean 0 and standard deviation 1."""
    frequency = np.hypot(
        np.fft.fftfreq(NOISE_SIZE)[:, None] * NOISE_SIZE,
        np.fft.rfftfreq(NOISE_SIZE)[None] * NOISE_SIZE,
    )
    frequency[0, 0] = np.inf
    fields = np.empty((_NOISE_COUNT, NOISE_SIZE, NOISE_SIZE), np.float32)
    for k in range(_NOISE_COUNT):
        slope = 1.3 + 1.1 * k / _NOISE_COUNT
        stretch = np.exp(rng.uniform(-0.5, 0.5))
        # The lowest frequencies are damped: clouds vary within the sky more than across all of it.
        low = 1.0 - 0.8 * np.exp(-((frequency / (2.0 * stretch)) ** 2))
        phase = np.exp(2j * np.pi * rng.random(frequency.shape))
        field = np.fft.irfft2(phase * low * frequency**-slope, s=(NOISE_SIZE, NOISE_SIZE))
        fields[k] = (field - field.mean()) / field.std()
    return fields


def pack_noise(fields: Float32[np.ndarray, "k s s"]) -> Shaped[np.ndarray, "k s s"]:
    """Convert noise fields to bytes; values beyond 4 standard deviations are clipped."""
    scaled = (fields / _NOISE_RANGE + 1.0) * 127.5
    return np.clip(np.round(scaled), 0, 255).astype(np.uint8)


def unpack_noise(codes: Shaped[np.ndarray, "k s s"]) -> Float32[np.ndarray, "k s s"]:
    """Invert `pack_noise`, except for its rounding."""
    return ((codes.astype(np.float32) / 127.5) - 1.0) * np.float32(_NOISE_RANGE)


def random_clear_sky(
    skies: ClearSkies, rng: np.random.Generator, elevation_deg: float | None = None
) -> UpperSky:
    """Draw a clear sky, with random whitening by haze.

    Args:
        elevation_deg: approximate elevation of its sun; None: any.
    """
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
    # Haze mixes the blue of the model with a nearly neutral colour of the same luminance.
    rest = rest * (1 - haze) + haze * grey * np.array([0.97, 1.0, 1.06], np.float32)
    return UpperSky(rest.astype(np.float32), direction, skies.sun_irradiance[k].astype(np.float64))


def random_overcast_sky(
    noise: Float32[np.ndarray, "k s s"], height_px: int, rng: np.random.Generator
) -> UpperSky:
    """Draw an overcast sky with structure, dark at the horizon, bright about the hidden sun."""
    directions = grids.directions(height_px)[: height_px // 2]
    elevation = np.radians(float(rng.uniform(5.0, 75.0)))
    towards = np.array([np.cos(elevation), 0.0, np.sin(elevation)])
    # Moon-Spencer form of the overcast sky, with a random ratio of zenith to horizon.
    steepness = float(rng.uniform(0.3, 2.6))
    shape = (1 + steepness * directions[..., 2]) / (1 + steepness)
    angle = np.arccos(np.clip(directions @ towards, -1, 1))
    bright = float(rng.choice([0.0, 1.0])) * float(rng.uniform(0.1, 1.5))
    shape = shape * (1 + bright * np.exp(-angle / np.radians(float(rng.uniform(15, 45)))))
    field, _ = _cloud_field(noise, directions, towards, rng)
    shape = shape * np.exp(float(rng.uniform(0.02, 0.35)) * np.clip(field, -2.5, 2.5))
    # Overcast skies are slightly bluish on average.
    tint = np.exp(rng.normal([-0.03, 0.0, 0.05], 0.04))
    rest = (shape / np.median(shape))[..., None] * tint
    return UpperSky(rest.astype(np.float32), towards, np.zeros(3))


def with_clouds(
    upper: UpperSky, noise: Float32[np.ndarray, "k s s"], rng: np.random.Generator
) -> UpperSky:
    """Add a layer of clouds, which attenuates the sky and the sun behind it.

    The optical depth is noise above a threshold, the transmittance exp(-depth). The clouds scatter
    the light of sky and sun, with a forward peak about the sun.
    """
    height = upper.rest.shape[0]
    directions = grids.directions(2 * height)[:height]
    towards = upper.sun_direction
    field, at_sun = _cloud_field(noise, directions, towards, rng)
    threshold = float(rng.uniform(-1.2, 1.6))
    depth_gain = float(np.exp(rng.uniform(np.log(0.4), np.log(6.0))))
    depth = depth_gain * np.maximum(field - threshold, 0.0)
    sun_depth = depth_gain * max(at_sun - threshold, 0.0)
    through = np.exp(-depth)[..., None]
    sky_level = upper.level_irradiance() / np.pi
    sun_level = upper.sun_irradiance * max(float(towards[2]), 0.05) / np.pi
    angle = np.arccos(np.clip(directions @ towards, -1, 1))[..., None]
    forward = 0.5 * np.exp(-((angle / np.radians(9.0)) ** 2)) + 0.06 * np.exp(
        -angle / np.radians(25.0)
    )
    lit = sky_level + sun_level * (0.15 + 0.45 * np.exp(-0.4 * depth))[..., None]
    # Scattering whitens: the clouds' colour is closer to grey than that of their light.
    white = luminance(lit.astype(np.float32))[..., None] * np.array([0.98, 1.0, 1.03])
    colour = 0.6 * white + 0.4 * lit
    colour = colour * (0.55 + 0.45 * np.exp(-depth / 4))[..., None]
    glow = upper.sun_irradiance * forward * (depth * np.exp(-depth))[..., None]
    rest = upper.rest * through + colour * (1 - through) + glow
    irradiance_rgb = upper.sun_irradiance * float(np.exp(-sun_depth))
    return UpperSky(rest.astype(np.float32), towards, irradiance_rgb)


def _cloud_field(
    noise: Float32[np.ndarray, "k s s"],
    directions: Float[np.ndarray, "h w 3"],
    towards: Float[np.ndarray, "3"],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "h w"], float]:
    """Project a noise field on a cloud layer; return it by direction, and its value at the sun."""
    field = noise[int(rng.integers(len(noise)))]
    bend = float(rng.uniform(0.08, 0.3))
    scale = float(np.exp(rng.uniform(np.log(8.0), np.log(45.0))))
    offset = rng.random(2) * NOISE_SIZE
    turn = float(rng.uniform(0, 2 * np.pi))
    all_directions = np.concatenate([directions.reshape(-1, 3), towards[None]])
    # `bend` limits the distance of the layer at the horizon, as the curvature of the earth does.
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


def rotated_sky(upper: UpperSky, columns: int, *, flip: bool) -> UpperSky:
    """Mirror a sky (`flip`) at the plane of azimuth 0, then rotate it clockwise by columns."""
    rest, direction = upper.rest, upper.sun_direction
    if flip:
        rest, direction = rest[:, ::-1], direction * np.array([1.0, -1.0, 1.0])
    width = rest.shape[1]
    angle = -2 * np.pi * columns / width
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = direction
    turned = np.array([c * x - s * y, s * x + c * y, z])
    return UpperSky(np.roll(rest, columns, axis=1), turned, upper.sun_irradiance)


def with_sun_raised(upper: UpperSky, elevation_deg: float) -> UpperSky:
    """Move the sun of a sky to another elevation.

    Rows are stretched between horizon, sun and zenith. The sun is attenuated by the change of the
    relative air mass (Kasten & Young 1989, doi:10.1364/AO.28.004735).
    """
    old = float(np.degrees(np.arcsin(np.clip(upper.sun_direction[2], -1, 1))))
    height = upper.rest.shape[0]
    rows_deg = 90.0 - (np.arange(height) + 0.5) * 90.0 / height
    source_deg = np.interp(rows_deg, [0.0, elevation_deg, 90.0], [0.0, old, 90.0])
    row = np.clip((90.0 - source_deg) * height / 90.0 - 0.5, 0, height - 1)
    first = np.minimum(row.astype(np.int64), height - 2)
    part = (row - first).astype(np.float32)[:, None, None]
    rest = upper.rest[first] * (1 - part) + upper.rest[first + 1] * part
    x, y, _ = upper.sun_direction
    azimuth, new = np.arctan2(y, x), np.radians(elevation_deg)
    direction = np.array(
        [np.cos(azimuth) * np.cos(new), np.sin(azimuth) * np.cos(new), np.sin(new)]
    )
    change = _air_mass(elevation_deg) - _air_mass(old)
    # Optical depths of red, green and blue per unit of air mass, for a clear atmosphere.
    dimming = np.exp(-np.array([0.10, 0.14, 0.21]) * change)
    return UpperSky(rest.astype(np.float32), direction, upper.sun_irradiance * dimming)


def _air_mass(elevation_deg: float) -> float:
    e = max(elevation_deg, 0.0)
    return float(1.0 / (np.sin(np.radians(e)) + 0.50572 * (e + 6.07995) ** -1.6364))
