"""OBJ and MTL files as exporters write them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lightsim.core.colour import linear_from_srgb
from lightsim.core.mesh import Material
from lightsim.errors import InputError
from lightsim.store.obj import read_obj
from lightsim.store.primitives import AlphaMode, ModelFile, Primitive, Wrap

CORNERS = "v 0 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\n"
UV = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
SQUARE = CORNERS + UV + "usemtl paint\nf 1/1 2/2 3/3 4/4\n"
ORANGE = (255, 128, 0)


def read(folder: Path, obj: str | bytes, mtl: str | bytes | None = None) -> ModelFile:
    path = folder / "thing.obj"
    path.write_bytes(obj if isinstance(obj, bytes) else obj.encode())
    if mtl is not None:
        (folder / "thing.mtl").write_bytes(mtl if isinstance(mtl, bytes) else mtl.encode())
    return read_obj(path)


def paint(folder: Path, statements: str, square: str = SQUARE) -> tuple[Primitive, tuple[str, ...]]:
    """The only primitive of a square with a material of these statements."""
    model = read(folder, "mtllib thing.mtl\n" + square, "newmtl paint\n" + statements)
    (primitive,) = model.primitives
    return primitive, model.notes


def picture(path: Path, colour: tuple[int, ...] = ORANGE) -> None:
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(np.full((4, 4, len(colour)), colour, np.uint8)).save(path)


@pytest.mark.parametrize(
    "text",
    [
        CORNERS + "f 1 2 3 4",
        CORNERS + UV + "f 1/1 2/2 3/3 4/4\n",
        CORNERS + "vn 0 0 1\nf 1//1 2//1 3//1 4//1\n",
        CORNERS + UV + "vn 0 0 1\nf 1/1/1 2/2/1 3/3/1 4/4/1\n",
        CORNERS + "f -4 -3 -2 -1\nv 9 9 9\n",
        CORNERS + UV + "vn 0 0 1\nf -4/-4/-1 -3/-3/-1 -2/-2/-1 -1/-1/-1\n",
        CORNERS + "f 1 2 \\\n 3 4\n",
        CORNERS.replace("\n", "\r\n") + "f 1 2 \\\r\n3 4\r\n",
        CORNERS.replace("\n", "\r") + "f 1 2 3 4\r",
        "\ufeff# made by\n" + CORNERS.replace(" ", "\t") + "  f\t1  2 3 4  # a face\n#end",
        CORNERS.replace("v 0 0 0", "v 0 0 0 1.0 # weight") + "o part\ng a b\nf 1 2 3 4\n",
        CORNERS + "f 1/7 2/8 3/9 4/10\n",
        "v 0 0 0\nv 2. 0 -0\nv +2e0 1.0e+00 0\nf 1 2 3\nv 0 1 0\nf 1 3 4\n",
        CORNERS + "f 1 2 3\nf -4//  3 4\n",
    ],
)
def test_all_ways_to_write_a_square_are_one_square(tmp_path: Path, text: str) -> None:
    model = read(tmp_path, text)
    (primitive,) = model.primitives
    found = primitive.vertices[primitive.faces]
    a, b, c = np.array([0, 0, 0]), np.array([2, 1, 0]), np.array([0, 1, 0])
    wanted = np.array([[a, [2, 0, 0], b], [a, b, c]])
    np.testing.assert_array_equal(found, wanted)
    assert len(primitive.vertices) == 4
    assert "without a material" in model.notes[0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no triangles.*0 vertices and 0 faces"),
        ("v 1 2 3\nv 2 3 4\nvn 0 0 1\n", "no triangles.*2 vertices"),
        (CORNERS + "f 1 2\nf 3\n", "no triangles.*2 faces"),
        (CORNERS + "f 1 2 5\n", "line 5 names vertex 5 of 4"),
        (CORNERS + "f 1 2 -5\n", "line 5 names vertex -5 of 4"),
        (CORNERS + "f 0 1 2\n", "line 5 has a corner without a vertex"),
        (CORNERS + "f 1/1/1/1 2 3\n", "line 5 has a corner of more than three"),
        (CORNERS + "f /1 /2 /3\n", "line 5"),
        (CORNERS + "f 1 2 3\nf 1 zwei 3\n", "line 6 has no numbers.*zwei"),
        (CORNERS + f"f 1 2 {2**70}\n", "line 5"),
        ("v 1,5 2,5 3,5\nf 1 1 1\n", "line 1 has no numbers"),
        ("v 1 2\nf 1 1 1\n", "line 1 has 2 numbers instead of 3"),
        ("v 0 0 0\nv 1 nan 0\nv 1 1 1\nf 1 2 3\n", "line 2 has a number that is not finite"),
        ("v 0 0 0\nv 1 1e300 0\nv 1 1 1\nf 1 2 3\n", "line 2"),
        ("Kaydara FBX Binary\0\0", "no triangles.*Check that it is an OBJ file"),
    ],
)
def test_broken_files_are_errors_that_name_file_and_line(
    tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(InputError, match=rf"(?s)thing\.obj.*{message}"):
        read(tmp_path, text)


def test_vertices_are_shared_unless_normals_or_smoothing_groups_differ(tmp_path: Path) -> None:
    roof = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    counts = {
        "f 1 2 3\nf 1 4 2\n": 4,
        "s 1\nf 1 2 3\nf 1 4 2\n": 4,
        "s 1\nf 1 2 3\ns 2\nf 1 4 2\n": 6,
        "s off\nf 1 2 3\nf 1 4 2\n": 6,
        "s off\nvn 0 0 1\nf 1//1 2//1 3//1\nf 1//1 4//1 2//1\n": 4,
        "vn 0 0 1\nvn 0 1 0\nf 1//1 2//1 3//1\nf 1//2 4//2 2//2\n": 6,
    }
    found = {text: len(read(tmp_path, roof + text).primitives[0].vertices) for text in counts}
    assert found == counts


@pytest.mark.parametrize("scale", [1, 255])
def test_vertex_colours_are_srgb_in_unit_range_or_bytes(tmp_path: Path, scale: int) -> None:
    rgb = np.array([[0.8, 0.2, 0.0], [1.0, 1.0, 1.0], [0.0, 0.4, 0.6]])
    lines = [f"v {n} {n * n} 0 " + " ".join(f"{c * scale:.6f}" for c in row)
             for n, row in enumerate(rgb)]  # fmt: skip
    model = read(tmp_path, "\n".join([*lines, "v 5 0 0", "f 1 2 3", "f 1 2 4"]))
    (primitive,) = model.primitives
    order = np.argsort(primitive.vertices[:, 0])
    wanted = linear_from_srgb(np.concatenate([rgb, np.ones((1, 3))]))
    np.testing.assert_allclose(primitive.colour[order], wanted, atol=1e-5)
    assert model.notes == ()


@pytest.mark.parametrize(
    "name", ["thing.mtl", "THING.MTL", "my thing.mtl", '"my thing.mtl"', "C:\\jobs\\thing.mtl",
             "mats\\deep.mtl", "gone.mtl thing.mtl", "./thing.mtl"],
)  # fmt: skip
def test_material_libraries_are_found(tmp_path: Path, name: str) -> None:
    for file in ("thing.mtl", "my thing.mtl", "mats/deep.mtl"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text("newmtl paint\nKd 0.6 0.03 0.03\n")
    model = read(tmp_path, f"mtllib {name}\n" + SQUARE)
    np.testing.assert_allclose(model.primitives[0].colour, [[0.6, 0.03, 0.03]] * 4, atol=1e-6)
    missing = ["the material library is missing (gone.mtl)"] if "gone" in name else []
    assert list(model.notes) == missing


def test_missing_materials_are_light_grey_and_named_once(tmp_path: Path) -> None:
    model = read(tmp_path, "mtllib gone.mtl\n" + SQUARE + "usemtl glass\nf 1 2 3\n")
    assert [p.material.name for p in model.primitives] == ["paint", "glass"]
    assert all((p.colour == 0.5).all() and p.texture is None for p in model.primitives)
    assert len(model.notes) == 2
    assert "gone.mtl" in model.notes[0]
    assert "grey" in model.notes[1]
    assert "(paint, glass)" in model.notes[1]


@pytest.mark.parametrize(
    "words", ["red paint.png", "tex\\red paint.png", "tex/red paint.png", "TEX/RED PAINT.PNG",
              "C:\\Users\\me\\red paint.png", "/home/me/red paint.png",
              "-s 1 1 1 -o 0 0 red paint.png", "-clamp off -bm 1.0 red paint.png",
              '"red paint.png"', "missing\\red paint.png"],
)  # fmt: skip
def test_textures_are_found_under_the_names_that_exporters_write(
    tmp_path: Path, words: str
) -> None:
    picture(tmp_path / "tex" / "red paint.png")
    picture(tmp_path / "red paint.png")
    primitive, _ = paint(tmp_path, f"Kd 1 1 1\nmap_Kd {words}\n")
    assert primitive.texture is not None
    assert primitive.texture.pixels.reshape(-1, 3)[0].tolist() == list(ORANGE)
    np.testing.assert_array_equal(primitive.colour, np.ones((4, 3), np.float32))


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "tga", "webp"])
def test_common_pictures_are_textures(tmp_path: Path, suffix: str) -> None:
    picture(tmp_path / f"a.{suffix}")
    primitive, notes = paint(tmp_path, f"map_Kd a.{suffix}\n")
    assert primitive.texture is not None
    assert np.abs(primitive.texture.pixels.astype(int) - ORANGE).max() <= 4
    assert notes == ()


@pytest.mark.parametrize(
    ("words", "colour", "note"),
    [("gone.png", 0.7, "missing.*gone.png"), ("bad.png", 0.7, "bad.png"), ("", 0.7, "missing"),
     ("thing.mtl", 0.7, "thing.mtl")],
)  # fmt: skip
def test_pictures_that_cannot_be_shown_are_noted(
    tmp_path: Path, words: str, colour: float, note: str
) -> None:
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\nbad")
    primitive, notes = paint(tmp_path, f"Kd 0.7 0.7 0.7\nmap_Kd {words}\n")
    assert primitive.texture is None
    np.testing.assert_allclose(primitive.colour, colour)
    assert len(notes) == 1
    assert re.search(note, notes[0])


@pytest.mark.parametrize(
    ("colour", "tint"),
    [("0 0 0", (1, 1, 1)), ("0.8 0.8 0.8", (1, 1, 1)), ("0.5", (1, 1, 1)),
     ("0.2 0.4 1.0", (0.2, 0.4, 1.0))],
)  # fmt: skip
def test_only_a_coloured_kd_tints_a_texture(
    tmp_path: Path, colour: str, tint: tuple[float, float, float]
) -> None:
    picture(tmp_path / "a.png")
    primitive, _ = paint(tmp_path, f"Kd {colour}\nmap_Kd a.png\n")
    np.testing.assert_allclose(primitive.colour, [tint] * 4, atol=1e-6)
    bare, _ = paint(tmp_path, f"Kd {colour}\n")
    wanted = [float(word) for word in colour.split()]
    np.testing.assert_allclose(bare.colour[0], wanted if len(wanted) == 3 else wanted * 3)


def test_texture_coordinates_are_scaled_moved_and_turned_upside_down(tmp_path: Path) -> None:
    picture(tmp_path / "a.png")
    primitive, _ = paint(tmp_path, "map_Kd -s 2 3 1 -o 0.5 0.25 -clamp on a.png\n")
    assert primitive.uv is not None
    assert primitive.texture is not None
    order = np.lexsort(primitive.vertices.T)
    u, v = primitive.uv[order].T
    np.testing.assert_allclose(u, [0.5, 2.5, 0.5, 2.5])
    np.testing.assert_allclose(v, [0.75, 0.75, -2.25, -2.25])
    assert primitive.texture.wrap == (Wrap.CLAMP, Wrap.CLAMP)


def test_faces_without_texture_coordinates_have_the_mean_colour(tmp_path: Path) -> None:
    picture(tmp_path / "a.png")
    model = read(
        tmp_path, "mtllib thing.mtl\n" + SQUARE + "f 1 2 3\n", "newmtl paint\nmap_Kd a.png\n"
    )
    with_texture, without = model.primitives
    assert (with_texture.texture is None, without.texture is None) == (False, True)
    np.testing.assert_allclose(without.colour[0], linear_from_srgb(np.array(ORANGE) / 255), 1e-4)
    assert "without texture coordinates" in model.notes[0]


@pytest.mark.parametrize(
    ("statements", "mode", "alpha"),
    [
        ("", AlphaMode.OPAQUE, 1.0),
        ("d 1\n", AlphaMode.OPAQUE, 1.0),
        ("d 0.25\n", AlphaMode.BLEND, 0.25),
        ("d -halo 0.25\n", AlphaMode.BLEND, 0.25),
        ("Tr 0.75\n", AlphaMode.BLEND, 0.25),
        ("Tr 0.75\nd 1\n", AlphaMode.OPAQUE, 1.0),
        ("d 0.25\nTr 0.25\n", AlphaMode.BLEND, 0.25),
        ("Tr 1\n", AlphaMode.OPAQUE, 1.0),
        ("Tr 0\nillum 4\nTf 1 1 1\n", AlphaMode.OPAQUE, 1.0),
    ],
)
def test_dissolve_is_glass(tmp_path: Path, statements: str, mode: AlphaMode, alpha: float) -> None:
    primitive, _ = paint(tmp_path, statements)
    assert primitive.alpha_mode is mode
    found = np.ones(1) if primitive.alpha is None else primitive.alpha
    np.testing.assert_allclose(found, alpha)


@pytest.mark.parametrize("has_colour", [False, True])
@pytest.mark.parametrize("channel", ["alpha", "grey"])
def test_map_d_cuts_holes(tmp_path: Path, has_colour: bool, channel: str) -> None:
    """The mask is the picture's alpha, or its grey without one; colours keep theirs."""
    mask = np.zeros((8, 8, 4 if channel == "alpha" else 3), np.uint8)
    mask[:4] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    picture(tmp_path / "a.png")
    statements = "Kd 0.2 0.4 0.6\nmap_d mask.png\nd 0\n" + ("map_Kd a.png\n" if has_colour else "")
    primitive, _ = paint(tmp_path, statements)
    assert primitive.alpha_mode is AlphaMode.MASK
    assert primitive.texture is not None
    pixels = primitive.texture.pixels
    assert pixels.shape == (8, 8, 4)
    np.testing.assert_array_equal(pixels[..., 3], np.repeat([[255], [0]], 4, axis=0).repeat(8, 1))
    shown = linear_from_srgb(pixels[0, 0, :3] / 255) * primitive.colour[0]
    texel = linear_from_srgb(np.array(ORANGE) / 255) * [0.2, 0.4, 0.6]
    np.testing.assert_allclose(shown, texel if has_colour else [0.2, 0.4, 0.6], atol=4e-3)


