"""Night panoramas by their upper sky."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.render.rendering_scenes import constant_sky, sun_sky

from lightsim.core.dome import SkyDome
from lightsim.core.solar import direction_enu
from lightsim.lighting.night import is_night_panorama
from lightsim.lighting.sky.clear_sky import clear_sky
from lightsim.lighting.target_sky import dome_from_array
from lightsim.store.images import read_sky

BENCH = {"moonless_golf", "satara_night", "shanghai_bund", "st_peters_square_night", "street_lamp"}


def street_of_lamps(height_px: int) -> np.ndarray:
    """A dark grey sky, lamps below 20 degrees of elevation and a lit road."""
    radiance = np.full((height_px, 2 * height_px, 3), 0.01, np.float32)
    radiance[height_px // 2 :] = 0.05
    row = round(height_px * (90 - 15) / 180)
    radiance[row, :: height_px // 4] = [60.0, 40.0, 15.0]
    return radiance


@pytest.mark.parametrize(
    ("dome", "is_night"),
    [
        (SkyDome(street_of_lamps(64), None), True),
        (clear_sky(direction_enu(80.0, 10.0), height_px=64), False),
        (clear_sky(direction_enu(80.0, 60.0), height_px=64), False),
        (constant_sky(), False),
        (sun_sky(0.5, 20.0, 0.1), False),
    ],
    ids=["lamps", "low sun", "high sun", "overcast", "grey sky with a sun"],
)
def test_a_sky_that_gives_no_light_is_night(dome: SkyDome, is_night: bool) -> None:
    assert is_night_panorama(dome) == is_night
    assert is_night_panorama(dome.scaled(100.0)) == is_night


def test_real_panoramas(shared_data: Path) -> None:
    paths = sorted((shared_data / "hdri").glob("*.hdr"))
    domes = {path.stem: dome_from_array(read_sky(path).radiance, path.name) for path in paths}
    assert {name for name, dome in domes.items() if is_night_panorama(dome)} == BENCH
