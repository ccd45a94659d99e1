"""The estimated sky on disk: strong suns, and both irradiances beside the picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightsim.core.dome import Sun, add_sun, irradiance
from lightsim.core.twin import SkyEstimate
from lightsim.errors import InputError
from lightsim.store.artefact import read_json
from lightsim.store.images import read_exr, write_exr
from lightsim.store.sky import read_estimate, write_sky

UP = np.array([0.0, 0.0, 1.0])


def estimate() -> SkyEstimate:
    """A sun of about 1e6 radiance, fifteen times what half floats hold."""
    sky = np.full((128, 256, 3), 0.25, np.float32)
    sun = Sun(np.array([0.0, 0.6, 0.8]), np.array([600.0, 500.0, 400.0], np.float32))
    level = irradiance(sky, UP).astype(np.float32)
    return SkyEstimate(add_sun(sky, sun), 0.0, 53.13, "image", 3.0, 0.3, level, 0.1, ("a note",))


def test_a_sun_beyond_half_floats_comes_back_exactly(tmp_path: Path) -> None:
    sky = estimate()
    assert sky.dome.radiance.max() > 5e5
    write_sky(tmp_path, sky, None)
    again = read_estimate(tmp_path)
    np.testing.assert_array_equal(again.dome.radiance, sky.dome.radiance)
    assert again.dome.sun is not None
    np.testing.assert_allclose(again.dome.sun.irradiance, [600, 500, 400], rtol=1e-6)
    with pytest.raises(InputError, match="half=False"):
        write_exr(tmp_path / "half.exr", sky.dome.radiance, half=True)
    write_exr(tmp_path / "strongest.exr", np.full((2, 4), 3e38, np.float32))
    assert np.isfinite(read_exr(tmp_path / "strongest.exr")).all()


def test_sun_json_reports_the_light_of_sun_and_sky(tmp_path: Path) -> None:
    """Level light of the picture = sky_irradiance + irradiance x sine of the elevation."""
    sky = estimate()
    write_sky(tmp_path, sky, None)
    facts = read_json(tmp_path / "sun.json")
    level = np.array(facts["sky_irradiance"]) + 0.8 * np.array(facts["irradiance"])
    np.testing.assert_allclose(level, sky.dome.horizontal_irradiance(), rtol=1e-5)