@pytest.mark.parametrize(
    ("statements", "roughness", "metallic"),
    [
        ("", Material().roughness, 0.0),
        ("Ns 900\n", 0.0, 0.0),
        ("Ns 225\n", 0.5, 0.0),
        ("Ns 225\nPr 0.3\nPm 0.9\n", 0.3, 0.9),
        ("Pr 0.3\nNs 225\n", 0.3, 0.0),
        ("Pr 0.3\nmap_Pr half.png\nmap_Pm white.png\n", 128 / 255, 1.0),
    ],
)
def test_roughness_and_metal(
    tmp_path: Path, statements: str, roughness: float, metallic: float
) -> None:
    picture(tmp_path / "half.png", (128, 128, 128))
    picture(tmp_path / "white.png", (255, 255, 255))
    primitive, notes = paint(tmp_path, statements)
    found = (primitive.material.roughness, primitive.material.metallic)
    assert found == pytest.approx((roughness, metallic), abs=1e-6)
    assert notes == ()


@pytest.mark.parametrize(
    ("statement", "note"),
    [
        ("Ke 1 0 0", "Ke"),
        ("map_Ke a.png", "Ke"),
        ("map_Bump -bm 0.5 a.png", "bump"),
        ("norm a.png", "normal"),
        ("map_Ks a.png", "map_Ks"),
        ("Kd xyz 0.3 0.3 0.3", "RGB"),
        ("Kd spectral a.rfl 1", "RGB"),
        ("Kd 200 30 10", "255"),
        ("Pc 0.5", "Pc"),
        ("Tr 1", "opaque"),
        ("map_Kd -mm 0 2 a.png", "-mm"),
        ("wobble 3", "wobble"),
    ],
)
def test_what_a_material_has_besides_is_noted(tmp_path: Path, statement: str, note: str) -> None:
    picture(tmp_path / "a.png")
    _, notes = paint(tmp_path, statement + "\n")
    (found,) = notes
    assert note in found
    assert "paint" in found


