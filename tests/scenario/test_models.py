"""CAD files as actors: which way is up and ahead, which size, which kind."""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.render.rendering_scenes import box
from tests.scenario.model_files import write_model
from tests.scenario.test_wheels import PLACES, disc

from lightsim.cli import main
from lightsim.core.actors import ActorKind
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.errors import InputError
from lightsim.scenario.apply import box_size_m
from lightsim.scenario.asset_library import AssetLibrary
from lightsim.scenario.kinds import inferred_kind
from lightsim.scenario.models import ModelSettings, load_model, read_model
from lightsim.scenario.orientation import Front, Up
from lightsim.scenario.wheels import find_wheels
from lightsim_lab.synthetic.shapes import tube

CAR_M = (4.2, 1.8, 1.6)


def joined(*parts: TriMesh) -> TriMesh:
    return replace(concatenate_meshes([replace(p, frame="actor") for p in parts]), frame="actor")


def car() -> TriMesh:
    """A red car with a low bonnet and four wheels that can be told from the body."""
    body, cabin = box((0, 0, 0.6), (4.2, 1.7, 0.6), 0.3), box((-0.6, 0, 1.2), (2.6, 1.6, 0.8), 0.3)
    body = replace(body, base_colour=np.full_like(body.base_colour, [0.6, 0.03, 0.03]))
    return joined(body, cabin, *(disc(*place) for place in PLACES))


def cone() -> TriMesh:
    spike = tube("cone", (0, 0, 0.05), (0, 0, 0.7), (0.15, 0.02), 16)
    plate = box((0, 0, 0.025), (0.36, 0.36, 0.05), 0.3)
    part = TriMesh(
        "actor", spike.vertices, spike.faces, np.full((len(spike.vertices), 3), 0.3, "f4")
    )
    return joined(plate, part)


def pole() -> TriMesh:
    part = tube("pole", (0, 0, 0), (0, 0, 6.0), (0.1, 0.1), 16)
    return TriMesh("actor", part.vertices, part.faces, np.full((len(part.vertices), 3), 0.3, "f4"))


def body_of_one_part() -> TriMesh:
    """A car whose wheels are no parts of their own: its halves mirror each other."""
    return joined(box((0, 0, 0.5), (4.2, 1.8, 0.6)), box((-0.5, 0, 1.15), (2.4, 1.5, 0.7)))


def person() -> TriMesh:
    return joined(box((0, 0, 1.2), (0.4, 0.24, 1.2)), box((0.1, 0, 0.3), (0.15, 0.2, 0.6)))


def card(up: int) -> TriMesh:
    """A rectangle of 2 x 1 m whose normal is an axis of the mesh."""
    flat = np.array([[0, 0], [2, 0], [2, 1], [0, 1]], np.float32)
    vertices = np.insert(flat, up, 0.5, axis=1)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return TriMesh("actor", vertices, faces, np.full((4, 3), 0.4, np.float32))


