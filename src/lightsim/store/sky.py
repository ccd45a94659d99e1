"""Files of the panorama and the estimated sky: source.exr, sun.json, panorama.png and its mask."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from lightsim.core.colour import srgb8_from_linear
from lightsim.core.dome import SkyDome, Sun
from lightsim.core.twin import Panorama, SkyEstimate
from lightsim.errors import ArtefactError, InputError
from lightsim.store.arrays import ArrayFile, save_arrays
from lightsim.store.artefact import write_json
from lightsim.store.entries import Entries
from lightsim.store.hdr import HEADING
from lightsim.store.images import read_hdr, write_exr, write_png

_UNIT_TOLERANCE = 1e-3
"""Largest deviation of a stored direction's length from 1; users may edit sun.json by hand."""


def write_panorama(folder: Path, panorama: Panorama) -> None:
    """Write exact arrays for the next stage, and panorama.png and panorama_mask.png for people."""
    save_arrays(
        folder / "panorama.npz",
        {
            "radiance": panorama.radiance,
            "is_seen": panorama.is_seen,
            "is_sky": panorama.is_sky,
            "is_clipped": panorama.is_clipped,
        },
    )
    write_panorama_pictures(folder, panorama)


def write_panorama_pictures(folder: Path, panorama: Panorama) -> None:
    """Write panorama.png and panorama_mask.png.

    panorama.png has alpha 0 in unobserved pixels, as `lightsim sky estimate` reads it. In
    panorama_mask.png, white is observed sky, grey an observed surface, black unobserved.
    """
    alpha = np.where(panorama.is_seen, 255, 0).astype(np.uint8)[..., None]
    picture = np.concatenate([srgb8_from_linear(panorama.radiance), alpha], axis=2)
    write_png(folder / "panorama.png", picture)
    mask = np.where(panorama.is_sky, 255, np.where(panorama.is_seen, 128, 0)).astype(np.uint8)
    write_png(folder / "panorama_mask.png", np.repeat(mask[..., None], 3, axis=2))


def write_completed(folder: Path, ldr: Float32[np.ndarray, "h w 3"]) -> None:
    """Write panorama_completed.png: unobserved pixels are inpainted (sRGB, networks' exposure)."""
    write_png(folder / "panorama_completed.png", np.round(ldr * 255).astype(np.uint8))


def read_panorama(folder: Path) -> Panorama:
    """Return the panorama that `write_panorama` wrote.

    Raises:
        InputError, ArtefactError: the arrays are damaged.
    """
    arrays = ArrayFile(folder / "panorama.npz")
    radiance = arrays.take("radiance", "f4", "h w 3")
    masks = [arrays.take(name, "?", "h w") for name in ("is_seen", "is_sky", "is_clipped")]
    return Panorama(radiance, *masks)


def write_sky(
    folder: Path, sky: SkyEstimate, heading_deg: float | None, dome_name: str = "source.exr"
) -> None:
    """Write the dome as float EXR (suns exceed half floats), and sun.json.

    Args:
        heading_deg: azimuth of world +x from true north, for the picture's header; None if unknown.
    """
    write_dome(folder / dome_name, sky.dome.radiance, heading_deg)
    sun = sky.dome.sun
    write_json(
        folder / "sun.json",
        {
            "azimuth_deg": sky.sun_azimuth_deg,
            "elevation_deg": sky.sun_elevation_deg,
            "direction_world": None if sun is None else sun.direction_world.tolist(),
            "irradiance": None if sun is None else sun.irradiance.tolist(),
            "sky_irradiance": sky.sky_irradiance.tolist(),
            "sky_irradiance_log_std": sky.sky_irradiance_log_std,
            "origin": sky.origin,
            "uncertainty_deg": sky.uncertainty_deg,
            "irradiance_log_std": sky.sun_irradiance_log_std,
            "notes": list(sky.notes),
        },
    )


def write_dome(
    path: Path, radiance: Float32[np.ndarray, "h w 3"], heading_deg: float | None
) -> None:
    """Write a dome as float EXR, with the azimuth of world +x in the header.

    Args:
        heading_deg: azimuth of world +x, the direction of the centre column, from true north; None
            if unknown.
    """
    write_exr(path, radiance, numbers={} if heading_deg is None else {HEADING: heading_deg})


def read_estimate(folder: Path) -> SkyEstimate:
    """Return the sky that `write_sky` wrote.

    Raises:
        InputError: source.exr is damaged.
        ArtefactError: an entry of sun.json is missing or broken.
    """
    path = folder / "sun.json"
    value = Entries.of_file(path)
    picture = folder / "source.exr"
    try:
        dome = SkyDome(read_hdr(picture), _read_sun(value, path))
    except InputError as error:
        raise error.at(picture) from error
    return SkyEstimate(
        dome,
        None if value.is_null("azimuth_deg") else value.number("azimuth_deg"),
        value.number("elevation_deg"),
        value.text("origin"),
        value.number("uncertainty_deg"),
        value.number("irradiance_log_std"),
        value.numbers("sky_irradiance", (3,)).astype(np.float32),
        value.number("sky_irradiance_log_std"),
        value.texts("notes"),
    )


def _read_sun(value: Entries, path: Path) -> Sun | None:
    if value.is_null("direction_world"):
        return None
    direction = value.numbers("direction_world", (3,))
    irradiance = value.numbers("irradiance", (3,)).astype(np.float32)
    if abs(float(np.linalg.norm(direction)) - 1.0) > _UNIT_TOLERANCE or (irradiance < 0).any():
        raise ArtefactError(
            "the sun is no unit vector with light",
            where=path,
            got=f"{direction.tolist()}, {irradiance.tolist()}",
            remedy="Build again.",
        )
    return Sun(direction, irradiance)
