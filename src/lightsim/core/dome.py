"""Sky domes: equirectangular HDR radiance in frame `world`, with the sun as a known part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from numpy.typing import ArrayLike

from lightsim.core.colour import luminance
from lightsim.core.equirect import (
    directions_from_uv,
    pixel_directions,
    sample_bilinear,
    solid_angles_sr,
    uv_from_directions,
)
from lightsim.errors import InputError

SOLAR_RADIUS_DEG = 0.265
"""Mean angular radius of the solar disc."""
_SUN_REGION_DEG = 4.0


@dataclass(frozen=True, eq=False)
class Sun:
    """The solar disc.

    Args:
        direction_world: unit vector TOWARDS the sun.
        irradiance: RGB on a surface facing the sun, scene units (radiance x sr).
    """

    direction_world: Float[np.ndarray, "3"]
    irradiance: Float32[np.ndarray, "3"]
    angular_radius_deg: float = SOLAR_RADIUS_DEG

    @property
    def elevation_deg(self) -> float:
        return float(np.degrees(np.arcsin(np.clip(self.direction_world[2], -1, 1))))


@dataclass(frozen=True, eq=False)
class SkyDome:
    """Radiance of the whole sphere, row 0 up, the sun included in the image.

    Args:
        radiance: linear RGB, scene units, non-negative.
        sun: direction and irradiance of the sun that the image contains, if any.

    Raises:
        InputError: the image is not (h, 2h, 3), or has negative or non-finite values.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    sun: Sun | None

    def __post_init__(self) -> None:
        height, width = self.radiance.shape[:2]
        if width != 2 * height:
            raise InputError("a sky dome must be twice as wide as high", got=f"{width}x{height} px")
        if not np.isfinite(self.radiance).all() or (self.radiance < 0).any():
            raise InputError(
                "a sky dome has negative or non-finite radiance",
                remedy="Clip it at zero and replace infinities before use.",
            )

    @property
    def height_px(self) -> int:
        return self.radiance.shape[0]

    def horizontal_irradiance(self) -> Float[np.ndarray, "3"]:
        """RGB irradiance on level ground, sun included."""
        return irradiance(self.radiance, np.array([0.0, 0.0, 1.0]))

    def scaled(self, factor: ArrayLike | float) -> SkyDome:
        """Radiance and sun times a number or an RGB factor."""
        rgb = np.broadcast_to(np.asarray(factor, dtype=np.float32), (3,))
        sun = self.sun and Sun(
            self.sun.direction_world,
            (self.sun.irradiance * rgb).astype(np.float32),
            self.sun.angular_radius_deg,
        )
        return SkyDome((self.radiance * rgb).astype(np.float32), sun)

    def turned(self, yaw_deg: float) -> SkyDome:
        """The sky turned counter-clockwise seen from above; total energy is kept."""
        shift = -yaw_deg / 360.0 * self.radiance.shape[1]
        whole = int(np.floor(shift))
        part = np.float32(shift - whole)
        rolled = np.roll(self.radiance, whole, axis=1)
        if part > 0:
            rolled = (1 - part) * rolled + part * np.roll(rolled, 1, axis=1)
        sun = self.sun
        if sun is not None:
            c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
            rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            sun = Sun(rotation @ sun.direction_world, sun.irradiance, sun.angular_radius_deg)
        return SkyDome(rolled.astype(np.float32), sun)

    def look_up(self, directions_world: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        return sample_bilinear(self.radiance, directions_world)


def irradiance(
    radiance: Float[np.ndarray, "h w 3"], normal_world: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """RGB irradiance on a surface with a normal: the cosine-weighted solid-angle integral."""
    height = radiance.shape[0]
    cosine = np.clip(pixel_directions(height) @ normal_world, 0.0, None)
    weight = cosine * solid_angles_sr(height)
    return np.einsum("hwc,hw->c", radiance.astype(np.float64), weight)


def add_sun(radiance: Float[np.ndarray, "h w 3"], sun: Sun) -> SkyDome:
    """A dome of a sky without sun and a sun; the disc's energy goes into the pixels it covers.

    The disc is sampled with 256 points, so that its irradiance is kept exactly at any
    resolution (a 0.53 degree disc is smaller than a pixel below 680 columns).
    """
    height, width = radiance.shape[:2]
    directions = disc_directions(sun.direction_world, sun.angular_radius_deg, 256)
    uv = uv_from_directions(directions)
    column = np.minimum((uv[:, 0] * width).astype(np.int64), width - 1)
    row = np.minimum((uv[:, 1] * height).astype(np.int64), height - 1)
    share = np.zeros((height, width))
    np.add.at(share, (row, column), 1.0 / len(uv))
    added = share[..., None] * sun.irradiance / solid_angles_sr(height)[..., None]
    return SkyDome((radiance + added).astype(np.float32), sun)


def disc_directions(
    centre: Float[np.ndarray, "3"], radius_deg: float, count: int
) -> Float[np.ndarray, "n 3"]:
    """Unit vectors spread evenly over a small disc on the sphere (Vogel's spiral)."""
    k = np.arange(count) + 0.5
    radius = np.radians(radius_deg) * np.sqrt(k / count)
    angle = k * np.pi * (3.0 - np.sqrt(5.0))
    z = centre / np.linalg.norm(centre)
    helper = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    planar = np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * y
    return np.cos(radius)[:, None] * z + np.sin(radius)[:, None] * planar


def split_sun(dome: SkyDome) -> tuple[Float32[np.ndarray, "h w 3"], Sun | None]:
    """The dome without its sun, and the sun with the energy that the image gives it.

    A dome without a known sun is searched for one (`find_sun`). Inside 4 degrees of the sun
    (more where pixels are coarse), what exceeds the brightest tenth of the surrounding ring is
    the sun's. The two parts add up to the dome's energy.
    """
    direction = dome.sun.direction_world if dome.sun else _sun_direction(dome.radiance)
    if direction is None:
        return dome.radiance, None
    height = dome.height_px
    cosine = pixel_directions(height) @ direction
    pixel_deg = 180.0 / height
    core_deg = max(_SUN_REGION_DEG, 1.6 * pixel_deg)
    core = cosine >= np.cos(np.radians(core_deg))
    ring = (cosine >= np.cos(np.radians(core_deg + max(3.0, 1.5 * pixel_deg)))) & ~core
    ring_rgb = np.percentile(dome.radiance[ring], 90, axis=0) if ring.any() else np.zeros(3)
    without = dome.radiance.copy()
    without[core] = np.minimum(without[core], ring_rgb.astype(np.float32))
    excess = (dome.radiance - without).astype(np.float64)
    energy = np.einsum("hwc,hw->c", excess, np.broadcast_to(solid_angles_sr(height), core.shape))
    if luminance(energy.astype(np.float32)) <= 0:
        return dome.radiance, None
    radius = dome.sun.angular_radius_deg if dome.sun else SOLAR_RADIUS_DEG
    return without, Sun(direction, energy.astype(np.float32), radius)


def find_sun(radiance: Float32[np.ndarray, "h w 3"]) -> Sun | None:
    """The sun of an HDR sky, or None where no small, dominant source is above the horizon."""
    direction = _sun_direction(radiance)
    if direction is None:
        return None
    return split_sun(SkyDome(radiance, Sun(direction, np.zeros(3, np.float32))))[1]


def _sun_direction(radiance: Float32[np.ndarray, "h w 3"]) -> Float[np.ndarray, "3"] | None:
    """Energy-weighted centre of the brightest spot of the upper half, if it is sun-like:
    30 times the median sky and 3 % of the light that arrives on a surface facing it."""
    height = radiance.shape[0]
    upper = luminance(radiance[: height // 2].astype(np.float32))
    row, column = np.unravel_index(int(upper.argmax()), upper.shape)
    if upper[row, column] < 30.0 * max(float(np.median(upper)), 1e-12):
        return None
    uv = np.array([(column + 0.5) / (2 * height), (row + 0.5) / height])
    peak = directions_from_uv(uv)
    directions = pixel_directions(height)
    radius_deg = max(_SUN_REGION_DEG / 2, 1.6 * 180.0 / height)
    core = directions @ peak >= np.cos(np.radians(radius_deg))
    value = luminance(radiance)
    weight = np.where(core & (value > 0.1 * value[row, column]), value, 0) * solid_angles_sr(height)
    centre = np.einsum("hw,hwc->c", weight, directions)
    centre /= np.linalg.norm(centre)
    total = float(luminance(irradiance(radiance, centre).astype(np.float32)))
    return centre if weight.sum() >= 0.03 * total else None


def resized(dome: SkyDome, height_px: int) -> SkyDome:
    """The dome at another height by area averaging or bilinear look-up; a sun keeps its energy.

    Shrinking by a whole factor averages by solid angle; otherwise the sky without its sun is
    sampled with 4x4 points a pixel, scaled back to its own energy, and the sun is added again.
    """
    if height_px == dome.height_px:
        return dome
    rest, sun = split_sun(dome)
    offsets = (np.arange(4) + 0.5) / 4
    total = np.zeros((height_px, 2 * height_px, 3))
    for dv in offsets:
        for du in offsets:
            u = (np.arange(2 * height_px) + du) / (2 * height_px)
            v = (np.arange(height_px) + dv) / height_px
            directions = directions_from_uv(np.stack(np.meshgrid(u, v), axis=-1))
            total += sample_bilinear(rest, directions) / 16
    old = (rest.astype(np.float64) * solid_angles_sr(dome.height_px)[..., None]).sum((0, 1))
    new = (total * solid_angles_sr(height_px)[..., None]).sum((0, 1))
    total *= np.where(new > 0, old / np.where(new > 0, new, 1.0), 1.0)
    radiance = total.astype(np.float32)
    return SkyDome(radiance, dome.sun) if sun is None else add_sun(radiance, sun)