def size(mesh: TriMesh) -> np.ndarray:
    return np.ptp(mesh.vertices.astype(np.float64), axis=0)


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_wheels_are_on_the_ground(
    tmp_path: Path, up: Up, suffix: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_model(tmp_path / f"m{suffix}", car(), up)
    with caplog.at_level(logging.WARNING):
        model = load_model(path)
    assert model.up == up
    np.testing.assert_allclose(size(model.mesh), CAR_M, atol=1e-5)
    assert len(find_wheels(model.mesh)) == 4
    # The front is the low end, whatever axis of the file it is along.
    assert model.mesh.vertices[model.mesh.vertices[:, 0] > 2.05][:, 2].max() < 0.2
    assert [("--up" in r.message, "wheels" in r.message) for r in caplog.records] == (
        [] if up == "y" else [(True, True)]
    )


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_options_go_before_evidence(tmp_path: Path, up: Up) -> None:
    path = write_model(tmp_path / "m.obj", car(), "y")
    model = load_model(path, ModelSettings(up=up))
    assert model.up == up
    wanted = {"y": CAR_M, "z": (4.2, 1.6, 1.8), "x": (1.8, 1.6, 4.2)}[up]
    np.testing.assert_allclose(size(model.mesh), wanted, atol=1e-5)


@pytest.mark.parametrize(
    ("up", "front"),
    [(up, sign + axis) for up in "xyz" for axis in "xyz" if axis != up for sign in "+-"],
)
def test_front_and_up_are_axes_of_the_file(tmp_path: Path, up: Up, front: Front) -> None:
    """Three marks on the axes: the mesh has the one of the front ahead, the one of `up` above, and
    is turned, never mirrored."""
    lines = ["v 0 0 0", "v 1 0 0", "v 0 2 0", "v 0 0 3", "f 1 2 3", "f 1 3 4", "f 1 4 2"]
    (tmp_path / "m.obj").write_text("\n".join(lines))
    mesh = load_model(tmp_path / "m.obj", ModelSettings(up=up, front=front)).mesh
    marks = {"xyz"[n - 1]: v for v in mesh.vertices for n in range(1, 4)
             if abs(np.linalg.norm(v - _origin(mesh)) - n) < 1e-5}  # fmt: skip
    directions = {axis: (v - _origin(mesh)) for axis, v in marks.items()}
    x, y, z = (directions[axis] / np.linalg.norm(directions[axis]) for axis in "xyz")
    np.testing.assert_allclose(np.cross(x, y), z, atol=1e-6)
    np.testing.assert_allclose(
        directions[up] / np.linalg.norm(directions[up]), [0, 0, 1], atol=1e-6
    )
    ahead = directions[front[1]] / np.linalg.norm(directions[front[1]])
    np.testing.assert_allclose(ahead, [1 if front[0] == "+" else -1, 0, 0], atol=1e-6)


def _origin(mesh: TriMesh) -> np.ndarray:
    """The vertex at which all three faces meet."""
    counts = np.bincount(mesh.faces.ravel())
    return mesh.vertices[counts.argmax()].astype(np.float64)


def test_a_front_along_the_height_is_an_error(tmp_path: Path) -> None:
    path = write_model(tmp_path / "m.obj", car())
    with pytest.raises(InputError, match=r"m\.obj.*front points up.*--front \+y.*--up"):
        load_model(path, ModelSettings(up="y", front="+y"))
    assert load_model(path, ModelSettings(front="-y")).up == "z"


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize(
    ("make", "name"),
    [(cone, "thing"), (pole, "thing"), (body_of_one_part, "thing"), (person, "a_person")],
)
def test_obj_files_without_wheels_are_upright(
    tmp_path: Path, make: object, name: str, up: Up
) -> None:
    """By a flat base, a round outline, mirrored sides, or the size of what the name is."""
    mesh = make()  # type: ignore[operator]
    model = load_model(write_model(tmp_path / f"{name}.obj", mesh, up))
    assert model.up == up
    assert size(model.mesh)[2] == pytest.approx(size(mesh)[2], abs=1e-5)


@pytest.mark.parametrize("make", [cone, pole, body_of_one_part])
def test_gltf_is_y_up_unless_wheels_or_names_exclude_it(tmp_path: Path, make: object) -> None:
    mesh = make()  # type: ignore[operator]
    assert load_model(write_model(tmp_path / "m.glb", mesh, "z")).up == "y"
    assert load_model(write_model(tmp_path / "person.glb", person(), "z")).up == "z"


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".OBJ", ".GLB"])
def test_one_model_in_all_formats_is_one_mesh(tmp_path: Path, suffix: str) -> None:
    wanted = read_model(write_model(tmp_path / "car.obj", car()))
    found = read_model(write_model(tmp_path / f"copy{suffix}", car()))

    def rows(mesh: TriMesh) -> np.ndarray:
        material = np.zeros(len(mesh.faces)) if mesh.face_material is None else mesh.face_material
        surface = np.array([[m.roughness, m.metallic] for m in mesh.materials])
        corners = [mesh.vertices[mesh.faces].reshape(-1, 9), mesh.base_colour[mesh.faces[:, 0]]]
        values = np.concatenate([*corners, surface[material.astype(int)]], axis=1)
        return values[np.lexsort(np.round(values, 4).T)]

    np.testing.assert_allclose(rows(found), rows(wanted), atol=1e-5)
    radii = [[w.radius_m for w in find_wheels(mesh)] for mesh in (found, wanted)]
    assert radii[0] == pytest.approx(radii[1])
    assert inferred_kind("copy", size(found)) is inferred_kind("car", size(wanted)) is ActorKind.CAR


