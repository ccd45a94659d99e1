"""CAD files far away, upside down, under other names, or of other content than their name's."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from tests.render.rendering_scenes import box
from tests.scenario.model_files import write_model
from tests.scenario.test_models import CAR_M, car, cone, joined, size

from lightsim.cli import main
from lightsim.errors import InputError
from lightsim.scenario.asset_library import AssetLibrary, add_model
from lightsim.scenario.models import ModelSettings, load_model
from lightsim.scenario.orientation import Front, Up
from lightsim.scenario.wheels import find_wheels


def test_a_model_far_from_the_origin_keeps_its_shape(tmp_path: Path) -> None:
    """UTM coordinates, where float32 has steps of half a metre."""
    wanted = load_model(write_model(tmp_path / "m.obj", car())).mesh
    text = (tmp_path / "m.obj").read_text()
    far = re.sub(
        r"v (\S+) (\S+) (\S+)",
        lambda m: f"v {float(m[1]) + 691e3:.6f} {float(m[2])} {float(m[3]) + 5334e3:.6f}",
        text,
    )
    (tmp_path / "m.obj").write_text(far)
    found = load_model(tmp_path / "m.obj").mesh
    np.testing.assert_allclose(found.vertices, wanted.vertices, atol=1e-5)


@pytest.mark.parametrize("up", ["-x", "-y", "-z"])
def test_an_upright_model_is_found_by_wheels_above_it(tmp_path: Path, up: Up) -> None:
    """Wheels above the body are evidence that the axis points down."""
    path = write_model(tmp_path / "m.obj", car(), up[1:])
    text = path.read_text()
    # Two axes are reversed, which turns the model by 180 degrees.
    other = {"x": "z", "y": "z", "z": "y"}[up[1:]]
    signs = [-1 if axis in (up[1:], other) else 1 for axis in "xyz"]
    path.write_text(re.sub(
        r"v (\S+) (\S+) (\S+)",
        lambda m: "v " + " ".join(f"{s * float(m[n + 1]):.6f}" for n, s in enumerate(signs)),
        text,
    ))  # fmt: skip
    model = load_model(path)
    assert model.up == up
    np.testing.assert_allclose(size(model.mesh), CAR_M, atol=1e-5)
    assert len(find_wheels(model.mesh)) == 4


@pytest.mark.parametrize(("up", "down"), [("x", "-x"), ("y", "-y"), ("z", "-z")])
def test_a_model_on_its_roof_is_turned_not_mirrored(tmp_path: Path, up: Up, down: Up) -> None:
    """With -y up, the corner of y = 2 is below the others; the axes stay right-handed."""
    lines = ["v 0 0 0", "v 1 0 0", "v 0 2 0", "v 0 0 3", "f 1 2 3", "f 1 3 4", "f 1 4 2"]
    (tmp_path / "m.obj").write_text("\n".join(lines))
    front: Front = "+x" if up != "x" else "+z"
    usual, over = (
        load_model(tmp_path / "m.obj", ModelSettings(up=u, front=front)).mesh.vertices
        for u in (up, down)
    )
    np.testing.assert_allclose(over, usual * [1, -1, -1], atol=1e-6)


def test_the_command_takes_an_axis_that_points_down(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_model(tmp_path / "my car(2).obj", car())
    words = ["assets", "add", str(path), "--library", str(tmp_path / "library"), "--up", "-z"]
    main([*words, "--name", "x"])
    assert "up -z" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("stem", "name"), [("car (2)", "car-2"), ("Türblau", "T-rblau"), ("車", "model")]
)
def test_a_file_name_that_is_no_asset_name_is_an_error_with_one(
    tmp_path: Path, stem: str, name: str
) -> None:
    path = write_model(tmp_path / f"{stem}.obj", car())
    library = AssetLibrary(tmp_path / "library", {})
    with pytest.raises(InputError, match=rf"Give --name {name}\."):
        add_model(library, path)
    assert add_model(library, path, name)[0].name == name


@pytest.mark.parametrize("words", ["gone.obj", "models\\gone.GLB", "gone #1.gltf"])
def test_words_with_a_model_suffix_are_a_file(tmp_path: Path, words: str) -> None:
    library = AssetLibrary(tmp_path / "library", {}, beside=tmp_path)
    with pytest.raises(InputError, match="there is no such file") as caught:
        library.load(words)
    assert str(tmp_path) in str(caught.value)


def test_file_names_of_windows_are_found(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    write_model(tmp_path / "models" / "m.obj", car())
    library = AssetLibrary(tmp_path / "library", {}, beside=tmp_path)
    assert library.load("models\\m.obj").label == library.load("models/m.obj").label
    assert library.key("models\\m.obj") == library.key("models/m.obj")


@pytest.mark.parametrize("suffix", [".obj", ".glb", ".gltf"])
@pytest.mark.parametrize(
    ("data", "message"),
    [
        (
            b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n",
            "a pointer of Git LFS.*git lfs pull",
        ),
        (b"\n <!DOCTYPE html><html>", "a web page.*Download"),
        (b"\x1f\x8b\x08\0\0", "gzip.*Unpack"),
        (b"PK\x03\x04", "a zip archive.*Unpack"),
        (b"Kaydara FBX Binary  \0", r"a \.fbx file.*Blender"),
        (b"; FBX 7.4.0 project file\n", r"a \.fbx file.*Blender"),
        (b"ply\nformat ascii 1.0\n", r"a \.ply file.*Blender"),
        (b"solid cube\nfacet normal 0 0 1\n", r"a \.stl file.*Blender"),
        (b'<?xml version="1.0"?>\n<COLLADA version="1.4.1">', r"a \.dae file.*Blender"),
        (b"#usda 1.0\n", r"a \.usda file.*Blender"),
        (b"BLENDER-v300", r"a \.blend file.*Open"),
        (b"ISO-10303-21;", r"a \.step file.*FreeCAD"),
        (b"", "an empty file.*export"),
    ],
)
def test_content_that_is_no_model_is_named(
    tmp_path: Path, data: bytes, message: str, suffix: str
) -> None:
    (tmp_path / f"m{suffix}").write_bytes(data)
    with pytest.raises(InputError, match=rf"m\{suffix}: the file is not a model, got {message}"):
        load_model(tmp_path / f"m{suffix}")


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".obj"])
@pytest.mark.parametrize("name", ["model", "model.vrm"])
def test_a_model_with_another_suffix_is_to_be_renamed(
    tmp_path: Path, suffix: str, name: str
) -> None:
    path = write_model(tmp_path / f"m{suffix}", car()).rename(tmp_path / name)
    with pytest.raises(
        InputError, match=rf"not supported.*Rename it to (model\{suffix})\."
    ) as found:
        load_model(path)
    named = re.search(r"Rename it to (\S+)\.$", str(found.value))
    assert named is not None
    np.testing.assert_allclose(
        size(load_model(path.rename(tmp_path / named[1])).mesh), CAR_M, atol=1e-5
    )


def test_a_packed_model_is_to_be_unpacked(tmp_path: Path) -> None:
    (tmp_path / "m.glb.gz").write_bytes(b"\x1f\x8b\x08\0\0")
    with pytest.raises(InputError, match=r"m\.glb\.gz.*gzip.*Unpack"):
        load_model(tmp_path / "m.glb.gz")


@pytest.mark.parametrize("along", ["+x", "-x", "+z", "-z"])
def test_the_cabin_is_behind_the_middle_if_both_ends_are_equally_high(
    tmp_path: Path, along: str
) -> None:
    """A saloon car whose boot is as high as its bonnet."""
    saloon = joined(box((0, 0, 0.6), (4.4, 1.8, 0.5)), box((-0.4, 0, 1.15), (2.6, 1.6, 0.6)))
    path = write_model(tmp_path / "m.obj", saloon)
    turn = {"+x": (1, 0), "-x": (-1, 0), "+z": (0, 1), "-z": (0, -1)}[along]

    def moved(m: re.Match[str]) -> str:
        x, y, z = (float(m[n]) for n in (1, 2, 3))
        return f"v {turn[0] * x - turn[1] * z:.6f} {y} {turn[1] * x + turn[0] * z:.6f}"

    path.write_text(re.sub(r"v (\S+) (\S+) (\S+)", moved, path.read_text()))
    model = load_model(path, ModelSettings(up="y"))
    assert model.front == along
    assert any("the cabin is nearer" in note for note in model.notes) == (along[0] == "-")
    roof = model.mesh.vertices[model.mesh.vertices[:, 2] > 0.4]
    assert (roof[:, 0].min() + roof[:, 0].max()) / 2 == pytest.approx(-0.4, abs=1e-5)
    # The bed of a pickup is behind its cab.
    pickup = load_model(path.rename(tmp_path / "pickup.obj"), ModelSettings(up="y"))
    assert pickup.front == f"+{along[1]}"


@pytest.mark.parametrize(
    ("suffix", "name", "content"),
    [(".glb", ".obj", "glTF"), (".gltf", ".obj", "glTF"), (".obj", ".glb", "OBJ")],
)
def test_content_decides_between_formats(
    tmp_path: Path, suffix: str, name: str, content: str
) -> None:
    path = write_model(tmp_path / f"m{suffix}", car())
    wanted = load_model(path)
    found = load_model(path.rename(path.with_suffix(name)))
    np.testing.assert_array_equal(found.mesh.vertices, wanted.mesh.vertices)
    assert found.notes == (f"its content is {content}, so it is read as such", *wanted.notes)


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_a_size_that_the_name_excludes_is_noted_without_a_unit_too(
    tmp_path: Path, suffix: str
) -> None:
    mesh = box((0, 0, 0.5), (40.0, 1.0, 1.0))
    (note,) = load_model(write_model(tmp_path / f"cone{suffix}", mesh)).notes
    assert "40.00 x 1.00 x 1.00 m is not the size of a cone: check --length-m" in note
    scaled = load_model(tmp_path / f"cone{suffix}", ModelSettings(length_m=20.0))
    assert "20.00 x 0.50 x 0.50 m is not the size of a cone" in scaled.notes[0]
    path = write_model(tmp_path / "cone.obj", cone(), unit=0.1)
    assert "may be 0.1 (0.36 x 0.36 x 0.70 m)" in load_model(path).notes[0]


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("name", ["car", "my_pickup"])
def test_a_car_without_wheels_is_wider_than_high(tmp_path: Path, name: str, up: Up) -> None:
    """Its front differs from its rear and its left from its right: nothing else decides."""
    mesh = joined(box((0, 0, 0.85), (4.2, 1.9, 0.6)), box((-0.5, 0.3, 1.4), (2.4, 1.1, 0.6)),
                  box((0.4, -0.4, 0.4), (2.0, 0.9, 0.4)))  # fmt: skip
    model = load_model(write_model(tmp_path / f"{name}.obj", mesh, up))
    assert model.up == up
    assert [note for note in model.notes if "wider" in note] == [
        note for note in model.notes if up == "z" and note.startswith("z is up")
    ]
    bus = box((0, 0, 1.6), (12.0, 2.5, 3.2))
    assert load_model(write_model(tmp_path / "bus.obj", bus)).up == "y"
    sign = box((0, 0, 1), (0.8, 0.1, 2.0))
    assert load_model(write_model(tmp_path / "car_sign.obj", sign)).up == "y"
