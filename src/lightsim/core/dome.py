"""Sky domes: equirectangular HDR radiance in frame `world`, with an explicit sun."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy.typing import ArrayLike

from lightsim.core.colour import luminance
from lightsim.core.equirect import (
    cosine_weights_sr,
    directions_from_uv,
    pixel_directions,
    sample_bilinear,
    solid_angles_sr,
    uv_from_directions,
)
from lightsim.core.resample import resize_sphere
from lightsim.errors import InputError

SOLAR_RADIUS_DEG = 0.265
"""Mean angular radius of the solar disc."""
MAX_RADIANCE = 1e15
"""Largest accepted radiance, scene units: sums of squares over 1e7 pixels stay within float32. No
sun is as bright: an irradiance of 1e5 over the solar disc is a radiance of 1.5e9."""
# Radius of the region around the sun whose excess radiance belongs to the sun, degrees: it holds
# the glare of the cameras that took the skies. Chosen; sensitivity not measured.
_SUN_REGION_DEG = 4.0
# Rotations this close to a whole number of columns, in columns, are not interpolated: rounding of
# the angle must not blur a sky.
_WHOLE_COLUMN = 1e-6


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
        """Angle above the horizon; negative below it."""
        return float(np.degrees(np.arcsin(np.clip(self.direction_world[2], -1, 1))))

    def rotated(self, yaw_deg: float) -> Sun:
        """Return the sun rotated about z, counter-clockwise from above."""
        c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return Sun(rotation @ self.direction_world, self.irradiance, self.angular_radius_deg)


@dataclass(frozen=True, eq=False)
class SkyDome:
    """Radiance of the whole sphere, row 0 at the zenith; the image includes the sun.

    Args:
        radiance: linear RGB, scene units, non-negative.
        sun: direction and irradiance of the sun that the image contains, if any.

    Raises:
        InputError: the image is not (h, 2h, 3) with h >= 2, or has values that are negative,
            not finite, or above MAX_RADIANCE.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    sun: Sun | None

    def __post_init__(self) -> None:
        height, width = self.radiance.shape[:2]
        if width != 2 * height or height < 2:
            raise InputError(
                "a sky dome must be twice as wide as high",
                got=f"{width}x{height} px",
                expected=f"{2 * height}x{height} px",
            )
        if not np.isfinite(self.radiance).all() or (self.radiance < 0).any():
            raise InputError(
                "a sky dome has negative or non-finite radiance",
                remedy="Clip it at zero and replace infinities before use.",
            )
        _require_in_range(float(self.radiance.max()))

    @property
    def height_px(self) -> int:
        """Rows of the image; it has twice as many columns."""
        return self.radiance.shape[0]

    def horizontal_irradiance(self) -> Float[np.ndarray, "3"]:
        """RGB irradiance on level ground, sun included."""
        return self.irradiance(np.array([0.0, 0.0, 1.0]))

    @functools.cached_property
    def mean_radiance(self) -> Float[np.ndarray, "3"]:
        """RGB mean over all directions."""
        rows = self.radiance.sum(axis=1, dtype=np.float64)
        return (rows * solid_angles_sr(self.height_px)).sum(axis=0) / (4 * np.pi)

    @functools.cached_property
    def parts(self) -> tuple[Float32[np.ndarray, "h w 3"], Sun | None]:
        """Radiance without the sun, and the sun: see `split_sun`. Searched for once per dome."""
        direction = self.sun.direction_world if self.sun else _sun_direction(self.radiance)
        return (self.radiance, None) if direction is None else _parted(self, direction)

    def irradiance(self, normal_world: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Return the RGB irradiance on a surface with a normal; the light of a known sun arrives
        from its exact direction, not from the centres of its pixels."""
        lifted = _lifted_sun(self)
        if lifted is None:
            return irradiance(self.radiance, normal_world)
        cosine = max(0.0, float(lifted.sun.direction_world @ normal_world))
        return irradiance(lifted.rest, normal_world) + lifted.energy * cosine

    def scaled(self, factor: ArrayLike | float) -> SkyDome:
        """Return the dome with radiance and sun multiplied by a number or an RGB factor.

        Raises:
            InputError: the product exceeds MAX_RADIANCE.
        """
        exact = np.broadcast_to(np.asarray(factor, dtype=np.float64), (3,))
        _require_in_range(float(self.radiance.max()) * float(exact.max()))
        # The factor alone, too: a black dome accepts any factor, but its sun and float32 do not.
        _require_in_range(float(exact.max()))
        rgb = exact.astype(np.float32)
        sun = self.sun and Sun(
            self.sun.direction_world,
            (self.sun.irradiance * rgb).astype(np.float32),
            self.sun.angular_radius_deg,
        )
        return SkyDome((self.radiance * rgb).astype(np.float32), sun)

    def rotated(self, yaw_deg: float) -> SkyDome:
        """Return the sky rotated about z, counter-clockwise from above, with the same total energy.

        Between whole columns the sky is interpolated. A known sun is not: it is taken out and put
        into the pixels that its disc covers at the new azimuth.

        Raises:
            InputError: the angle is not finite.
        """
        if not np.isfinite(yaw_deg):
            raise InputError(
                "the sky cannot be turned by this angle",
                got=f"{yaw_deg} degrees",
                expected="a finite number",
            )
        # Columns grow clockwise from above, the angle counter-clockwise: hence the sign.
        yaw_deg = float(np.fmod(yaw_deg, 360.0))
        shift = -yaw_deg / 360.0 * self.radiance.shape[1]
        if abs(shift) < _WHOLE_COLUMN:
            return SkyDome(self.radiance, self.sun and self.sun.rotated(yaw_deg))
        # A known sun is put into its pixels anew even for whole columns, so that rotations by whole
        # columns and by other angles treat it alike.
        if self.sun is None and abs(shift - round(shift)) < _WHOLE_COLUMN:
            return SkyDome(np.roll(self.radiance, round(shift), axis=1), None)
        lifted = _lifted_sun(self)
        whole = int(np.floor(shift))
        part = shift - whole
        rolled = np.roll(self.radiance if lifted is None else lifted.rest, whole, axis=1)
        rolled = (1 - part) * rolled + part * np.roll(rolled, 1, axis=1)
        if lifted is None:
            return SkyDome(rolled.astype(np.float32), self.sun and self.sun.rotated(yaw_deg))
        sun = lifted.sun.rotated(yaw_deg)
        return SkyDome(_with_disc(rolled, sun, lifted.energy), sun)

    def look_up(self, directions_world: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Return the radiance from unit directions, bilinear between pixel centres."""
        return sample_bilinear(self.radiance, directions_world)


def _require_in_range(largest: float) -> None:
    if not largest <= MAX_RADIANCE:
        raise InputError(
            "the sky is too bright",
            got=f"a radiance or scale of {largest:g}",
            expected=f"at most {MAX_RADIANCE:g}",
            remedy="Scale it down, or find the broken pixels.",
        )


def irradiance(
    radiance: Float[np.ndarray, "h w 3"], normal_world: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Return the RGB irradiance on a surface with a normal: the integral of radiance x cosine."""
    weight = cosine_weights_sr(radiance.shape[0], normal_world)
    return np.einsum("hwc,hw->c", radiance.astype(np.float64), weight)


def add_sun(radiance: Float[np.ndarray, "h w 3"], sun: Sun) -> SkyDome:
    """Return the dome of a sky without a sun plus a sun, whose energy is added to the pixels that
    its disc covers.

    The disc is sampled with many points, so that its energy is exact at any resolution: a disc of
    0.53 degrees is smaller than a pixel below 680 columns.
    """
    return SkyDome(_with_disc(radiance, sun, sun.irradiance), sun)


def _with_disc(
    radiance: Float[np.ndarray, "h w 3"], sun: Sun, energy: Float[np.ndarray, "3"]
) -> Float32[np.ndarray, "h w 3"]:
    index, added = _disc_radiance(sun, energy, len(radiance))
    flat = radiance.astype(np.float64).reshape(-1, 3)
    flat[index] += added
    return flat.reshape(radiance.shape).astype(np.float32)


def _disc_radiance(
    sun: Sun, energy: Float[np.ndarray, "3"], height_px: int
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Return flat indices of the pixels that the disc covers, and the radiance it adds to each."""
    across_px = 2 * sun.angular_radius_deg / 180.0 * height_px
    # 32 points for each pixel of the square around the disc, and at least 256. Chosen; sensitivity
    # not measured.
    count = int(max(256, 32 * across_px**2))
    uv = uv_from_directions(disc_directions(sun.direction_world, sun.angular_radius_deg, count))
    column = np.minimum((uv[:, 0] * 2 * height_px).astype(np.int64), 2 * height_px - 1)
    row = np.minimum((uv[:, 1] * height_px).astype(np.int64), height_px - 1)
    index, hits = np.unique(row * 2 * height_px + column, return_counts=True)
    fraction = hits / count / solid_angles_sr(height_px)[index // (2 * height_px), 0]
    return index, fraction[:, None] * energy


@dataclass(frozen=True, eq=False)
class _LiftedSun:
    """A dome split into its known sun, with the energy of its pixels, and the remaining sky."""

    sun: Sun
    energy: Float[np.ndarray, "3"]
    rest: Float[np.ndarray, "h w 3"]


def _lifted_sun(dome: SkyDome) -> _LiftedSun | None:
    """Split off the known sun: the radiance of its disc's pixels above that of their neighbours.

    Unlike in `split_sun`, the glow around the disc remains part of the sky.
    """
    if dome.sun is None:
        return None
    height, width = dome.radiance.shape[:2]
    index, disc = _disc_radiance(dome.sun, dome.sun.irradiance, height)
    flat = dome.radiance.astype(np.float64).reshape(-1, 3)
    row, column = np.divmod(index, width)
    steps = (-1, 0, 1)
    near = [
        np.clip(row + dy, 0, height - 1) * width + (column + dx) % width
        for dy in steps
        for dx in steps
    ]
    around = np.setdiff1d(np.concatenate(near), index)
    level = flat[around].mean(axis=0) if len(around) else np.zeros(3)
    # Never more than the known sun has: another bright source in these pixels stays in the sky.
    excess = np.minimum(disc, np.maximum(flat[index] - level, 0.0))
    flat[index] -= excess
    solid_angle = solid_angles_sr(height)[row]
    energy = (excess * solid_angle).sum(axis=0)
    return _LiftedSun(dome.sun, energy, flat.reshape(height, width, 3))


def disc_directions(
    centre: Float[np.ndarray, "3"], radius_deg: float, count: int
) -> Float[np.ndarray, "n 3"]:
    """Return unit vectors distributed evenly over a small disc on the sphere (Vogel's spiral)."""
    k = np.arange(count) + 0.5
    radius = np.radians(radius_deg) * np.sqrt(k / count)
    angle = k * np.pi * (3.0 - np.sqrt(5.0))
    z = centre / np.linalg.norm(centre)
    # Any axis that is not nearly parallel to the centre spans the tangent plane.
    helper = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    planar = np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * y
    return np.cos(radius)[:, None] * z + np.sin(radius)[:, None] * planar


def split_sun(dome: SkyDome) -> tuple[Float32[np.ndarray, "h w 3"], Sun | None]:
    """Return the dome without its sun, and the sun with the energy of its pixels.

    In a dome without a known sun, the sun is searched for (`find_sun`). Within 4 degrees of the
    sun (more for coarse pixels), radiance above the 90th percentile of the surrounding ring belongs
    to the sun. The energies of both parts add up to that of the dome. The arrays are cached in the
    dome: do not write to them.
    """
    return dome.parts


def _parted(
    dome: SkyDome, direction: Float[np.ndarray, "3"]
) -> tuple[Float32[np.ndarray, "h w 3"], Sun | None]:
    height = dome.height_px
    cosine = pixel_directions(height) @ direction
    pixel_deg = 180.0 / height
    core_deg = max(_SUN_REGION_DEG, 1.6 * pixel_deg)
    core = cosine >= np.cos(np.radians(core_deg))
    ring = (cosine >= np.cos(np.radians(core_deg + max(3.0, 1.5 * pixel_deg)))) & ~core
    # A high percentile instead of the mean: the sky brightens towards the sun, and that glow is no
    # part of the sun.
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
    """Return the sun of an HDR sky, or None if no small, dominant source is above the horizon."""
    return split_sun(SkyDome(radiance, None))[1]


def _sun_direction(radiance: Float32[np.ndarray, "h w 3"]) -> Float[np.ndarray, "3"] | None:
    """Return the energy-weighted centre of the brightest spot of the upper half if it is a sun: at
    least 30 times the median sky, and 3 % of the light on a surface that faces it."""
    # Both thresholds were chosen; sensitivity not measured. The second one excludes glints and
    # lamps, which are bright but small.
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
    """Return the dome at another height in pixels; direction and energy of the sun are unchanged.

    The sky without its sun (`split_sun`) is averaged by solid angle, or looked up bilinearly where
    pixels become smaller, and its rows are scaled by about 1, so that energy and irradiance on
    level surfaces, facing up or down, stay. Then the sun is added again.
    """
    if height_px == dome.height_px:
        return dome
    rest, sun = split_sun(dome)
    sky = resize_sphere(rest, height_px)
    sky = (sky * _row_factors(rest, sky)[:, None]).astype(np.float32)
    return SkyDome(sky, dome.sun) if sun is None else add_sun(sky, sun)


def _row_factors(
    old: Float[np.ndarray, "a b 3"], new: Float[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h 3"]:
    """Return RGB factors of the new rows that restore the energy and the irradiance on level
    surfaces from above and from below: coarse rows mix radiance of different cosines."""
    # Factor of a row: 1 plus a combination of the three bases, which meets three conditions: equal
    # sums of energy times each base. Least squares, as two rows do not determine three numbers.
    energy, bases = _row_energy(new), _row_bases(len(new))
    missing = _row_bases(len(old)).T @ _row_energy(old) - bases.T @ energy
    factors = np.ones_like(energy)
    for channel in range(3):
        system = bases.T @ (energy[:, channel, None] * bases)
        factors[:, channel] += bases @ np.linalg.lstsq(system, missing[:, channel], rcond=1e-9)[0]
    # Factors are about 1; the limits matter for skies of few rows or with nearly black halves.
    return np.clip(factors, 0.5, 2.0)


def _row_energy(radiance: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h 3"]:
    return radiance.sum(axis=1, dtype=np.float64) * solid_angles_sr(len(radiance))


def _row_bases(height_px: int) -> Float[np.ndarray, "h 3"]:
    """Return, for each row, 1 and the mean cosines to the zenith and to the nadir."""
    z = np.cos(np.linspace(0.0, np.pi, height_px + 1))
    size = z[:-1] - z[1:]
    above, below = np.clip(z, 0, None) ** 2, np.clip(-z, 0, None) ** 2
    cosines = (np.diff(-above) / (2 * size), np.diff(below) / (2 * size))
    return np.stack([np.ones(height_px), *cosines], axis=-1)