@pytest.mark.parametrize(
    ("unit", "proposal"),
    [
        (0.001, r"--metres-per-unit 0.001 \(millimetres\) it would be 4.20 x 1.80 x 1.60 m"),
        (0.01, r"--metres-per-unit 0.01 \(centimetres\) it would be 4.20 x 1.80 x 1.60 m"),
        (0.0254, r"--metres-per-unit 0.0254 \(inches\) it would be 4.20 x 1.80 x 1.60 m"),
        (100.0, r"--metres-per-unit 100 .* it would be 4.20 x 1.80 x 1.60 m"),
    ],
)
@pytest.mark.parametrize("up", ["y", "z"])
def test_wrong_units_are_errors_with_options_that_work(
    tmp_path: Path, unit: float, proposal: str, up: str
) -> None:
    path = write_model(tmp_path / "m.obj", car(), up, unit)
    with pytest.raises(InputError, match=rf"m\.obj.*{proposal}.*--length-m 4\.4, 4\.40 x"):
        load_model(path)
    for settings, length_m in (
        (ModelSettings(metres_per_unit=unit), 4.2),
        (ModelSettings(length_m=4.4), 4.4),
        (ModelSettings(length_m=4.4, metres_per_unit=1e9), 4.4),
    ):
        model = load_model(path, settings)
        np.testing.assert_allclose(size(model.mesh), np.array(CAR_M) * length_m / 4.2, rtol=1e-5)
        assert (model.up, len(find_wheels(model.mesh))) == (up, 4)


def test_the_length_is_that_along_the_front(tmp_path: Path) -> None:
    path = write_model(tmp_path / "m.obj", car())
    mesh = load_model(path, ModelSettings(front="+z", length_m=9.0)).mesh
    np.testing.assert_allclose(size(mesh), [9.0, 4.2 * 5, 1.6 * 5], rtol=1e-5)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("option", ["length_m", "metres_per_unit"])
def test_sizes_are_positive(tmp_path: Path, option: str, value: float) -> None:
    path = write_model(tmp_path / "m.obj", car())
    with pytest.raises(InputError, match=option.replace("_", "-")):
        load_model(path, replace(ModelSettings(), **{option: value}))


def test_a_size_that_the_name_excludes_is_noted_with_a_unit(tmp_path: Path) -> None:
    path = write_model(tmp_path / "cone.obj", cone(), unit=0.0254)
    (note,) = load_model(path).notes
    assert "--metres-per-unit may be" in note
    assert "0.0254 (0.36 x 0.36 x 0.70 m)" in note
    assert load_model(path, ModelSettings(metres_per_unit=0.0254)).notes == ()


@pytest.mark.parametrize("normal", [0, 1, 2])
@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_upright_cards_are_noted_and_level_ones_refused(
    tmp_path: Path, normal: int, suffix: str
) -> None:
    path = write_model(tmp_path / f"m{suffix}", card(normal))
    if normal < 2:
        model = load_model(path)
        assert any("card" in note for note in model.notes)
        assert size(model.mesh)[2] == pytest.approx(1.0)
        return
    with pytest.raises(InputError, match=rf"m\{suffix}.*the model has no height.*--up x or --up z"):
        load_model(path)
    for up in ("x", "z"):
        assert size(load_model(path, ModelSettings(up=up)).mesh)[2] > 0.9


