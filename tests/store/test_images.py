"""Pictures: round trips, the real skies, and no broken file that ends in anything but our error."""

from __future__ import annotations

import gzip
import re
import struct
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from PIL import Image
from tests.store.hdr_writers import radiance_bytes

from lightsim.core.dome import SkyDome
from lightsim.errors import InputError
from lightsim.store import exr_file, images, radiance, radiance_header
from lightsim.store import hdr as hdr_files
from limits import run_limited

FUZZ = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture
def hdr(rng: np.random.Generator) -> np.ndarray:
    picture = rng.lognormal(0, 3, (16, 32, 3)).astype(np.float32)
    picture[4:8] = 0.25
    picture[0, 0] = 2e5
    return picture


def test_png_and_jpeg(tmp_path: Path, rng: np.random.Generator) -> None:
    picture = rng.integers(0, 256, (5, 7, 3)).astype(np.uint8)
    images.write_png(tmp_path / "a.png", picture)
    images.write_png(tmp_path / "g.png", picture[..., 0])
    images.write_png(tmp_path / "h.png", picture[..., :2])
    smooth = np.repeat(np.linspace(0, 255, 64).astype(np.uint8)[:, None], 64, 1)
    images.write_jpeg(tmp_path / "b.jpg", np.stack([smooth, smooth.T, smooth], -1))
    np.testing.assert_array_equal(images.read_srgb8(tmp_path / "a.png"), picture)
    np.testing.assert_array_equal(images.read_grey8(tmp_path / "g.png"), picture[..., 0])
    np.testing.assert_array_equal(images.read_grey8_alpha(tmp_path / "h.png"), picture[..., :2])
    error = images.read_srgb8(tmp_path / "b.jpg")[..., 0].astype(int) - smooth
    assert np.abs(error).max() <= 4
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "b.jpg", "g.png", "h.png"]


def test_alpha_is_kept_apart(tmp_path: Path, rng: np.random.Generator) -> None:
    rgba = rng.integers(0, 256, (4, 6, 4)).astype(np.uint8)
    images.write_png(tmp_path / "a.png", rgba)
    rgb, alpha = images.read_srgb8_alpha(tmp_path / "a.png")
    np.testing.assert_array_equal(rgb, rgba[..., :3])
    np.testing.assert_array_equal(alpha, rgba[..., 3])
    assert (images.read_srgb8_alpha(_grey_png(tmp_path))[1] == 255).all()


def test_sixteen_bits_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "deep.png"
    Image.fromarray(np.full((4, 4), 40000, np.uint16)).save(path)
    with pytest.raises(InputError, match=r"deep\.png.*I;16"):
        images.read_srgb8(path)


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("channels", [0, 3])
def test_exr_round_trip(tmp_path: Path, hdr: np.ndarray, half: bool, channels: int) -> None:
    picture = np.minimum(hdr if channels else hdr[..., 0], 60000)
    picture[3, 3] = np.inf
    images.write_exr(tmp_path / "a.exr", picture, half=half)
    expected = picture.astype(np.float16 if half else np.float32).astype(np.float32)
    np.testing.assert_array_equal(images.read_exr(tmp_path / "a.exr"), expected)


def test_exr_of_other_programs(tmp_path: Path, hdr: np.ndarray) -> None:
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
    layers = {f"ViewLayer.Combined.{c}": hdr[..., i].copy() for i, c in enumerate("RGB")}
    layers["ViewLayer.Combined.A"] = np.ones_like(hdr[..., 0])
    OpenEXR.File(header, layers).write(str(tmp_path / "blender.exr"))
    OpenEXR.File(header, {"Z": hdr[..., 1].copy()}).write(str(tmp_path / "z.exr"))
    OpenEXR.File(header, {"X": hdr[..., 0].copy(), "Z": hdr[..., 1].copy()}).write(
        str(tmp_path / "xz.exr")
    )
    np.testing.assert_array_equal(images.read_hdr(tmp_path / "blender.exr"), hdr)
    np.testing.assert_array_equal(images.read_exr(tmp_path / "z.exr"), hdr[..., 1])
    with pytest.raises(InputError, match=r"xz\.exr.*R, G, B"):
        images.read_exr(tmp_path / "xz.exr")


