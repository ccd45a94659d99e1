"""OBJ and MTL files in other spellings, encodings and places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.store.test_obj import ORANGE, SQUARE, paint, picture, read


@pytest.mark.parametrize(
    ("use", "mtl"),
    [
        (b"usemtl paint", b"\xef\xbb\xbfnewmtl paint\nKd 1 0 0\n"),
        (b"usemtl paint", "\ufeffnewmtl paint\nKd 1 0 0\n".encode("utf-16-le")),
        (b"usemtl paint", "newmtl paint\r\nKd 1 0 0\r\n".encode("utf-16")),
        ("usemtl Türblau".encode(), b"# gr\xfc\xdfe\nnewmtl T\xc3\xbcrblau\nKd 1 0 0\n"),
        (b"usemtl a\x85b", b"newmtl a\x85b\nKd 1 0 0\n"),
        (b"usemtl \x83\x85\x85", b"newmtl \x83\x85\x85\r\nKd 1 0 0\r\n"),
        (b"usemtl paint", b"newmtl paint # body\nKd 1 0 0 # red\n"),
        (b"usemtl paint # body", b"newmtl paint\nKd 1 0 0\n"),
        (b"usemtl paint #2", b"newmtl paint #3\nKd 0 1 0\nnewmtl paint #2\nKd 1 0 0\n"),
        (b"USEMTL paint", b"NEWMTL paint\nkd 1 0 0\n"),
        (b"usemtl paint", b"newmtl paint\nKD\t1\t0\t0\n"),
    ],
)
def test_materials_are_found_in_any_spelling_and_encoding(
    tmp_path: Path, use: bytes, mtl: bytes
) -> None:
    square = SQUARE.encode().replace(b"usemtl paint", use)
    model = read(tmp_path, b"MTLLIB thing.mtl # colours\n" + square, mtl)
    np.testing.assert_array_equal(model.primitives[0].colour, [[1, 0, 0]] * 4)
    assert model.notes == ()


def test_a_material_of_another_number_is_another_material(tmp_path: Path) -> None:
    square = SQUARE.replace("usemtl paint", "usemtl paint #2")
    mtl = "newmtl paint #3\nKd 1 0 0\nnewmtl paint #4\nKd 1 0 0\n"
    model = read(tmp_path, "mtllib thing.mtl\n" + square, mtl)
    assert "no library defines are mid grey, 0.5 linear (paint #2)" in model.notes[0]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_capital_statements_and_utf16_are_a_model(tmp_path: Path, encoding: str) -> None:
    text = SQUARE.replace("v ", "V ").replace("vt", "VT").replace("f ", "F ")
    (primitive,) = read(tmp_path, text.encode(encoding)).primitives
    assert (len(primitive.vertices), len(primitive.faces)) == (4, 2)


@pytest.mark.parametrize(
    ("library", "notes"),
    [
        ("", ["no mtllib names the material library beside the model, which is read (THING.MTL)"]),
        ("mtllib gone.mtl\n", ["the material library is missing (gone.mtl)", "no mtllib names"]),
        ("mtllib other.mtl\n", ["materials that no library defines"]),
    ],
)
def test_the_library_of_the_models_name_is_read_without_another(
    tmp_path: Path, library: str, notes: list[str]
) -> None:
    (tmp_path / "THING.MTL").write_text("newmtl paint\nKd 1 0 0\n")
    (tmp_path / "other.mtl").write_text("newmtl other\n")
    model = read(tmp_path, library + SQUARE)
    assert [note[: len(start)] for note, start in zip(model.notes, notes, strict=True)] == notes
    is_found = "other" not in library
    np.testing.assert_array_equal(
        model.primitives[0].colour[0], [1, 0, 0] if is_found else [0.5] * 3
    )


@pytest.mark.parametrize(
    "words",
    ["D:\\work\\Textures\\RED.png", "/home/me/textures/red.png", "TEXTURES\\red.PNG",
     "-s\t1 1 1\ttextures/red.png", "-clamp\toff textures/red.png # the paint",
     "textures/./red.png", "work/car/textures/red.png"],
)  # fmt: skip
def test_ends_of_paths_in_any_case_are_found(tmp_path: Path, words: str) -> None:
    picture(tmp_path / "textures" / "red.png")
    primitive, notes = paint(tmp_path, f"map_Kd {words}\n")
    assert primitive.texture is not None
    assert notes == ()


def test_accents_are_alike_in_both_forms_of_unicode(tmp_path: Path) -> None:
    picture(tmp_path / "tu\u0308r" / "gru\u0308n.png")
    primitive, _ = paint(tmp_path, "map_Kd T\u00fcr/Gr\u00fcn.png\n")
    assert primitive.texture is not None


@pytest.mark.parametrize(
    ("statements", "colour", "note"),
    [
        ("map_Ka a.png\n", ORANGE, ["map_Ka is read as the map_Kd that is missing (paint)"]),
        ("map_Ka a.png\nmap_Kd b.png\n", (0, 0, 255), []),
        ("map_Kd b.png\nmap_Ka a.png\n", (0, 0, 255), []),
    ],
)
def test_map_ka_is_the_texture_where_there_is_no_map_kd(
    tmp_path: Path, statements: str, colour: tuple[int, int, int], note: list[str]
) -> None:
    picture(tmp_path / "a.png")
    picture(tmp_path / "b.png", (0, 0, 255))
    primitive, notes = paint(tmp_path, statements)
    assert primitive.texture is not None
    assert tuple(primitive.texture.pixels[0, 0].tolist()) == colour
    assert list(notes) == note
