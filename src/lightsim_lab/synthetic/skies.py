"""Skies of the synthetic street: CIE standard skies with clouds, and a sun.

The relative luminance is that of the CIE standard general sky (CIE S 011, ISO 15469:2004). The same
radiance lights the scene, fills the sky pixels and is the ground truth. None of the analytic models
that sky estimation fits is used, so that the evaluation is independent of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from zlib import crc32

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.checks import check_number
from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome, Sun, add_sun, find_sun, split_sun
from lightsim.core.equirect import pixel_directions, sample_bilinear, solid_angles_sr
from lightsim.core.resample import resize_area
from lightsim.core.solar import SolarPosition, direction_world
from lightsim.store.images import read_sky
from lightsim_lab.synthetic.plan import StreetPlan
from lightsim_lab.synthetic.textures import noise

# Luminous irradiance of the sun before extinction, in scene units; a sunlit white wall then has a
# pixel value near 0.9.
_SUN_AT_ZENITH = 6.3
# Optical depth of the clear atmosphere per unit of air mass, for red, green and blue. Not fitted.
_EXTINCTION_RGB = np.array([0.17, 0.22, 0.33])
# Range of the luminous irradiance of level ground under measured skies, in scene units: from that
# of an overcast sky to that of a high sun.
_MEASURED_SKY_IRRADIANCE = (1.5, 6.0)
# Coefficients a to e of CIE S 011 type 12: clear, low turbidity (Darula & Kittler 2002).
_CLEAR = (-1.0, -0.32, 10.0, -3.0, 0.45)
# Coefficients a and b of CIE S 011 type 1: overcast, steep gradation; c and e are 0.
_OVERCAST = (4.0, -0.70)


@dataclass(frozen=True)
class SkySpec:
    """Parameters of a sky: clear with a sun, or overcast without one.

    Args:
        sun: azimuth from true north, and elevation; None: overcast.
        sky_irradiance: luminous irradiance of level ground from the sky without its sun.
        cloud_amount: amount of thin clouds in a clear sky, 0 to 1.
        sun_factor: transmittance of a veil of cloud in front of the sun.
    """

    name: str
    sun: SolarPosition | None
    sky_irradiance: float
    cloud_amount: float
    seed: int
    sun_factor: float = 1.0


def sky_specs(plan: StreetPlan) -> tuple[SkySpec, ...]:
    """Return the source sky, then the three target skies."""
    rng = np.random.default_rng([plan.seed, 5])
    azimuth = plan.sun.azimuth_deg
    # Low and high sun are on opposite sides of the source's azimuth.
    turn = float(rng.choice([-1.0, 1.0]))
    low = SolarPosition((azimuth + turn * float(rng.uniform(95, 150))) % 360.0, 24.0)
    high = SolarPosition((azimuth - turn * float(rng.uniform(60, 110))) % 360.0, 62.0)
    return (
        SkySpec("source", plan.sun, 0.88, float(rng.uniform(0.1, 0.35)), 1),
        SkySpec("low_sun", low, 0.62, float(rng.uniform(0.1, 0.5)), 2),
        SkySpec("high_sun", high, 1.0, float(rng.uniform(0.0, 0.3)), 3),
        SkySpec("overcast", None, 1.5, 1.0, 4),
    )


def more_sky_specs(plan: StreetPlan) -> tuple[SkySpec, ...]:
    """Return three more target skies: opposite sun, broken clouds, and a veiled sun."""
    rng = np.random.default_rng([plan.seed, 11])
    azimuth = plan.sun.azimuth_deg

    def sun(low_deg: float, high_deg: float, elevation_deg: float) -> SolarPosition:
        turn = float(rng.uniform(low_deg, high_deg)) * float(rng.choice([-1.0, 1.0]))
        return SolarPosition((azimuth + turn) % 360.0, elevation_deg)

    return (
        SkySpec("opposite_sun", sun(150.0, 180.0, 36.0), 0.8, float(rng.uniform(0.0, 0.2)), 5),
        SkySpec("broken_clouds", sun(40.0, 90.0, 46.0), 1.2, float(rng.uniform(0.7, 0.9)), 6),
        SkySpec("veiled_sun", sun(60.0, 140.0, 40.0), 1.4, 0.6, 7, sun_factor=0.3),
    )


def drawn_sky_specs(plan: StreetPlan, count: int) -> tuple[SkySpec, ...]:
    """Draw skies for training: suns at 10 to 60 degrees of elevation, every fourth one veiled."""
    rng = np.random.default_rng([plan.seed, 13])
    specs = []
    for number in range(count):
        sun = SolarPosition(float(rng.uniform(0, 360)), float(rng.uniform(10, 60)))
        level, cloud, factor = rng.uniform(0.5, 1.4), rng.uniform(0, 0.7), rng.uniform(0.2, 0.8)
        transmittance = float(factor) if number % 4 == 3 else 1.0
        name = f"drawn_{number}"
        specs.append(SkySpec(name, sun, float(level), float(cloud), 8 + number, transmittance))
    return tuple(specs)


@dataclass(frozen=True, eq=False)
class Sky:
    """Sky in frame `world`: radiance without the sun, and the sun."""

    spec: SkySpec
    smooth: Float32[np.ndarray, "h w 3"]
    sun: Sun | None

    def dome(self, height_px: int) -> SkyDome:
        """Return the sky dome of the sky file: mean radiance of each pixel, including the sun."""
        radiance = _averaged(self.smooth, height_px)
        return SkyDome(radiance, None) if self.sun is None else add_sun(radiance, self.sun)

    def exposed(self, exposure_ev: float) -> Sky:
        """Return the sky in the scene unit of a camera with another exposure, in stops."""
        if exposure_ev == 0.0:
            return self
        factor = np.float32(2.0**exposure_ev)
        sun = (
            None if self.sun is None else replace(self.sun, irradiance=self.sun.irradiance * factor)
        )
        return replace(self, smooth=self.smooth * factor, sun=sun)

    def sky_irradiance(self) -> Float[np.ndarray, "3"]:
        """Return the RGB irradiance of level ground from the sky without its sun."""
        height = self.smooth.shape[0]
        cosine = np.clip(pixel_directions(height)[..., 2], 0, None) * solid_angles_sr(height)
        return np.einsum("hwc,hw->c", self.smooth.astype(np.float64), cosine)


def build_sky(spec: SkySpec, plan: StreetPlan, height_px: int = 512) -> Sky:
    """Build a sky; its lower half has the radiance of grey ground (albedo 0.18) under it."""
    up = np.array([0.0, 0.0, 1.0])
    towards = up
    sun = None
    if spec.sun is not None:
        towards = direction_world(spec.sun.azimuth_deg, spec.sun.elevation_deg, plan.enu_from_world)
        irradiance = spec.sun_factor * sun_irradiance(spec.sun.elevation_deg)
        sun = Sun(towards, irradiance.astype(np.float32))
    directions = pixel_directions(height_px)
    radiance = _clear(directions, towards) if spec.sun else _overcast(directions)
    radiance = _with_clouds(radiance, directions, spec, plan.seed)
    is_below = directions[..., 2] <= 0
    radiance[is_below] = 0.0
    # Scaled so that the irradiance of level ground, clouds included, is that of the spec.
    weight = np.clip(directions[..., 2], 0, None) * solid_angles_sr(height_px)
    total = np.einsum("hwc,hw->c", radiance, weight)
    level = spec.sky_irradiance / float(luminance(total))
    ground = level * total / np.pi * 0.18
    if sun is not None:
        ground = ground + sun.irradiance * towards[2] / np.pi * 0.18
    radiance = radiance * level
    radiance[is_below] = ground
    return Sky(spec, radiance.astype(np.float32), sun)


def measured_sky(path: Path, plan: StreetPlan, height_px: int = 512) -> Sky:
    """Read an HDR panorama as the sky of a street, with a random yaw and a random scale.

    The irradiance of level ground is drawn from _MEASURED_SKY_IRRADIANCE. The lower half is kept.

    Raises:
        InputError: the file is not a readable panorama.
    """
    radiance = read_sky(path).radiance
    # Depends on the file's name, so that adding a file does not change the other skies.
    rng = np.random.default_rng([plan.seed, 7, crc32(path.stem.encode())])
    dome = SkyDome(radiance, find_sun(radiance)).rotated(float(rng.uniform(0, 360)))
    wanted = float(np.exp(rng.uniform(*np.log(_MEASURED_SKY_IRRADIANCE))))
    dome = dome.scaled(wanted / max(float(luminance(dome.horizontal_irradiance())), 1e-9))
    rest, sun = split_sun(dome)
    rows = min(height_px, len(rest))
    spec = SkySpec(path.stem, None, wanted, 0.0, 0)
    return Sky(spec, resize_area(rest, rows, 2 * rows), sun)


@dataclass(frozen=True)
class FurtherSkies:
    """Target skies in addition to the three of a street."""

    has_more: bool = False
    """Add the skies of `more_sky_specs`."""
    drawn_suns: int = 0
    """Number of skies of `drawn_sky_specs`."""
    panoramas: tuple[Path, ...] = ()
    """HDR files (`measured_sky`); the name of each sky is the file's stem."""

    def __post_init__(self) -> None:
        check_number("--drawn-suns", self.drawn_suns, 0, 1000)

    @property
    def words(self) -> str:
        """Options of the command for these skies, each with a leading space."""
        words = " --more-skies" if self.has_more else ""
        words += f" --drawn-suns {self.drawn_suns}" if self.drawn_suns else ""
        names = " ".join(path.name for path in self.panoramas)
        return words + (f" --sky {names}" if names else "")

    def of(self, plan: StreetPlan) -> list[Sky]:
        """Build the skies for a street.

        Raises:
            InputError: a file is not a readable panorama.
        """
        specs = more_sky_specs(plan) if self.has_more else ()
        specs += drawn_sky_specs(plan, self.drawn_suns)
        drawn = [build_sky(spec, plan) for spec in specs]
        return drawn + [measured_sky(path, plan) for path in self.panoramas]


