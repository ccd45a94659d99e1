"""OpenEXR panoramas of other programs: colours, windows, parts, layers, chroma, half floats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from tests.store.hdr_writers import (
    planes_of,
    windows,
    write_layers,
    write_parts,
    write_sampled,
)

from lightsim.core.primaries import ACES_AP0, CIE_XYZ, SRGB, primaries_of_name, srgb_from_primaries
from lightsim.errors import InputError
from lightsim.store import exr_file, exr_picture
from lightsim.store.images import read_sky, write_exr

AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
DAMAGED = "Download or export"


@pytest.fixture
def rgb(rng: np.random.Generator) -> np.ndarray:
    """Colours near white, which lie in every gamut."""
    return (1 + 0.1 * rng.random((16, 32, 3))).astype(np.float32)


def notes_of(path: Path, layer: str = "") -> str:
    return "; ".join(read_sky(path, layer).notes)


@pytest.mark.parametrize(
    ("entries", "primaries", "name"),
    [
        ({"chromaticities": AP1}, AP1, "ACEScg"),
        ({"chromaticities": CIE_XYZ}, CIE_XYZ, "CIE XYZ"),
        ({"chromaticities": (0.7, 0.3, 0.2, 0.7, 0.1, 0.1, 0.35, 0.35)},
         (0.7, 0.3, 0.2, 0.7, 0.1, 0.1, 0.35, 0.35), "primaries 0.7"),
        ({"acesImageContainerFlag": 1}, ACES_AP0, "ACES2065-1"),
        ({"acesImageContainerFlag": 1, "chromaticities": AP1}, AP1, "ACEScg"),
        ({"oiio:ColorSpace": "ACES - ACEScg"}, AP1, "ACEScg"),
        *(({"colorInteropID": name}, primaries_of_name(name), "")
          for name in ("lin_ap0_scene", "lin_rec2020_scene", "lin_p3d65_scene",
                       "lin_adobergb_scene", "lin_ciexyzd65_scene")),
    ],
)  # fmt: skip
def test_colours_are_converted(tmp_path: Path, rgb, entries, primaries, name: str) -> None:
    stored = (rgb @ np.linalg.inv(srgb_from_primaries(primaries)).T).astype(np.float32)
    path = write_layers(tmp_path / "a.exr", planes_of(stored), entries)
    sky = read_sky(path)
    np.testing.assert_allclose(sky.radiance, rgb, rtol=2e-6)
    assert sky.notes[0].startswith(f"converted from {name}")


@pytest.mark.parametrize(
    "entries",
    [{}, {"chromaticities": SRGB}, {"chromaticities": (0.0,) * 8},
     {"oiio:ColorSpace": "Linear"}, {"oiio:ColorSpace": "Utility - Linear - sRGB"},
     {"colorInteropID": "lin_rec709_scene"}],
)  # fmt: skip
def test_srgb_comes_back_to_the_bit(tmp_path: Path, rgb, entries) -> None:
    sky = read_sky(write_layers(tmp_path / "a.exr", planes_of(rgb), entries))
    np.testing.assert_array_equal(sky.radiance, rgb)
    assert sky.notes == ()


def test_colours_outside_srgb_are_clipped_with_a_note(tmp_path: Path, rgb) -> None:
    rgb[3, 4] = [0.0, 1.0, 0.0]
    path = write_layers(tmp_path / "a.exr", planes_of(rgb), {"chromaticities": AP1})
    sky = read_sky(path)
    assert sky.radiance[3, 4].tolist()[::2] == [0.0, 0.0]
    assert "clipped 2 values of colours outside sRGB" in sky.notes[1]


@pytest.mark.parametrize(
    ("entries", "noted"),
    [
        ({"whiteLuminance": 100.0}, "whiteLuminance 100 is not applied"),
        ({"adoptedNeutral": np.array([0.4, 0.4], np.float32)}, "adoptedNeutral is not applied"),
        ({"pixelAspectRatio": 2.0}, "pixelAspectRatio 2 is not applied"),
        ({"oiio:ColorSpace": "ACEScct"}, "'ACEScct', but the header has no chromaticities"),
        ({"colorInteropID": "srgb_rec709_scene"}, "'srgb_rec709_scene', but"),
    ],
)
def test_attributes_that_are_not_applied_are_noted(tmp_path: Path, rgb, entries, noted) -> None:
    path = write_layers(tmp_path / "a.exr", planes_of(rgb), entries)
    np.testing.assert_array_equal(read_sky(path).radiance, rgb)
    assert noted in notes_of(path)


@pytest.mark.parametrize("primaries", [(0.3,) * 8, (*SRGB[:6], 0.3, 0.0), (np.nan, *SRGB[1:])])
def test_primaries_that_are_no_colour_space(tmp_path: Path, rgb, primaries) -> None:
    path = write_layers(tmp_path / "a.exr", planes_of(rgb), {"chromaticities": primaries})
    with pytest.raises(InputError, match=r"a\.exr: the colours .*linear sRGB"):
        read_sky(path)


@pytest.mark.parametrize(
    ("data", "noted"),
    [
        ((0, 0, 31, 11), "32x12"),
        ((0, 4, 31, 15), "32x12+0+4"),
        ((8, 3, 20, 9), "13x7+8+3"),
        ((-5, -3, 20, 9), "26x13-5-3"),
    ],
)  # fmt: skip
def test_what_a_data_window_leaves_out_is_black(tmp_path: Path, rgb, data, noted: str) -> None:
    """Windows of a frame that begins at (-2, 1)."""
    frame = (-2, 1, 29, 16)
    data = tuple(edge + (-2, 1)[i % 2] for i, edge in enumerate(data))
    columns, rows = (np.arange(data[i], data[i + 2] + 1) for i in range(2))
    stored = rgb[np.ix_((rows - 1) % 16, (columns + 2) % 32)]
    path = write_layers(tmp_path / "a.exr", planes_of(stored), windows(data, frame))
    sky = read_sky(path)
    is_in = np.zeros((16, 32), bool)
    is_in[np.ix_(rows[(rows >= 1) & (rows <= 16)] - 1,
                 columns[(columns >= -2) & (columns <= 29)] + 2)] = True  # fmt: skip
    np.testing.assert_array_equal(sky.radiance, np.where(is_in[..., None], rgb, 0))
    edges = np.cos(np.linspace(0, np.pi, 17))
    missing = 1 - ((edges[:-1] - edges[1:]) / 64 * is_in.sum(1)).sum()
    assert f"{missing:.1%} of the sphere is missing" in sky.notes[0]


def test_a_data_window_beyond_the_display_is_cropped(tmp_path: Path, rgb) -> None:
    larger = np.pad(rgb, ((2, 3), (4, 4), (0, 0)), mode="wrap")
    path = write_layers(
        tmp_path / "a.exr", planes_of(larger), windows((-4, -2, 35, 18), (0, 0, 31, 15))
    )
    np.testing.assert_array_equal(read_sky(path).radiance, rgb)
    assert "cropped from 40x21-4-2" in notes_of(path)


def test_a_panorama_in_another_display_window_is_whole(tmp_path: Path, rgb) -> None:
    path = write_layers(tmp_path / "a.exr", planes_of(rgb), windows((0, 0, 31, 15), (0, 0, 19, 10)))
    np.testing.assert_array_equal(read_sky(path).radiance, rgb)
    assert "display window 20x11+0+0 is not applied" in notes_of(path)


@pytest.mark.parametrize(
    ("data", "display", "message"),
    [
        ((0, 0, 31, 14), (40, 40, 71, 55), "no pixel.*lies in its display window"),
        ((0, 0, 31, 14), (0, 0, 10**8, 10**8), "display window.*out of range"),
        ((3, 4, 34, 18), (0, 0, 500, 400), "501x401 px.*equirectangular"),
    ],
)
def test_windows_of_no_panorama(tmp_path: Path, rgb, data, display, message: str) -> None:
    path = write_layers(tmp_path / "a.exr", planes_of(rgb[:15]), windows(data, display))
    with pytest.raises(InputError, match=message) as caught:
        read_sky(path)
    assert DAMAGED not in str(caught.value)


@pytest.mark.parametrize(
    ("layers", "letters", "taken"),
    [
        (["", "diffuse", "Aaa"], "RGB", "RGB"),
        (["ViewLayer.Combined", "ViewLayer.Env", "ViewLayer.Noisy Image"], "RGB",
         "ViewLayer.Combined"),
        (["View Layer.Combined", "Composite.Combined"], "RGB", "Composite.Combined"),
        (["beauty", "albedo"], "RGB", "beauty"),
        (["RGBA", "N"], "RGB", "RGBA"),
        (["C", "Albedo"], "rgb", "C"),
        (["only.this"], "RGB", "only.this"),
    ],
)  # fmt: skip
def test_the_finished_layer_is_taken(tmp_path: Path, rgb, layers, letters, taken: str) -> None:
    planes: dict[str, np.ndarray] = {"Depth.Z": rgb[..., 0], "P.X": rgb[..., 0], "P.Y": rgb[..., 1]}
    planes["P.Z"] = rgb[..., 2]
    for layer in layers:
        planes |= planes_of(rgb if layer in (taken, "") else 9 * rgb, layer, letters)
    path = write_layers(tmp_path / "a.exr", planes)
    sky = read_sky(path)
    np.testing.assert_array_equal(sky.radiance, rgb)
    assert sky.notes[0].startswith(f"took {taken}, ")
    for other in set(layers) - {taken, ""}:
        assert other in sky.notes[0]
        np.testing.assert_array_equal(read_sky(path, other).radiance, 9 * rgb)


def test_layers_without_a_finished_one_are_named(tmp_path: Path, rgb) -> None:
    path = write_layers(tmp_path / "a.exr", planes_of(rgb, "diffuse") | planes_of(rgb, "gloss"))
    with pytest.raises(InputError, match=r"several pictures.*diffuse, gloss.*Name one: a\.exr#dif"):
        read_sky(path)
    with pytest.raises(InputError, match=r"no layer of this name, got x, expected one of diffuse"):
        read_sky(path, "x")
    assert notes_of(path, "gloss") == "took gloss, as named"


def test_words_of_nuke_are_channels(tmp_path: Path, rgb) -> None:
    planes = {f"rgba.{word}": rgb[..., i] for i, word in enumerate(("red", "green", "blue"))}
    path = write_layers(tmp_path / "a.exr", planes | {"rgba.alpha": rgb[..., 0]})
    np.testing.assert_array_equal(read_sky(path).radiance, rgb)


@pytest.mark.parametrize(
    ("names", "taken", "others"),
    [
        (("depth", "rgba"), 1, ()),
        (("diffuse", "beauty"), 1, ("diffuse",)),
        (("first", "second"), 0, ("second",)),
    ],
)
def test_the_colour_part_is_taken(tmp_path: Path, rgb, names, taken: int, others) -> None:
    parts = [
        (name, {"Z": rgb[..., 0]} if name == "depth" else planes_of(rgb if i == taken else 9 * rgb),
         {}) for i, name in enumerate(names)
    ]  # fmt: skip
    path = write_parts(tmp_path / "a.exr", parts)
    np.testing.assert_array_equal(read_sky(path).radiance, rgb)
    assert f"took {names[taken]}, " in notes_of(path)
    for other in others:
        np.testing.assert_array_equal(read_sky(path, other).radiance, 9 * rgb)


def test_the_default_view_of_a_stereo_file_is_taken(tmp_path: Path, rgb) -> None:
    of_parts = write_parts(
        tmp_path / "parts.exr",
        [("rgba.left", planes_of(rgb), {"view": "left"}),
         ("rgba.right", planes_of(9 * rgb), {"view": "right"})],
    )  # fmt: skip
    layers = planes_of(9 * rgb, "Combined.left") | planes_of(rgb, "Combined.right")
    of_layers = write_layers(tmp_path / "layers.exr", layers, {"multiView": ["right", "left"]})
    plain = write_layers(
        tmp_path / "plain.exr",
        planes_of(rgb) | planes_of(9 * rgb, "right"),
        {"multiView": ["left", "right"]},
    )
    for path, other in ((of_parts, "rgba.right"), (of_layers, "Combined.left"), (plain, "right")):
        np.testing.assert_array_equal(read_sky(path).radiance, rgb)
        assert other in notes_of(path)
        np.testing.assert_array_equal(read_sky(path, other).radiance, 9 * rgb)


@pytest.mark.parametrize("step", [1, 2])
def test_luminance_and_chroma_are_converted(tmp_path: Path, rng, step: int) -> None:
    """Chroma that varies linearly comes back between its samples; beyond the last one it stays."""
    y = (1 + rng.random((16, 32))).astype(np.float32)
    rows, columns = np.mgrid[:16, :32]
    last = {1: (15, 31), 2: (14, 30)}[step]
    ramp = 0.01 * np.minimum(rows, last[0]) + 0.005 * np.minimum(columns, last[1]) - 0.2
    red, blue = y * (1 + ramp), y * (1 - ramp)
    green = (y - 0.2126 * red - 0.0722 * blue) / 0.7152
    sparse = ramp[::step, ::step].astype(np.float32)
    planes = {"Y": (y, 1), "RY": (sparse, step), "BY": (-sparse, step)}
    path = write_sampled(tmp_path / "a.exr", planes, (0, 0, 31, 15), (0, 0, 31, 15))
    sky = read_sky(path)
    np.testing.assert_allclose(sky.radiance, np.stack([red, green, blue], -1), rtol=3e-4)
    assert "luminance and chroma" in sky.notes[0]


def test_grey_and_whole_numbers(tmp_path: Path, rgb) -> None:
    grey = write_layers(tmp_path / "grey.exr", {"Y": rgb[..., 0], "A": rgb[..., 1]})
    np.testing.assert_array_equal(read_sky(grey).radiance, np.repeat(rgb[..., :1], 3, axis=2))
    whole = (rgb * 1000).astype(np.uint32)
    path = write_layers(tmp_path / "whole.exr", planes_of(whole))
    np.testing.assert_array_equal(read_sky(path).radiance, whole)


@pytest.mark.parametrize("value", [np.inf, 65504.0])
def test_a_sun_beyond_half_floats_is_a_lower_bound(tmp_path: Path, rgb, value: float) -> None:
    half = rgb.astype(np.float16)
    half[3, 4] = value
    sky = read_sky(write_layers(tmp_path / "a.exr", planes_of(half)))
    assert sky.radiance[3, 4].tolist() == [65504.0] * 3
    assert "3 values reach the largest half float" in sky.notes[0]
    assert "lower bound" in sky.notes[0]


@pytest.mark.parametrize(
    ("value", "kind"),
    [(np.inf, np.float32), (-np.inf, np.float16), (np.nan, np.float16), (np.nan, np.float32)],
)
def test_values_that_are_no_light(tmp_path: Path, rgb, value: float, kind: type) -> None:
    stored = rgb.astype(kind)
    stored[3, 4, 1] = value
    path = write_layers(tmp_path / "a.exr", planes_of(stored))
    with pytest.raises(InputError, match=r"NaN or infinite values, got 1 of 1536.*editor"):
        read_sky(path)


def test_deep_pixels_and_depth_alone_are_named(tmp_path: Path, rgb) -> None:
    deep = np.empty((16, 32), object)
    for index in np.ndindex(deep.shape):
        deep[index] = np.ones(2, np.float32)
    header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    path = tmp_path / "deep.exr"
    OpenEXR.File(header, {letter: deep for letter in "RGB"}).write(str(path))
    with pytest.raises(InputError, match=r"deep\.exr: .*deep pixels.*deepscanline.*Flatten"):
        read_sky(path)
    depth = write_layers(tmp_path / "depth.exr", {"Z": rgb[..., 0]})
    with pytest.raises(InputError, match=r"colour picture, got channels Z.*Export.*RGB"):
        read_sky(depth)


def test_only_what_is_damaged_is_to_be_loaded_again(tmp_path: Path, rgb) -> None:
    parts = [("rgba", planes_of(rgb), {}), ("depth", {"Z": rgb[..., 0]}, {})]
    path = write_parts(tmp_path / "a.exr", parts)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match=f"truncated or damaged.*{DAMAGED}"):
        read_sky(path)


def test_all_parts_together_are_bounded(tmp_path: Path, rgb, monkeypatch) -> None:
    parts = [(name, planes_of(rgb), {}) for name in ("a", "b")]
    path = write_parts(tmp_path / "a.exr", parts)
    monkeypatch.setattr(exr_file, "MAX_VALUES", 2 * rgb.size - 1)
    monkeypatch.setattr(exr_picture, "MAX_VALUES", 2 * rgb.size - 1)
    with pytest.raises(InputError, match=r"all 2 parts .*out of range.*resize"):
        read_sky(path)


@pytest.mark.parametrize("name", ["ZIP", "PIZ", "RLE", "ZIPS", "PXR24", "B44", "DWAA", "DWAB"])
def test_all_compressions_and_tiles(tmp_path: Path, rgb, name: str) -> None:
    """PXR24 keeps 24 bits of a float; DWA and B44 (of halves) lose a little."""
    compression = {"compression": getattr(OpenEXR, f"{name}_COMPRESSION")}
    stored = rgb.astype(np.float16) if name == "B44" else rgb
    lines = write_layers(tmp_path / "lines.exr", planes_of(stored), compression)
    tile = OpenEXR.TileDescription()
    tile.xSize, tile.ySize = 8, 5
    tiles = {**compression, "type": OpenEXR.tiledimage, "tiles": tile}
    for path in (lines, write_layers(tmp_path / "tiles.exr", planes_of(stored), tiles)):
        np.testing.assert_allclose(read_sky(path).radiance, rgb, rtol=0.04)


def test_what_we_write_comes_back_to_the_bit(tmp_path: Path, rgb) -> None:
    write_exr(tmp_path / "a.exr", rgb)
    sky = read_sky(tmp_path / "a.exr")
    np.testing.assert_array_equal(sky.radiance, rgb)
    assert sky.notes == ()


@pytest.mark.parametrize("layer", ["", "ViewLayer.Combined"])
def test_alpha_marks_what_was_not_photographed(tmp_path: Path, rgb, layer: str) -> None:
    prefix = f"{layer}." if layer else ""
    alpha = np.ones(rgb.shape[:2], np.float32)
    full = write_layers(tmp_path / "full.exr", planes_of(rgb, layer) | {f"{prefix}A": alpha})
    assert "alpha" not in notes_of(full)
    # The lower half of the sphere is missing; a quarter more is transparent, but has light.
    rgb[8:], alpha[8:], alpha[:8, :16] = 0, 0, 0.5
    path = write_layers(tmp_path / "a.exr", planes_of(rgb, layer) | {f"{prefix}A": alpha})
    np.testing.assert_array_equal(read_sky(path).radiance, rgb)
    assert "below 1 over 75.0% of the sphere, of which 67% is black" in notes_of(path)


def test_alpha_outside_the_frame_does_not_count(tmp_path: Path, rgb) -> None:
    alpha = np.ones((16, 36), np.float32)
    alpha[:, :2] = 0
    wide = np.concatenate([rgb, rgb[:, :4]], axis=1)
    header = windows((-2, 0, 33, 15), (0, 0, 31, 15))
    path = write_layers(tmp_path / "a.exr", planes_of(wide) | {"A": alpha}, header)
    assert "alpha" not in notes_of(path)
