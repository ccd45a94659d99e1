"""Batches of the lighting networks, drawn from one cache file with NumPy alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32

from lightsim.core.colour import luminance
from lightsim.core.equirect import solid_angles_sr, uv_from_directions
from lightsim.errors import InputError
from lightsim.lighting.sample import LightingBatch, PanoramaBatch
from lightsim_lab.training import grids
from lightsim_lab.training.camera_simulation import add_glare, exposure, pictures
from lightsim_lab.training.hdr_skies import HdrSky, Side, spot_centre
from lightsim_lab.training.lighting_cache import LightingCache, read_cache
from lightsim_lab.training.procedural_skies import (
    UpperSky,
    is_sunny,
    random_clear_sky,
    random_overcast_sky,
    rotated_sky,
    upper_sky_of,
    with_clouds,
    with_sun_raised,
)
from lightsim_lab.training.rigs import front_view, rig_mask
from lightsim_lab.training.street_panoramas import HORIZON_AZIMUTHS, light_view

# Maximum number of draws of a training sky with a clear sun; after them the last draw is used.
_MAX_SUN_DRAWS = 60
# Largest radiance of a target sky, so that sums remain finite in single precision.
_MAX_PEAK = 1e9
# Rows and columns of the front image.
_FRONT_PX = (40, 64)


@dataclass(frozen=True)
class _Mixture:
    """Fractions of the kinds of training samples; chosen, not measured."""

    own_scene: float = 0.4
    """HDR panoramas with their own lower half; the other samples are streets under a sky."""
    measured: float = 0.5
    """Measured skies over streets; the others are procedural."""
    measured_clouds: float = 0.2
    """Measured skies over streets that get procedural clouds."""
    overcast: float = 0.25
    """Overcast skies among the procedural ones."""
    clouds: float = 0.6
    """Clear procedural skies that get clouds."""
    along_street: float = 0.85
    """Ego vehicles that drive along the street; the others have any heading."""


_MIXTURE = _Mixture()


@dataclass(frozen=True, eq=False)
class FixedViews:
    """Fixed views of held-out skies.

    Args:
        names: name of the HDR file of each view.
        tiers: see `hdr_skies.SplitEntry`.
        own_scene: True: the view shows the HDR's own place; False: a held-out street under its sky.
    """

    batch: LightingBatch
    names: tuple[str, ...]
    tiers: tuple[str, ...]
    own_scene: Bool[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class _Sample:
    panorama: Float32[np.ndarray, "h w 3"]
    visibility: Bool[np.ndarray, "h w"]
    front: Float32[np.ndarray, "a b 3"]
    sky: Float32[np.ndarray, "h/2 w 3"]
    sky_seen: Bool[np.ndarray, "h/2 w"]
    sun_direction: Float32[np.ndarray, "3"]
    log_peak: float
    is_sunny: bool


class LightingSet:
    """Source of batches (`lighting.sample.LightingData`) from a cache of `train prepare lighting`.

    The forward direction of the ego vehicle is +x of the panorama, its centre column. The training
    side has train skies (rotated, mirrored, with other exposures and sun positions) and procedural
    skies over train streets. The other sides have held-out skies, unchanged except for random yaw
    and exposure, with their own lower half or over held-out streets. Thread-safe.

    Args:
        ldr_fraction: fraction of LDR panoramas in `panoramas`, if this side has any.

    Raises:
        InputError: the cache has no skies or no streets of this side.
    """

    def __init__(
        self,
        cache: LightingCache,
        split: Side = "train",
        *,
        ldr_fraction: float = 0.5,
    ) -> None:
        self._cache = cache
        self._ldr = [picture for picture in cache.ldr if picture.side == split]
        self._ldr_fraction = ldr_fraction if self._ldr else 0.0
        self.height_px: int = cache.height_px
        self.split: Side = split
        self._skies = [sky for sky in cache.skies if sky.entry.split == split]
        self._views = [
            view for view, side in zip(cache.views, cache.view_sides, strict=True) if side == split
        ]
        if not self._skies or not self._views:
            raise InputError(
                f"the cache contains no skies or no streets of the side '{split}'",
                got=f"{len(self._skies)} skies and {len(self._views)} street positions",
                remedy="Make the cache with a split file that has skies of this side.",
            )

    @classmethod
    def load(
        cls,
        path: Path,
        split: Side = "train",
    ) -> LightingSet:
        """Read and check a cache.

        Raises:
            InputError: the file is missing, damaged, of another version, or has no such side.
        """
        return cls(read_cache(path), split)

    def batch(self, size: int, seed: int, index: int, *, only_sunny: bool) -> LightingBatch:
        """Return the batch of a seed and number; see `LightingData`."""
        samples = [
            self._draw(np.random.default_rng([seed, index, k]), only_sunny) for k in range(size)
        ]
        return _stacked(samples)

    def panoramas(self, size: int, seed: int, index: int) -> PanoramaBatch:
        """Return a batch for the inpainting; see `lighting.sample.PanoramaData`."""
        # Separate random streams, so that the LDR panoramas do not change the other samples.
        samples = [
            self._picture(
                np.random.default_rng([seed, index, k]), np.random.default_rng([seed, index, k, 1])
            )
            for k in range(size)
        ]
        return PanoramaBatch(*(np.stack(part) for part in zip(*samples, strict=True)))

    def _picture(
        self, rng: np.random.Generator, ldr_rng: np.random.Generator
    ) -> tuple[Float32[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
        """Return a panorama and its visibility mask; LDR panoramas are rotated and mirrored."""
        if ldr_rng.random() >= self._ldr_fraction:
            sample = self._draw(rng, only_sunny=False)
            return sample.panorama, sample.visibility
        srgb8 = self._ldr[int(ldr_rng.integers(len(self._ldr)))].srgb8
        if self.split == "train" and ldr_rng.random() < 0.5:
            srgb8 = srgb8[:, ::-1]
        turned = np.roll(srgb8, int(ldr_rng.integers(srgb8.shape[1])), axis=1)
        mask = rig_mask(self.height_px, ldr_rng)
        return (turned / np.float32(255)).astype(np.float32), mask

    def fixed_views(self, per_sky: int = 8, seed: int = 0) -> FixedViews:
        """Return `per_sky` views of every sky of this side, with random but reproducible rigs."""
        samples, names, tiers, own = [], [], [], []
        for number, sky in enumerate(self._skies):
            for k in range(per_sky):
                # 77 separates this random stream from those of the batches.
                rng = np.random.default_rng([seed, 77, number, k])
                is_own = sky.entry.scene == "canopy" or (sky.entry.scene == "ground" and k % 2 == 0)
                samples.append(self._own(sky, rng) if is_own else self._over_street(sky, rng))
                names.append(sky.entry.name)
                tiers.append(sky.entry.tier)
                own.append(is_own)
        return FixedViews(_stacked(samples), tuple(names), tuple(tiers), np.array(own))

    def _draw(self, rng: np.random.Generator, only_sunny: bool) -> _Sample:
        # Validation and test sides have measured skies alone, without augmentation.
        if self.split != "train":
            pool = self._sunny_skies if only_sunny else self._skies
            sky = pool[int(rng.integers(len(pool)))]
            has_own = sky.entry.scene != "none" and rng.random() < 0.5
            is_own = has_own or sky.entry.scene == "canopy"
            return self._own(sky, rng) if is_own else self._over_street(sky, rng)
        if rng.random() < _MIXTURE.own_scene:
            pool = self._own_places(only_sunny)
            return self._own(pool[int(rng.integers(len(pool)))], rng)
        upper = self._training_sky(rng)
        for _ in range(_MAX_SUN_DRAWS):
            if not only_sunny or is_sunny(upper):
                break
            upper = self._training_sky(rng)
        return self._street_sample(upper, rng)

    @cached_property
    def _sunny_skies(self) -> list[HdrSky]:
        sunny = [sky for sky in self._skies if is_sunny(upper_sky_of(sky))]
        return sunny or self._skies

    def _own_places(self, only_sunny: bool) -> list[HdrSky]:
        pool = self._sunny_skies if only_sunny else self._skies
        return [sky for sky in pool if sky.entry.scene != "none"] or pool

    @cached_property
    def _open_skies(self) -> list[HdrSky]:
        # Trees or roofs of a canopy would appear as sky over another scene.
        return [sky for sky in self._skies if sky.entry.scene != "canopy"] or self._skies

    def _training_sky(self, rng: np.random.Generator) -> UpperSky:
        """Draw a sky to light a street, with any azimuth of the sun."""
        cache = self._cache
        if rng.random() < _MIXTURE.measured:
            open_skies = self._open_skies
            upper = upper_sky_of(open_skies[int(rng.integers(len(open_skies)))])
            upper = _varied(upper, rng)
            if rng.random() < _MIXTURE.measured_clouds:
                upper = with_clouds(upper, cache.noise, rng)
        elif rng.random() < _MIXTURE.overcast:
            upper = random_overcast_sky(cache.noise, cache.height_px, rng)
        else:
            upper = _varied(random_clear_sky(cache.clear, rng), rng)
            if rng.random() < _MIXTURE.clouds:
                upper = with_clouds(upper, cache.noise, rng)
        return _turned_randomly(upper, rng, flip=True)

    def _over_street(self, sky: HdrSky, rng: np.random.Generator) -> _Sample:
        return self._street_sample(_turned_randomly(upper_sky_of(sky), rng, flip=False), rng)

    def _street_sample(self, upper: UpperSky, rng: np.random.Generator) -> _Sample:
        view = self._views[int(rng.integers(len(self._views)))]
        linear, sky_seen = light_view(view, upper)
        # Streets run along +x: the ego vehicle faces either end, with a small random yaw.
        columns = int(rng.integers(linear.shape[1]))
        if rng.random() < _MIXTURE.along_street:
            back = float(rng.choice([0.0, 0.5]))
            columns = round(linear.shape[1] * (back + float(rng.normal(0.0, 0.015))))
        turned = rotated_sky(upper, columns, flip=False)
        linear, sky_seen = np.roll(linear, columns, axis=1), np.roll(sky_seen, columns, axis=1)
        return self._finish(linear, turned, sky_seen, rng)

    def _own(self, sky: HdrSky, rng: np.random.Generator) -> _Sample:
        """Return an HDR panorama at a random yaw; in training, half of them are mirrored."""
        flip = self.split == "train" and rng.random() < 0.5
        upper = upper_sky_of(sky)
        linear = np.concatenate([upper.rest, sky.rest[len(upper.rest) :]])
        seen = sky.sky_seen
        columns = int(rng.integers(upper.rest.shape[1]))
        upper = rotated_sky(upper, columns, flip=flip)
        if flip:
            linear, seen = linear[:, ::-1], seen[:, ::-1]
        if self.split == "train":
            gains = _colour_change(rng)
            upper = UpperSky(
                (upper.rest * gains).astype(np.float32),
                upper.sun_direction,
                upper.sun_irradiance * gains,
            )
            linear = (linear * gains).astype(np.float32)
        linear, seen = np.roll(linear, columns, axis=1), np.roll(seen, columns, axis=1)
        return self._finish(linear, upper, seen, rng)

    def _finish(
        self,
        linear: Float32[np.ndarray, "h w 3"],
        upper: UpperSky,
        sky_seen: Bool[np.ndarray, "h/2 w"],
        rng: np.random.Generator,
    ) -> _Sample:
        """Add glare, mask, exposure and camera response to a linear panorama (centre: forward)."""
        # Glare only where the sun is neither occluded nor below the horizon.
        row, column = _pixel_of(upper.sun_direction, self.height_px)
        has_sun = bool(upper.sun_irradiance.any()) and upper.sun_direction[2] > 0
        if has_sun and sky_seen[min(row, len(sky_seen) - 1), column]:
            linear = add_glare(linear, upper.sun_direction, upper.sun_irradiance, rng)
        visibility = rig_mask(self.height_px, rng)
        # Auto-exposure uses only the observed pixels; the target sky has the same units.
        gains = exposure(linear, visibility, rng)
        exposed = (linear * gains).astype(np.float32)
        front = front_view(exposed, _FRONT_PX, rng)
        panorama, front = pictures(exposed, front, rng)
        sky, direction = dome_of(upper)
        sky = np.minimum(sky * gains, _MAX_PEAK).astype(np.float32)
        return _Sample(
            panorama,
            visibility,
            front,
            sky,
            sky_seen.copy(),
            direction.astype(np.float32),
            float(np.log(max(float(luminance(sky).max()), 1e-6))),
            is_sunny(upper),
        )


def dome_of(upper: UpperSky) -> tuple[Float32[np.ndarray, "h w 3"], Float[np.ndarray, "3"]]:
    """Return the upper half with the sun in one pixel, and the direction of the brightest spot.

    The pixel at the sun's centre gets its whole irradiance. The direction is that of the sun, or
    of a pixel without sun that is brighter.
    """
    height = 2 * upper.rest.shape[0]
    sky = upper.rest.copy()
    if upper.sun_irradiance.any() and upper.sun_direction[2] > 0:
        row, column = _pixel_of(upper.sun_direction, height)
        disc = upper.sun_irradiance / solid_angles_sr(height)[row, 0]
        sky[row, column] += disc.astype(np.float32)
        if luminance(sky[row, column]) >= luminance(upper.rest).max():
            return sky, upper.sun_direction
    value = luminance(sky).astype(np.float64)
    return sky, spot_centre(value, grids.directions(height)[: height // 2], 0.7)


def _pixel_of(direction: Float[np.ndarray, "3"], height: int) -> tuple[int, int]:
    u, v = uv_from_directions(direction[None])[0]
    return min(int(v * height), height - 1), min(int(u * 2 * height), 2 * height - 1)


def _varied(upper: UpperSky, rng: np.random.Generator) -> UpperSky:
    """Change a sky's sun elevation (by up to a third), sun irradiance and colour at random."""
    elevation = float(np.degrees(np.arcsin(np.clip(upper.sun_direction[2], -1, 1))))
    if upper.sun_irradiance.any() and 1.0 < elevation < 85.0:
        wanted = elevation * float(np.exp(rng.uniform(-0.3, 0.3))) + float(rng.normal(0, 1.0))
        upper = with_sun_raised(upper, float(np.clip(wanted, 1.0, 85.0)))
    gains = _colour_change(rng)
    sun = upper.sun_irradiance * _colour_change(rng) * float(np.exp(rng.normal(0.0, 0.2)))
    return UpperSky((upper.rest * gains).astype(np.float32), upper.sun_direction, sun)


def _colour_change(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    return np.exp(rng.normal(0.0, 0.05, 3))


def _turned_randomly(upper: UpperSky, rng: np.random.Generator, *, flip: bool) -> UpperSky:
    """Rotate a sky by whole columns, its sun near a random azimuth with stored street horizons."""
    is_flipped = flip and rng.random() < 0.5
    x, y, _ = upper.sun_direction
    azimuth = float(np.arctan2(-y if is_flipped else y, x))
    wanted = 2 * np.pi * int(rng.integers(HORIZON_AZIMUTHS)) / HORIZON_AZIMUTHS
    columns = round((azimuth - wanted) / (2 * np.pi) * upper.rest.shape[1])
    return rotated_sky(upper, columns, flip=is_flipped)


def _stacked(samples: list[_Sample]) -> LightingBatch:
    return LightingBatch(
        np.stack([s.panorama for s in samples]),
        np.stack([s.visibility for s in samples]),
        np.stack([s.front for s in samples]),
        np.stack([s.sky for s in samples]),
        np.stack([s.sky_seen for s in samples]),
        np.stack([s.sun_direction for s in samples]),
        np.array([s.log_peak for s in samples], dtype=np.float32),
        np.array([s.is_sunny for s in samples], dtype=bool),
    )
