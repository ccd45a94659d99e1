"""Radiance pictures in all orders, codings and headers: one sky, read the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.store.hdr_writers import radiance_bytes

from lightsim.core.primaries import CIE_XYZ, SRGB, primaries_of_name, srgb_from_primaries
from lightsim.errors import InputError
from lightsim.store.images import read_hdr, read_sky

RGBE = "FORMAT=32-bit_rle_rgbe"
DAMAGED = "Download or export"


@pytest.fixture
def rgb(rng: np.random.Generator) -> np.ndarray:
    """Values that RGBE holds exactly; colours near white lie in every gamut."""
    return (rng.integers(160, 256, (8, 16, 3)) / 64).astype(np.float32)


def read(path: Path, data: bytes) -> np.ndarray:
    path.write_bytes(data)
    return read_hdr(path)


@pytest.mark.parametrize("is_flat", [False, True])
@pytest.mark.parametrize(
    "order", [f"{a}{p} {b}{q}" for p, q in ("YX", "XY") for a in "-+" for b in "-+"]
)
def test_all_orders_of_scanlines(tmp_path: Path, rgb, order: str, is_flat: bool) -> None:
    data = radiance_bytes(rgb, order=order, is_flat=is_flat)
    np.testing.assert_array_equal(read(tmp_path / "a.hdr", data), rgb)


@pytest.mark.parametrize(
    ("lines", "line_end", "divisor"),
    [
        (["#?RADIANCE", RGBE], "\r\n", 1),
        (["#?RGBE", "# EXPOSURE=9", RGBE], "\n", 1),
        (["#?AUTOPANO", "SOFTWARE=x"], "\n", 1),
        (["rpict -vp 0 0 0", RGBE], "\n", 1),
        # As ImageMagick and Photoshop write it.
        (["#?RADIANCE", "GAMMA=1", "PRIMARIES=0 0 0 0 0 0 0 0", RGBE], "\n", 1),
        (["#?RADIANCE", "PRIMARIES=.64 .33 .3 .6 .15 .06 .3127 .329", RGBE], "\n", 1),
        (["#?RADIANCE", "FORMAT=\t32-bit_rle_rgbe ", "EXPOSURE=\t 2", "EXPOSURE=0.25"], "\n", 0.5),
        (["#?RADIANCE", "COLORCORR= 0.5 1 2", RGBE], "\n", [0.5, 1, 2]),
        (["#?RADIANCE", "COLORCORR=.5 1 2", "COLORCORR=2 2 4", "EXPOSURE=2"], "\n", [2, 4, 16]),
        # The headers of the pictures that this one was made of.
        (["#?RADIANCE", "pcomb a.hdr", "\tEXPOSURE=8", "\tFORMAT=x", RGBE], "\r\n", 1),
    ],
)
def test_headers_in_use(tmp_path: Path, rgb, lines, line_end: str, divisor) -> None:
    """Exact, but where channels share an exponent that is not their own: half a code of it."""
    stored = rgb * np.float32(divisor)
    half_code = 0 if np.isscalar(divisor) else stored.max(2, keepdims=True) / 256 / divisor
    found = read(tmp_path / "a.hdr", radiance_bytes(stored, lines, line_end=line_end))
    assert (np.abs(found - rgb) <= half_code).all()
    assert read_sky(tmp_path / "a.hdr").notes == ()


@pytest.mark.parametrize(
    ("lines", "primaries", "name"),
    [
        (["FORMAT=32-bit_rle_xyze"], CIE_XYZ, "CIE XYZ"),
        ([RGBE, "PRIMARIES=.64 .33 .29 .6 .15 .06 .3333 .3333"], None, "Radiance RGB"),
        ([RGBE, "PRIMARIES=\t.708 .292 .17 .797 .131 .046 .3127 .329"],
         primaries_of_name("lin_rec2020"), "Rec.2020"),
        ([RGBE, "PRIMARIES=.7 .3 .2 .7 .1 .1 .35 .35"], (.7, .3, .2, .7, .1, .1, .35, .35),
         "primaries 0.7 0.3"),
    ],
)  # fmt: skip
def test_colours_are_converted(tmp_path: Path, rgb, lines, primaries, name: str) -> None:
    matrix = srgb_from_primaries(primaries or (*SRGB[:2], 0.29, 0.6, 0.15, 0.06, 1 / 3, 1 / 3))
    stored = rgb @ np.linalg.inv(matrix).T
    assert stored.min() > 0
    path = tmp_path / "a.hdr"
    path.write_bytes(radiance_bytes(stored, ["#?RADIANCE", *lines]))
    sky = read_sky(path)
    # Half a code of the brightest channel, through the matrix.
    np.testing.assert_allclose(sky.radiance, rgb, atol=4 * np.abs(matrix).sum(1).max() / 256)
    assert sky.notes[0].startswith(f"converted from {name}")


@pytest.mark.parametrize(
    ("line", "noted"), [("GAMMA=2.2", "GAMMA=2.2 is not"), ("PIXASPECT=.5", "PIXASPECT=0.5 is not")]
)
def test_entries_that_are_not_applied_are_noted(tmp_path: Path, rgb, line, noted: str) -> None:
    path = tmp_path / "a.hdr"
    path.write_bytes(radiance_bytes(rgb, ["#?RADIANCE", line]))
    sky = read_sky(path)
    np.testing.assert_array_equal(sky.radiance, rgb)
    assert noted in sky.notes[0]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("EXPOSURE=nan", "EXPOSURE.*a number"),
        ("EXPOSURE=1e300\nEXPOSURE=1e300", "out of range"),
        ("COLORCORR=1 1", "COLORCORR.*3 numbers"),
        ("COLORCORR=1 -1 1", "out of range"),
        ("PRIMARIES=1 2 3", "PRIMARIES.*8 numbers"),
        ("PRIMARIES=.3 .3 .3 .3 .3 .3 .3 .3", "span no colour space.*Rec.709"),
        ("GAMMA=bright", "GAMMA.*a number"),
        ("FORMAT=32-bit_rle_hsve", "pixel format.*RGBE or OpenEXR"),
    ],
)
def test_headers_that_cannot_be_used(tmp_path: Path, rgb, line: str, message: str) -> None:
    with pytest.raises(InputError, match=rf"(?s)a\.hdr: .*{message}") as caught:
        read(tmp_path / "a.hdr", radiance_bytes(rgb, ["#?RADIANCE", line]))
    assert DAMAGED not in str(caught.value)


@pytest.mark.parametrize("resolution", ["-Y 8 +Y 16", "-Z 8 +X 16", "8 16", "-Y 99 +X 198"])
def test_what_is_damaged_is_to_be_loaded_again(tmp_path: Path, rgb, resolution: str) -> None:
    data = radiance_bytes(rgb).replace(b"-Y 8 +X 16", resolution.encode())
    with pytest.raises(InputError, match=DAMAGED):
        read(tmp_path / "a.hdr", data)