def sun_irradiance(elevation_deg: float) -> Float[np.ndarray, "3"]:
    """Return the RGB irradiance facing the sun, in scene units (Beer-Lambert law).

    The relative air mass is equation 3 of Kasten & Young 1989 (doi:10.1364/AO.28.004735).
    """
    sine = np.sin(np.radians(elevation_deg))
    mass = 1.0 / (sine + 0.50572 * (elevation_deg + 6.07995) ** -1.6364)
    return _SUN_AT_ZENITH * np.exp(-_EXTINCTION_RGB * mass)


def environment(sky: Sky, height_px: int) -> Float32[np.ndarray, "h w 3"]:
    """Resample the sky without sun for a renderer with texel centres u = j / w, v = i / (h - 1)."""
    width = 2 * height_px
    polar = np.linspace(0.0, np.pi, height_px)[:, None]
    azimuth = (0.5 - np.arange(width) / width) * 2 * np.pi
    sine = np.sin(polar)
    grid = np.stack(
        [sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(polar) + 0 * azimuth], axis=-1
    )
    return sample_bilinear(sky.smooth, grid).astype(np.float32)


def _gradation(z: Float[np.ndarray, "h w"], a: float, b: float) -> Float[np.ndarray, "h w"]:
    """Evaluate the CIE gradation function; z is the sine of the elevation."""
    return 1 + a * np.exp(b / np.maximum(z, 0.03))


