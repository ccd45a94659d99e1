"""A small cache of training data, made once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightsim.core.dome import Sun, add_sun
from lightsim.core.equirect import pixel_directions
from lightsim.store.images import write_exr
from lightsim_lab.training.lighting_cache import PrepareConfig, prepare_cache, write_cache
from lightsim_lab.training.street_panoramas import StreetConfig

SPLIT = """name,split,group,tier,scene,reason
a,train,a,A,ground,
b,validation,b,A,ground,
c,train,c,A,none,
d,test,d,A,ground,
"""


def made_sky(elevation_deg: float, waves: int = 0, height_px: int = 64) -> np.ndarray:
    """A gradient, with waves along the azimuth that tell skies apart, over dark ground, with a
    sun along x."""
    directions = pixel_directions(height_px)
    azimuth = np.arctan2(directions[..., 1], directions[..., 0])[..., None]
    radiance = np.repeat(0.5 + 0.4 * directions[..., 2:], 3, axis=2).astype(np.float32)
    radiance *= np.exp(0.6 * np.cos(waves * azimuth) * (waves > 0)).astype(np.float32)
    radiance[directions[..., 2] < 0] = 0.1
    e = np.radians(elevation_deg)
    towards = np.array([np.cos(e), 0.0, np.sin(e)])
    return add_sun(radiance, Sun(towards, np.full(3, 5.0, np.float32))).radiance


@pytest.fixture(scope="session")
def sunny_radiance() -> np.ndarray:
    """Sun at 30 degrees, irradiance 5."""
    return made_sky(30.0)


@pytest.fixture(scope="session")
def cache_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two skies that train, one each that validates and tests; a street on each side."""
    folder = tmp_path_factory.mktemp("lighting")
    for waves, (name, elevation) in enumerate(zip("abcd", (30.0, 50.0, 20.0, 40.0), strict=True)):
        write_exr(folder / f"{name}.exr", made_sky(elevation, waves))
    split = folder / "split.csv"
    split.write_text(SPLIT)
    streets = StreetConfig(street_count=3, held_out=1, positions=1, rays=4)
    config = PrepareConfig(height_px=64, clear_count=2, streets=streets)
    write_cache(folder / "cache.npz", prepare_cache(folder, split, config))
    return folder / "cache.npz"