def test_exr_refuses_what_it_cannot_hold(tmp_path: Path, hdr: np.ndarray) -> None:
    with pytest.raises(InputError, match="half=False"):
        images.write_exr(tmp_path / "a.exr", hdr, half=True)
    with pytest.raises(InputError, match="not an EXR picture"):
        images.write_exr(tmp_path / "a.exr", hdr[..., :2])
    with pytest.raises(InputError, match="does not exist"):
        images.write_exr(tmp_path / "no" / "a.exr", hdr)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("width", [6, 32, 300])
def test_radiance_round_trip(tmp_path: Path, rng: np.random.Generator, width: int) -> None:
    picture = rng.lognormal(0, 4, (5, width, 3)).astype(np.float32)
    picture[1:3] = 0.5
    picture[3, :, :] = 0
    (tmp_path / "a.hdr").write_bytes(radiance_bytes(picture))
    back = images.read_hdr(tmp_path / "a.hdr")
    largest = picture.max(axis=2, keepdims=True)
    assert (np.abs(back - picture) <= largest / 256).all()
    (tmp_path / "b.hdr").write_bytes(radiance_bytes(back))
    np.testing.assert_array_equal(images.read_hdr(tmp_path / "b.hdr"), back)


def test_radiance_codes_by_hand() -> None:
    """Flat pixels with a repeat mark, an exposure, and rows from the bottom up."""
    head = b"#?RADIANCE\n# a comment\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2.0\n\n+Y 2 +X 3\n"
    pixels = bytes([128, 64, 32, 129, 1, 1, 1, 2]) + bytes([128, 0, 0, 128] * 3)
    back = radiance.decode_radiance(head + pixels)
    np.testing.assert_array_equal(back[1], np.tile([0.5, 0.25, 0.125], (3, 1)))
    np.testing.assert_array_equal(back[0], np.tile([0.25, 0.0, 0.0], (3, 1)))


def test_all_real_skies(shared_data: Path) -> None:
    skies = sorted((shared_data / "hdri").glob("*.hdr"))
    assert len(skies) == 69
    for path in skies:
        sky = images.read_sky(path)
        assert sky.notes == ()
        assert SkyDome(sky.radiance, None).horizontal_irradiance().min() >= 0


def test_sky_is_mended_in_the_open(tmp_path: Path, hdr: np.ndarray) -> None:
    slightly = hdr.copy()
    slightly[9, 9, 2] = -1e-3
    images.write_exr(tmp_path / "a.exr", slightly)
    sky = images.read_sky(tmp_path / "a.exr")
    assert sky.radiance.min() == 0
    assert "clipped 1 negative" in sky.notes[0]
    images.write_exr(tmp_path / "wide.exr", np.full((100, 201, 3), 0.5, np.float32))
    wide = images.read_sky(tmp_path / "wide.exr")
    assert wide.radiance.shape == (100, 200, 3)
    np.testing.assert_allclose(wide.radiance, 0.5)
    assert "201x100" in wide.notes[0]


@pytest.mark.parametrize("suffix", ["hdr", "exr"])
def test_a_clipped_sky_is_noted(tmp_path: Path, suffix: str) -> None:
    """An LDR picture saved as HDR holds a white spot in the place of sun and aureole."""
    column, row = np.arange(256) / 256 - 0.7, np.arange(128)[:, None] / 128 - 0.3
    aureole = 100 * np.exp(-(column**2 + row**2) / 2e-3)
    whole = (0.2 + aureole[..., None] * [1.0, 0.9, 0.8]).astype(np.float32)
    for name, sky, noted in (
        ("whole", whole, False), ("clipped", np.minimum(whole, 1), True),
        ("uniform", np.ones_like(whole), False),
    ):  # fmt: skip
        path = tmp_path / f"{name}.{suffix}"
        if suffix == "hdr":
            path.write_bytes(radiance_bytes(sky))
        else:
            images.write_exr(path, sky)
        notes = images.read_sky(path).notes
        assert ("the largest value, 1, covers" in "".join(notes)) == noted


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a[:, :20], "twice as wide as high.*20x16"),
        (lambda a: -a, "negative radiance.*linear"),
        (lambda a: a * 0, "black"),
        (lambda a: np.where(a > 1, np.nan, a), "NaN"),
        (lambda a: np.where(a > 1, np.inf, a), "infinite"),
    ],
)
def test_bad_skies(tmp_path: Path, hdr: np.ndarray, change, message: str) -> None:
    images.write_exr(tmp_path / "bad.exr", change(hdr).astype(np.float32))
    with pytest.raises(InputError, match=f"(?s)bad.exr.*{message}"):
        images.read_sky(tmp_path / "bad.exr")


