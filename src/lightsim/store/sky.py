"""The panorama and the estimated sky on disk: source.exr, sun.json, panorama.png and its mask."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightsim.core.colour import srgb8_from_linear
from lightsim.core.dome import SkyDome, Sun
from lightsim.core.twin import Panorama, SkyEstimate
from lightsim.errors import ArtefactError
from lightsim.store.arrays import load_arrays, save_arrays
from lightsim.store.artefact import read_json, write_json
from lightsim.store.images import read_hdr, write_exr, write_png


def write_panorama(folder: Path, panorama: Panorama) -> None:
    """Exact arrays for the next stage; panorama.png and panorama_mask.png to look at."""
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
    """panorama.png, alpha 0 where nothing was seen, as `lightsim sky estimate` reads it;
    panorama_mask.png: white = sky seen, grey = surface seen, black = not seen."""
    alpha = np.where(panorama.is_seen, 255, 0).astype(np.uint8)[..., None]
    picture = np.concatenate([srgb8_from_linear(panorama.radiance), alpha], axis=2)
    write_png(folder / "panorama.png", picture)
    mask = np.where(panorama.is_sky, 255, np.where(panorama.is_seen, 128, 0)).astype(np.uint8)
    write_png(folder / "panorama_mask.png", np.repeat(mask[..., None], 3, axis=2))


def read_panorama(folder: Path) -> Panorama:
    arrays = load_arrays(folder / "panorama.npz")
    return Panorama(arrays["radiance"], arrays["is_seen"], arrays["is_sky"], arrays["is_clipped"])


def write_sky(folder: Path, sky: SkyEstimate, dome_name: str = "source.exr") -> None:
    """The dome as float EXR (suns exceed half floats) and sun.json beside it."""
    write_exr(folder / dome_name, sky.dome.radiance)
    sun = sky.dome.sun
    write_json(
        folder / "sun.json",
        {
            "azimuth_deg": sky.sun_azimuth_deg,
            "elevation_deg": sky.sun_elevation_deg,
            "direction_world": None if sun is None else sun.direction_world.tolist(),
            "irradiance": None if sun is None else sun.irradiance.tolist(),
            "sky_irradiance": sky.sky_irradiance.tolist(),
            "origin": sky.origin,
            "uncertainty_deg": sky.uncertainty_deg,
            "irradiance_log_std": sky.sun_irradiance_log_std,
            "notes": list(sky.notes),
        },
    )


def read_estimate(folder: Path) -> SkyEstimate:
    """The sky written by `write_sky`.

    Raises:
        ArtefactError: sun.json lacks an entry.
    """
    value = read_json(folder / "sun.json")
    try:
        sun = None
        if value["direction_world"] is not None:
            sun = Sun(
                np.array(value["direction_world"], dtype=np.float64),
                np.array(value["irradiance"], dtype=np.float32),
            )
        return SkyEstimate(
            SkyDome(read_hdr(folder / "source.exr"), sun),
            value["azimuth_deg"],
            value["elevation_deg"],
            value["origin"],
            value["uncertainty_deg"],
            value["irradiance_log_std"],
            np.array(value["sky_irradiance"], np.float32),
            tuple(value["notes"]),
        )
    except KeyError as error:
        raise ArtefactError(
            "an entry is missing", where=folder / "sun.json", got=error, remedy="Build again."
        ) from error
