"""Single panoramas of any kind: a right reading, or one clear error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lightsim.errors import InputError
from lightsim.lighting.sky.image_sky import panorama_from_image
from lightsim.store.images import read_srgb8_alpha

SKY = (120, 160, 220)


def street(height: int = 64) -> np.ndarray:
    """Sky over walls, which stand up to 20 degrees above the horizon, and a road."""
    picture = np.full((height, 2 * height, 3), SKY, np.uint8)
    picture[round(height * (90 - 20) / 180) :] = (40, 45, 50)
    return picture


def test_sky_is_what_lies_above_the_walls() -> None:
    panorama = panorama_from_image(street(), None, 64)
    assert panorama.is_sky[:25].all()
    assert not panorama.is_sky[25:].any()
    assert panorama.is_seen.all()


def test_a_small_observed_part_is_judged_by_itself() -> None:
    """Walls are not sky because most of the picture was not observed."""
    seen = np.zeros((64, 128), bool)
    seen[22:40, 10:30] = True
    panorama = panorama_from_image(street(), seen, 64)
    np.testing.assert_array_equal(panorama.is_seen, seen)
    assert panorama.is_sky[22:25, 10:30].all()
    assert panorama.is_sky.sum() == 3 * 20


@pytest.mark.parametrize(
    ("picture", "is_seen", "message"),
    [
        (street()[:, :100], None, "twice as wide as high, got 100x64"),
        (street(2)[:1, :2], None, "too small.*16 rows"),
        (np.zeros((64, 128, 3), np.uint8), None, "looks like sky.*black"),
        (street(), np.zeros((64, 128), bool), "no observed pixel above the horizon.*alpha"),
        (
            street(),
            np.arange(64)[:, None] + np.zeros((1, 128)) > 40,
            "no observed pixel above the horizon",
        ),
        (np.full((64, 128, 3), (200, 40, 30), np.uint8), None, "looks like sky"),
    ],
    ids=["wrong aspect", "two pixels", "black", "all unseen", "sky unseen", "red"],
)
def test_what_shows_no_sky_is_refused(
    picture: np.ndarray, is_seen: np.ndarray | None, message: str
) -> None:
    with pytest.raises(InputError, match=f"(?s){message}"):
        panorama_from_image(picture, is_seen, 64)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "LA", "P", "1"])
def test_pictures_of_any_eight_bit_mode_are_read(tmp_path: Path, mode: str) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(street()).convert(mode, dither=Image.Dither.NONE).save(path)
    picture, alpha = read_srgb8_alpha(path)
    panorama = panorama_from_image(picture, alpha > 127, 64)
    assert panorama.is_sky[:25].all()
    assert not panorama.is_sky[25:].any()


def test_sixteen_bit_grey_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "deep.png"
    Image.fromarray(street()[..., 0].astype(np.uint16) * 257).save(path)
    with pytest.raises(InputError, match=r"deep\.png.*I;16"):
        read_srgb8_alpha(path)