@pytest.mark.parametrize(
    ("name", "size_m", "kind"),
    [
        ("car", CAR_M, ActorKind.CAR),
        ("redCar2", (3.0, 1.2, 2.6), ActorKind.CAR),
        ("CAR_red", (3.0, 1.2, 2.6), ActorKind.CAR),
        ("my-pickup.v2", (5.0, 2.0, 1.8), ActorKind.PICKUP),
        ("scarecrow", (1.0, 0.3, 1.7), ActorKind.OTHER),
        ("carport_sign", (1.0, 0.1, 0.5), ActorKind.SIGN),
        ("carport", (6.0, 3.0, 2.5), ActorKind.OTHER),
        ("van_gogh_poster", (1.0, 0.0, 0.8), ActorKind.OTHER),
        ("car_key", (0.08, 0.03, 0.01), ActorKind.OTHER),
        ("bus_stop", (1.0, 1.0, 2.5), ActorKind.OTHER),
        ("design", (1.0, 0.1, 0.5), ActorKind.OTHER),
        ("pedestrian_crossing_sign", (0.6, 0.1, 2.0), ActorKind.SIGN),
        ("Rail Vehicle 7", (30.0, 2.9, 3.5), ActorKind.RAIL_VEHICLE),
        ("railVehicle", (30.0, 2.9, 3.5), ActorKind.RAIL_VEHICLE),
        ("old_man", (0.5, 0.4, 1.7), ActorKind.PEDESTRIAN),
        ("manhole", (0.7, 0.7, 0.1), ActorKind.OTHER),
        ("thing", CAR_M, ActorKind.CAR),
        ("thing", (1.0, 1.0, 1.0), ActorKind.OTHER),
        ("größe", (1.0, 1.0, 1.0), ActorKind.OTHER),
    ],
)
def test_kinds_are_whole_words_of_plausible_size(
    name: str, size_m: tuple[float, float, float], kind: ActorKind
) -> None:
    assert inferred_kind(name, np.array(size_m)) is kind
    assert inferred_kind(name, np.array([size_m[1], size_m[0], size_m[2]])) in (
        kind,
        ActorKind.OTHER,
    )


@pytest.mark.parametrize(
    ("name", "remedy"),
    [("m.fbx", "Blender.*glTF"), ("m.stl", "Blender"), ("m.usdz", "Blender"), ("m.dae", "Blender"),
     ("m.blend", "File > Open"), ("m.step", "FreeCAD"), ("m.zip", "Unpack"), ("m", "Export")],
)  # fmt: skip
def test_other_formats_are_errors_that_name_a_converter(
    tmp_path: Path, name: str, remedy: str
) -> None:
    (tmp_path / name).write_bytes(b"Kaydara FBX Binary")
    with pytest.raises(InputError, match=rf"{name}.*\.glb or \.gltf or \.obj.*{remedy}"):
        load_model(tmp_path / name)


@pytest.mark.parametrize("normal", [0, 1])
def test_the_box_of_a_card_has_a_volume(tmp_path: Path, normal: int) -> None:
    """Written logs and labels have boxes, none of which may be flat."""
    write_model(tmp_path / "card.obj", card(normal))
    asset = AssetLibrary(tmp_path, {}, beside=tmp_path).load("card.obj")
    assert size(asset.mesh).min() == 0
    assert box_size_m(asset.mesh).min() == pytest.approx(0.01)


def test_files_with_a_number_sign_are_files(tmp_path: Path) -> None:
    write_model(tmp_path / "car #2.glb", car())
    write_model(tmp_path / "a#b.obj", car())
    library = AssetLibrary(tmp_path / "library", {}, beside=tmp_path)
    for words in ("car #2.glb", "a#b.obj"):
        assert len(library.load(words).wheels) == 4
    with pytest.raises(InputError, match="no such file"):
        library.load("car #3.glb")
    with pytest.raises(InputError, match="the other twin"):
        library.load("work#3")


def test_the_key_of_a_file_covers_its_materials(tmp_path: Path) -> None:
    def key() -> str:
        return AssetLibrary(tmp_path / "library", {}, beside=tmp_path).key("m.obj")

    write_model(tmp_path / "m.obj", car())
    before = key()
    write_model(tmp_path / "copy.obj", car())
    assert AssetLibrary(tmp_path, {}, beside=tmp_path).key("copy.obj") == before
    material = tmp_path / "m.mtl"
    material.write_text(material.read_text().replace("Pr 0.4", "Pr 0.5"))
    assert key() != before


def test_the_command_prints_what_it_chose_and_the_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    write_model(tmp_path / "m.obj", car(), "z", 0.001)
    (tmp_path / "m.mtl").unlink()
    words = [str(tmp_path / "m.obj"), "--name", "x", "--library", str(tmp_path / "library")]
    with caplog.at_level(logging.WARNING):
        main(["assets", "add", *words, "--length-m", "4.2"])
    printed = capsys.readouterr().out
    assert re.search(r"x: car, 4\.20 x 1\.80 x 1\.60 m, \d+ faces, up z, front \+x", printed)
    assert all(option in printed for option in ("--kind", "--up", "--front"))
    (record,) = caplog.records
    assert all(word in record.message for word in ("m.obj", "m.mtl", "grey", "z is up"))
