"""Samples come back from their packed form nearly as they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from tools.pack_samples import pack, unpack

from lightsim.errors import InputError
from lightsim_lab.training.relight_cache import (
    RelightSample,
    RelightTargetSample,
    read_sample,
    write_sample,
)

SIZE = (48, 64)


def smooth(rng: np.random.Generator, channels: int, high: float) -> np.ndarray:
    noise = ndimage.gaussian_filter(rng.random((channels, *SIZE)), (0, 4, 4))
    return (high * (noise - noise.min()) / np.ptp(noise)).astype(np.float32)


def tinted(rng: np.random.Generator, high: float) -> np.ndarray:
    """Light of one hue: WebP keeps hues at half of the size."""
    return smooth(rng, 1, high) * np.array([1.0, 0.9, 0.8], np.float32)[:, None, None]


def test_samples_come_back(tmp_path: Path, rng: np.random.Generator) -> None:
    vectors = 60 * (smooth(rng, 3, 2.0) - 1)
    scene = {
        "source": tinted(rng, 1.0),
        "matte": (smooth(rng, 1, 1.0) > 0.5).astype(np.float32),
        "position": vectors,
        "source_shaded": tinted(rng, 2.5),
        "source_dome": rng.random((3, 32, 64), dtype=np.float32) * 400,
    }
    truth = (255 * tinted(rng, 1.0)).astype(np.uint8)
    planes = {"target_physical": tinted(rng, 1.5), "target_sun": scene["matte"]}
    sample = RelightSample(scene, {"low_sun": RelightTargetSample(planes, truth)})
    street = tmp_path / "data" / "201"
    street.mkdir(parents=True)
    for name in ("front_03", "front_03_under_low_sun"):
        write_sample(street / f"{name}.npz", sample)
    pack([street], tmp_path / "packed.zip")
    unpack(tmp_path / "packed.zip", tmp_path / "again")
    whole = sum(file.stat().st_size for file in street.iterdir())
    assert (tmp_path / "packed.zip").stat().st_size < whole / 3
    found = read_sample(tmp_path / "again" / "201" / "front_03_under_low_sun.npz")
    for name in ("matte", "source_dome"):
        np.testing.assert_array_equal(found.scene[name], np.float16(scene[name]))
    np.testing.assert_allclose(found.scene["position"], vectors, atol=60 / 255 + 0.04)
    target = found.targets["low_sun"]
    np.testing.assert_array_equal(target.planes["target_sun"], scene["matte"])
    assert target.truth is not None
    assert target.truth.dtype == np.uint8
    for got, was, high in (
        (found.scene["source"], scene["source"], 1.0),
        (found.scene["source_shaded"], scene["source_shaded"], 2.5),
        (target.planes["target_physical"], planes["target_physical"], 1.5),
        (target.truth.astype(np.float32), truth.astype(np.float32), 255.0),
    ):
        assert got.shape == was.shape
        assert np.abs(got.astype(np.float32) - was).mean() < 0.01 * high


def test_a_folder_without_samples_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no samples"):
        pack([tmp_path], tmp_path / "packed.zip")
    assert not (tmp_path / "packed.zip").exists()
