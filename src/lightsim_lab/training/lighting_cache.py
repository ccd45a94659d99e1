"""Cache file of the lighting networks' training data: measured skies, clear skies and streets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Shaped

from lightsim.core.dome import Sun
from lightsim.errors import InputError
from lightsim.progress import Progress, SilentProgress
from lightsim.store.arrays import load_arrays
from lightsim.store.atomic import whole_file
from lightsim_lab.training.hdr_skies import HdrSky, Side, SplitEntry, read_pool, read_split
from lightsim_lab.training.ldr_panoramas import LdrPanorama, read_ldr_pool
from lightsim_lab.training.near_duplicates import check_split
from lightsim_lab.training.procedural_skies import (
    ClearSkies,
    make_clear_skies,
    make_noise,
    pack_noise,
    unpack_noise,
)
from lightsim_lab.training.street_panoramas import StreetConfig, StreetView, trace_streets

# Version of the file format; files of other versions are refused.
VERSION = 2
_VIEW_FIELDS = ("pixel", "albedo", "normal", "met", "horizon")
_REMEDY = "Make it again with lightsim train prepare lighting."


@dataclass(frozen=True)
class PrepareConfig:
    """Size and contents of a cache."""

    height_px: int = 64
    """Height of the panoramas; they are twice as wide."""
    seed: int = 0
    """Seed of all random numbers."""
    clear_count: int = 160
    """Number of analytic clear skies."""
    streets: StreetConfig = field(default_factory=StreetConfig)
    """Streets and camera positions."""


@dataclass(frozen=True, eq=False)
class LightingCache:
    """Skies, streets and LDR panoramas from which batches are drawn."""

    height_px: int
    skies: tuple[HdrSky, ...]
    clear: ClearSkies
    noise: Float32[np.ndarray, "k s s"]
    views: tuple[StreetView, ...]
    view_sides: tuple[Side, ...]
    ldr: tuple[LdrPanorama, ...] = ()


def prepare_cache(
    hdri: Path,
    split: Path | None,
    config: PrepareConfig,
    progress: Progress | None = None,
    ldr: Path | None = None,
) -> LightingCache:
    """Read the skies and LDR panoramas, evaluate the clear skies and trace the streets.

    Raises:
        InputError: the height is odd or below 16, near-duplicates are on two sides of the split,
            or an error of `read_split`, `read_pool` or `read_ldr_pool`.
    """
    height = config.height_px
    if height < 16 or height % 2:
        raise InputError(
            "the height does not fit the networks",
            where="--height",
            got=height,
            expected="an even number of 16 or more",
        )
    progress = progress or SilentProgress()
    entries = None if split is None else read_split(split)
    skies = read_pool(hdri, entries, height, progress)
    check_split(skies)
    pictures = () if ldr is None else read_ldr_pool(ldr, entries, height, progress)
    rng = np.random.default_rng([config.seed, 1])
    clear = make_clear_skies(config.clear_count, height, rng, progress)
    # Rounded as in the file, so that a new and a stored cache give the same batches.
    noise = unpack_noise(pack_noise(make_noise(np.random.default_rng([config.seed, 2]))))
    views, sides = trace_streets(config.streets, height, config.seed, progress)
    return LightingCache(height, skies, clear, noise, tuple(views), tuple(sides), pictures)


def write_cache(path: Path, cache: LightingCache) -> None:
    """Write a cache as one compressed .npz file, atomically."""
    skies = cache.skies
    counts = [len(view.pixel) for view in cache.views]
    is_there = np.array([sky.sun is not None for sky in skies])
    arrays: dict[str, Shaped[np.ndarray, "..."]] = {
        "version": np.array([VERSION, cache.height_px]),
        "sky_entry": np.array(
            [
                (s.entry.name, s.entry.split, s.entry.group, s.entry.tier, s.entry.scene)
                for s in skies
            ]
        ),
        "sky_rest": np.stack([sky.rest for sky in skies]).astype(np.float16),
        "sky_seen": np.stack([sky.sky_seen for sky in skies]),
        "sky_has_sun": is_there,
        "sky_sun": np.stack([_sun_row(sky.sun) for sky in skies]),
        "noise": pack_noise(cache.noise),
        "view_count": np.array(counts),
        "view_side": np.array(cache.view_sides),
        # The key predates the field's name; renaming it would invalidate existing caches.
        "view_share": np.stack([view.surface_fraction for view in cache.views]),
        "ldr_side": np.array([picture.side for picture in cache.ldr], dtype="U10"),
        "ldr_srgb8": np.stack(
            # `stack` requires one item at least; the placeholder is removed again.
            [np.zeros((cache.height_px, 2 * cache.height_px, 3), np.uint8)]
            + [picture.srgb8 for picture in cache.ldr]
        )[1:],
        "clear_elevation_deg": cache.clear.elevation_deg,
        "clear_rest": cache.clear.rest,
        "clear_sun_irradiance": cache.clear.sun_irradiance,
    }
    for name in _VIEW_FIELDS:
        axis = -1 if name in ("met", "horizon") else 0
        arrays[f"view_{name}"] = np.concatenate([getattr(v, name) for v in cache.views], axis=axis)
    with whole_file(path) as temporary, temporary.open("wb") as handle:
        np.savez_compressed(handle, allow_pickle=False, **arrays)


def read_cache(path: Path) -> LightingCache:
    """Return a cache of `write_cache`.

    Raises:
        InputError: the file is missing, damaged or of another version.
    """
    arrays = load_arrays(path)
    try:
        version, height = (int(x) for x in arrays["version"])
        if version != VERSION:
            raise InputError(
                "the training cache has another version",
                where=path,
                got=version,
                expected=VERSION,
                remedy=_REMEDY,
            )
        return _unpacked(arrays, height)
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(
            "the file is no training cache of the lighting networks",
            where=path,
            got=f"{type(error).__name__}: {error}"[:200],
            remedy=_REMEDY,
        ) from error


def _unpacked(arrays: Mapping[str, Shaped[np.ndarray, "..."]], height: int) -> LightingCache:
    skies = []
    for row, rest, seen, has_sun, sun in zip(
        arrays["sky_entry"],
        arrays["sky_rest"],
        arrays["sky_seen"],
        arrays["sky_has_sun"],
        arrays["sky_sun"],
        strict=True,
    ):
        entry = SplitEntry(*(str(x) for x in row))  # type: ignore[arg-type]
        disc = Sun(sun[:3].copy(), sun[3:].astype(np.float32)) if has_sun else None
        skies.append(HdrSky(entry, rest.astype(np.float32), disc, seen))
    clear = ClearSkies(
        arrays["clear_elevation_deg"], arrays["clear_rest"], arrays["clear_sun_irradiance"]
    )
    ends = np.cumsum(arrays["view_count"])
    views = []
    for end, count, fraction in zip(ends, arrays["view_count"], arrays["view_share"], strict=True):
        # Views have different numbers of surface pixels, and are stored end to end.
        part = slice(int(end - count), int(end))
        views.append(
            StreetView(
                arrays["view_pixel"][part],
                arrays["view_albedo"][part],
                arrays["view_normal"][part],
                np.ascontiguousarray(arrays["view_met"][:, part]),
                np.ascontiguousarray(arrays["view_horizon"][:, part]),
                fraction,
            )
        )
    sides: tuple[Side, ...] = tuple(str(x) for x in arrays["view_side"])  # type: ignore[assignment]
    if arrays["sky_rest"].shape[1:] != (height, 2 * height, 3):
        raise ValueError("skies of another size")
    noise = unpack_noise(arrays["noise"])
    ldr = tuple(
        LdrPanorama(str(side), picture)  # type: ignore[arg-type]
        for side, picture in zip(arrays["ldr_side"], arrays["ldr_srgb8"], strict=True)
    )
    return LightingCache(height, tuple(skies), clear, noise, tuple(views), sides, ldr)


def _sun_row(sun: Sun | None) -> Shaped[np.ndarray, " 6"]:
    if sun is None:
        return np.zeros(6)
    return np.concatenate([sun.direction_world, sun.irradiance]).astype(np.float64)