@pytest.mark.parametrize("name", ["a.hdr", "flat.hdr", "a.exr"])
def test_large_skies_are_averaged_over_squares(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    picture = rng.lognormal(0, 1, (30, 60, 3)).astype(np.float32)
    path = tmp_path / name
    if name == "a.exr":
        images.write_exr(path, picture)
    else:
        path.write_bytes(radiance_bytes(picture, is_flat=name == "flat.hdr"))
    whole = images.read_hdr(path)
    monkeypatch.setattr(hdr_files, "_MAX_SKY_ROWS", 8)
    monkeypatch.setattr(radiance, "_BLOCK_PIXELS", 900)
    sky = images.read_sky(path)
    expected = whole.reshape(6, 5, 12, 5, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(sky.radiance, expected, rtol=1e-5)
    assert sky.notes == ("reduced from 60x30 to 12x6 px",)
    np.testing.assert_array_equal(images.read_hdr(path), whole)


READ_SKY = """
from pathlib import Path
from lightsim.store.images import read_sky
print(read_sky(Path(sys.argv[1])).radiance.mean())
"""


def test_a_large_panorama_takes_little_more_than_its_file_and_its_result(tmp_path: Path) -> None:
    """8192x4096 px, run-length coded; whole as floats it takes 400 MB, and took 1.7 GB."""
    runs = b"".join(bytes([128 + min(127, 8192 - i), 129]) for i in range(0, 8192, 127))
    row = bytes([2, 2, 8192 >> 8, 0]) + 4 * runs
    path = tmp_path / "large.hdr"
    path.write_bytes(b"#?RADIANCE\n\n-Y 4096 +X 8192\n" + 4096 * row)
    finished = run_limited(READ_SKY, path, cpu_s=20, memory_mb=1000)
    assert float(finished.output) == pytest.approx(129 / 128, rel=1e-5)
    assert finished.peak_mb < 500


def test_sizes_are_refused_by_their_headers(
    tmp_path: Path, hdr: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    grey = _grey_png(tmp_path)
    images.write_exr(tmp_path / "a.exr", hdr)
    (tmp_path / "a.hdr").write_bytes(radiance_bytes(hdr))
    assert images.read_size(grey) == (8, 4)
    monkeypatch.setattr(images, "_MAX_PIXELS", 31)
    monkeypatch.setattr(exr_file, "MAX_VALUES", 3 * 16 * 32 - 1)
    monkeypatch.setattr(radiance_header, "MAX_PIXELS", 16 * 32 - 1)
    for read, path, message in (
        (images.read_size, grey, "8x4 px, more than 31"),
        (images.read_srgb8, grey, "8x4 px, more than 31"),
        (images.read_sky, tmp_path / "a.exr", "32x16 px in 3 channels is out of range"),
        (images.read_sky, tmp_path / "a.hdr", "32x16 px is out of range"),
    ):
        with pytest.raises(InputError, match=message):
            read(path)


def test_repeat_marks_stand_for_no_more_than_the_picture(tmp_path: Path) -> None:
    """A few marks of the first generation claimed gigabytes."""
    head = b"#?RADIANCE\n\n-Y 64 +X 128\n"
    pixels = bytes([128, 64, 32, 129] + [1, 1, 1, 255] * 3) * 4
    (tmp_path / "a.hdr").write_bytes(head + pixels)
    with pytest.raises(InputError, match="do not add up"):
        images.read_hdr(tmp_path / "a.hdr")


def test_wrong_kinds_and_missing_files(tmp_path: Path) -> None:
    png = _grey_png(tmp_path)
    with pytest.raises(InputError, match="not an HDR picture"):
        images.read_sky(png)
    for data, remedy in (
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        (gzip.compress(b"#?RADIANCE"), "gzip.*Unpack"),
        (b"<!DOCTYPE html>", "web page.*Download"),
        (b"", "empty file.*Download"),
        (b"PF\n128 64\n-1.0\n", "PF.*Convert"),
    ):
        (tmp_path / "a.exr").write_bytes(data)
        with pytest.raises(InputError, match=f"(?s)a.exr: not an HDR picture.*{remedy}"):
            images.read_sky(tmp_path / "a.exr")
    with pytest.raises(InputError, match="cannot open"):
        images.read_sky(tmp_path / "none.hdr")
    with pytest.raises(InputError, match="cannot open"):
        images.read_srgb8(tmp_path)


@FUZZ
@given(st.binary(max_size=400), st.sampled_from([b"", b"#?RADIANCE\n", b"\x76\x2f\x31\x01"]))
def test_arbitrary_bytes(tmp_path: Path, data: bytes, magic: bytes) -> None:
    path = tmp_path / "fuzz"
    path.write_bytes(magic + data)
    for read in (images.read_sky, images.read_srgb8, images.read_exr):
        with pytest.raises(InputError, match=re.escape(str(path))):
            read(path)


@FUZZ
@given(st.floats(0, 0.999), st.sampled_from(["a.hdr", "flat.hdr", "a.exr", "a.png", "a.jpg"]))
@example(0.04296875, "a.hdr").via("two bytes of a row's marker are left")
def test_truncated_files(tmp_path: Path, part: float, name: str) -> None:
    path = _valid_file(tmp_path, name)
    data = path.read_bytes()
    # A JPEG without its two end marks still holds the whole picture.
    path.write_bytes(data[: int((len(data) - 2) * part)])
    read = images.read_srgb8 if path.suffix in (".png", ".jpg") else images.read_hdr
    with pytest.raises(InputError, match=re.escape(name)):
        read(path)


@FUZZ
@given(st.data(), st.sampled_from(["a.hdr", "a.exr", "a.png"]))
def test_flipped_bytes_end_in_a_picture_or_our_error(
    tmp_path: Path, data: st.DataObject, name: str
) -> None:
    path = _valid_file(tmp_path, name)
    content = bytearray(path.read_bytes())
    index = data.draw(st.integers(0, len(content) - 1))
    content[index] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(content))
    read = images.read_srgb8 if name.endswith(".png") else images.read_hdr
    message = name
    try:
        read(path)
    except InputError as error:
        message = str(error)
    assert name in message


def _valid_file(folder: Path, name: str) -> Path:
    """A small valid picture; noise, so that no byte of it is left out by the decoder."""
    noise = np.random.default_rng(1).random((12, 24, 3)).astype(np.float32)
    noise = noise[:, :7] if name.startswith("flat") else noise
    path = folder / name
    if path.suffix == ".hdr":
        path.write_bytes(radiance_bytes(noise))
    elif path.suffix == ".exr":
        images.write_exr(path, noise)
    elif path.suffix == ".png":
        images.write_png(path, (noise * 255).astype(np.uint8))
    else:
        images.write_jpeg(path, (noise * 255).astype(np.uint8))
    return path


def _grey_png(folder: Path) -> Path:
    path = folder / "grey.png"
    images.write_png(path, np.full((4, 8), 77, np.uint8))
    return path


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_textures_of_16_bits_are_rounded_to_8(channels: int) -> None:
    """Written here chunk by chunk, since Pillow writes 16 bits in grey alone."""
    values = np.arange(64).reshape(4, 4, 4)[..., :channels] * 4
    rows = b"".join(b"\0" + row.tobytes() for row in (values * 257).astype(">u2"))
    kind = {1: 0, 3: 2, 4: 6}[channels]
    data = b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in (
            (b"IHDR", struct.pack(">IIBBBBB", 4, 4, 16, kind, 0, 0, 0)),
            (b"IDAT", zlib.compress(rows)),
            (b"IEND", b""),
        )
    )
    found = images.decode_texture(data)
    np.testing.assert_array_equal(found, np.repeat(values, 3 if channels == 1 else 1, axis=2))