@pytest.mark.parametrize(
    ("alpha", "mode", "note"),
    [
        ((), AlphaMode.OPAQUE, ["no holes"]),
        ((0,), AlphaMode.MASK, []),
        ((255,), AlphaMode.OPAQUE, ["is opaque: no holes"]),
    ],
)
def test_map_d_may_be_the_picture_of_map_kd(
    tmp_path: Path, alpha: tuple[int, ...], mode: AlphaMode, note: list[str]
) -> None:
    picture(tmp_path / "a.png", (*ORANGE, *alpha))
    primitive, notes = paint(tmp_path, "map_Kd a.png\nmap_d a.png\n")
    assert primitive.alpha_mode is mode
    assert [part in said for part, said in zip(note, notes, strict=True)] == [True] * len(note)


def test_pictures_of_other_sizes_do_not_multiply(tmp_path: Path) -> None:
    """The result has the size of the larger one, not the larger of each side."""
    Image.fromarray(np.full((1, 4000, 3), 200, np.uint8)).save(tmp_path / "wide.png")
    Image.fromarray(np.full((3000, 1), 255, np.uint8)).save(tmp_path / "high.png")
    primitive, _ = paint(tmp_path, "map_Kd wide.png\nmap_d high.png\n")
    assert primitive.texture is not None
    assert primitive.texture.pixels.shape == (1, 4000, 4)