def _clear(
    directions: Float[np.ndarray, "h w 3"], towards: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "h w 3"]:
    """Return the CIE clear sky, with a colour that whitens towards the horizon and the sun."""
    a, b, c, d, e = _CLEAR
    cosine = np.clip(directions @ towards, -1.0, 1.0)
    angle = np.arccos(cosine)
    indicatrix = 1 + c * (np.exp(d * angle) - np.exp(d * np.pi / 2)) + e * cosine**2
    luminous = _gradation(directions[..., 2], a, b) * indicatrix
    # Fraction of white in the colour; fitted by eye.
    haze = np.exp(-4.5 * np.clip(directions[..., 2], 0, 1)) + 0.6 * np.exp(-((angle / 0.35) ** 2))
    haze = np.clip(haze, 0, 1)[..., None]
    blue, white = np.array([0.42, 0.80, 1.75]), np.array([0.92, 1.0, 1.12])
    return luminous[..., None] * ((1 - haze) * blue + haze * white)


def _overcast(directions: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    a, b = _OVERCAST
    return _gradation(directions[..., 2], a, b)[..., None] * np.array([0.97, 1.0, 1.05])


def _with_clouds(
    radiance: Float[np.ndarray, "h w 3"],
    directions: Float[np.ndarray, "h w 3"],
    spec: SkySpec,
    seed: int,
) -> Float[np.ndarray, "h w 3"]:
    """Add thin white clouds on a horizontal plane; an overcast sky gets soft structure instead."""
    field = noise(np.random.default_rng([seed, 6, spec.seed]), 512, 512, 1.6)
    # The limit of z avoids aliasing of the noise near the horizon.
    z = np.maximum(directions[..., 2], 0.06)
    i = np.round(directions[..., 0] / z * 48).astype(np.int64) % 512
    j = np.round(directions[..., 1] / z * 48).astype(np.int64) % 512
    value = field[i, j]
    if spec.sun is None:
        return radiance * (1 + 0.08 * value)[..., None]
    cover = np.clip(value - 1.6 + 1.9 * spec.cloud_amount, 0, 1) * np.clip(6 * z - 0.6, 0, 1)
    # Clouds are as bright as 1.9 times the median of the sky, or as the sky behind them.
    white = 1.9 * np.median(radiance[directions[..., 2] > 0.05]) * np.array([1.0, 1.0, 1.02])
    cover = cover[..., None] * 0.75
    return radiance * (1 - cover) + np.maximum(white, radiance) * cover


def _averaged(image: Float32[np.ndarray, "h w 3"], height_px: int) -> Float32[np.ndarray, "p q 3"]:
    """Average an image over blocks, weighted by solid angle."""
    k = image.shape[0] // height_px
    weight = np.broadcast_to(solid_angles_sr(image.shape[0])[..., None], image.shape)
    blocks = (height_px, k, 2 * height_px, k, 3)
    total = (image * weight).reshape(blocks).sum(axis=(1, 3))
    return (total / weight.reshape(blocks).sum(axis=(1, 3))).astype(np.float32)