def test_alpha_of_a_texture_without_map_d_is_noted(tmp_path: Path) -> None:
    picture(tmp_path / "a.png", (10, 20, 30, 0))
    primitive, notes = paint(tmp_path, "map_Kd a.png\n")
    assert primitive.alpha_mode is AlphaMode.OPAQUE
    assert "alpha" in notes[0]


@pytest.mark.parametrize(
    "statement", ["Ka 1 1 1", "Ks 0.5 0.5 0.5", "Ni 1.45", "illum 2", "Ke 0 0 0"]
)
def test_what_every_exporter_writes_is_no_note(tmp_path: Path, statement: str) -> None:
    assert paint(tmp_path, f"# made by hand\n\n\t{statement}\n")[1] == ()


@pytest.mark.parametrize(
    ("statements", "note"),
    [
        ("cstype bezier\ndeg 3\ncurv 0 1 1 2 3 4\nend\n", "free-form.*curv"),
        ("l 1 2\nl 2 3\np 1\n", "lines and points.*2 x l, 1 x p"),
        ("call other.obj\n", "1 x call"),
        ("f 1 2\n", "1 faces of one or two"),
        ("v 1 1 0\nv 0 2 0\nv 0 3 0\nf 1 3 2 4 5 6 7\n", "cross themselves"),
    ],
)
def test_statements_that_are_not_read_are_noted(tmp_path: Path, statements: str, note: str) -> None:
    model = read(tmp_path, SQUARE.replace("usemtl paint", "") + statements)
    assert any(re.search(note, found) for found in model.notes), model.notes
