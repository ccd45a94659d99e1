"""Looks of glTF materials: colours, pictures, roughness, metal, and notes on what is not read."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gltf_files import BOX, BOX_FACES, QUAD_UV, GltfBuilder, picture
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.mesh import TriMesh
from lightsim.store.gltf import read_gltf
from lightsim.store.primitive_mesh import mesh_of
from lightsim.store.specular_glossiness import metal_from_specular

CODES = {"red": (200, 20, 20), "green": (20, 200, 20), "blue": (20, 20, 200), "grey": (99, 99, 99)}
LINEAR = {name: linear_from_srgb8(np.array(code, np.uint8)) for name, code in CODES.items()}
ATLAS = np.repeat(np.repeat([[CODES["red"], CODES["green"]], [CODES["blue"], CODES["grey"]]],
                            8, axis=0), 8, axis=1)  # fmt: skip
"""16 x 16 px: red and green above, blue and grey below."""
GLOSSY = "KHR_materials_pbrSpecularGlossiness"


def read(builder: GltfBuilder, folder: Path, edge_m: float = 0.5) -> tuple[TriMesh, list[str]]:
    mesh, notes = mesh_of(read_gltf(builder.write(folder / "a.glb")), texture_edge_m=edge_m)
    return mesh, list(notes)


def one(**material: Any) -> GltfBuilder:
    builder = GltfBuilder()
    pbr = {"metallicFactor": 0, **material.pop("pbr", {})}
    builder.quad({"name": "paint", "pbrMetallicRoughness": pbr, **material})
    return builder


def textured(transform: dict[str, Any] | None = None, uv: Any = QUAD_UV, **sampler: Any) -> Any:
    builder = GltfBuilder()
    reference = builder.texture(ATLAS, **sampler)
    if transform is not None:
        reference["extensions"] = {"KHR_texture_transform": transform}
    pbr = {"baseColorTexture": reference, "metallicFactor": 0}
    value = builder.quad({"name": "paint", "pbrMetallicRoughness": pbr}, uv)
    return builder, value


def colour_at(mesh: TriMesh, x: float, up: float) -> np.ndarray:
    """Colour of the vertex nearest to a place of the quad."""
    distance = np.hypot(mesh.vertices[:, 0] - x, mesh.vertices[:, 2] - up)
    return mesh.base_colour[distance.argmin()]


@pytest.mark.parametrize(
    ("transform", "expected"),
    [
        (None, "red green blue grey"),
        ({"scale": [0.4, 0.4], "offset": [0.05, 0.05]}, "red red red red"),
        ({"scale": [0.4, 0.4], "offset": [0.55, 0.55]}, "grey grey grey grey"),
        ({"scale": [-1, 1], "offset": [1, 0]}, "green red grey blue"),
        # The extension's example: coordinates turn counter-clockwise as v points down.
        ({"rotation": np.pi / 2, "offset": [0, 1]}, "blue red grey green"),
        ({"rotation": np.pi / 2, "offset": [0, 1], "scale": [0.4, 0.4]}, "blue blue blue blue"),
    ],
)
def test_texture_transforms(tmp_path: Path, transform: Any, expected: str) -> None:
    builder, _ = textured(transform)
    mesh, notes = read(builder, tmp_path, 0.06)
    places = [(0.25, 0.75), (0.75, 0.75), (0.25, 0.25), (0.75, 0.25)]
    for (x, up), name in zip(places, expected.split(), strict=True):
        np.testing.assert_allclose(colour_at(mesh, x, up), LINEAR[name], atol=1e-5)
    assert not notes


@pytest.mark.parametrize(
    ("code", "expected"), [(10497, "red green red green"), (33648, "red green green red"),
                           (33071, "red green green green")],
)  # fmt: skip
def test_wrap_modes(tmp_path: Path, code: int, expected: str) -> None:
    """Two pictures side by side, of which the second is beyond u = 1."""
    builder, _ = textured(uv=QUAD_UV * [2, 0.4], wrapS=code)
    mesh, _ = read(builder, tmp_path, 0.05)
    for x, name in zip((0.12, 0.37, 0.63, 0.88), expected.split(), strict=True):
        np.testing.assert_allclose(colour_at(mesh, x, 0.5), LINEAR[name], atol=1e-5)


def test_nearest_pixels_do_not_mix(tmp_path: Path) -> None:
    builder, _ = textured(uv=QUAD_UV * [1, 0.2], magFilter=9728)
    mesh, _ = read(builder, tmp_path, 0.02)
    found = np.unique(mesh.base_colour, axis=0)
    np.testing.assert_allclose(found, [LINEAR["green"], LINEAR["red"]], atol=1e-6)


@pytest.mark.parametrize("is_override", [False, True])
def test_other_coordinate_sets(tmp_path: Path, is_override: bool) -> None:
    """Quantised ones too; the transform's number wins."""
    builder, value = textured({"texCoord": 2} if is_override else None, QUAD_UV * 0.4)
    reference = builder.document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    uv = np.round((QUAD_UV * 0.3 + 0.6) * 65535)
    value["attributes"]["TEXCOORD_2"] = builder.accessor(uv, "u2", normalized=True)
    reference["texCoord"] = 7 if is_override else 2
    mesh, notes = read(builder, tmp_path)
    np.testing.assert_allclose(mesh.base_colour, [LINEAR["grey"]] * len(mesh.vertices), atol=1e-5)
    assert not notes
    reference["texCoord"], reference["extensions"] = 5, {}
    mesh, (note,) = read(builder, tmp_path)
    assert (mesh.base_colour == 1).all()
    assert "TEXCOORD_5 are not read: the material's factors alone remain (paint: linear 1" in note


def test_metal_and_roughness_are_means_over_the_faces(tmp_path: Path) -> None:
    builder = GltfBuilder()
    orm = np.zeros((4, 4, 3))
    orm[:, :2] = [0, 51, 255]
    orm[:, 2:] = [255, 153, 0]
    pbr = {"metallicRoughnessTexture": builder.texture(orm), "roughnessFactor": 0.5}
    builder.quad({"pbrMetallicRoughness": pbr})
    material = read(builder, tmp_path)[0].material
    assert material.metallic == pytest.approx(0.5, abs=0.01)
    assert material.roughness == pytest.approx(0.2, abs=0.005)
    builder.document["materials"][0]["pbrMetallicRoughness"]["metallicFactor"] = 0.5
    assert read(builder, tmp_path)[0].material.metallic == pytest.approx(0.25, abs=0.01)
    builder, _ = textured(uv=QUAD_UV * 0.2 + 0.15)
    pbr = {"metallicRoughnessTexture": builder.texture(orm)}
    builder.document["materials"][0]["pbrMetallicRoughness"] = pbr
    material = read(builder, tmp_path)[0].material
    assert (material.metallic, material.roughness) == (1.0, 0.2)


@pytest.mark.parametrize(
    ("generator", "material", "metallic", "n_notes"),
    [("obj2gltf", {}, 0, 1), ("obj2gltf", {"pbrMetallicRoughness": {"roughnessFactor": 1}}, 0, 1),
     ("obj2gltf", {"pbrMetallicRoughness": {"metallicFactor": 0.7}}, 0.7, 0),
     ("Khronos glTF Blender I/O v4.2", {"pbrMetallicRoughness": {"roughnessFactor": 1}}, 1, 0)],
)  # fmt: skip
def test_a_missing_metallic_factor(
    tmp_path: Path, generator: str, material: dict[str, Any], metallic: float, n_notes: int
) -> None:
    """Blender leaves it out of metal alone; others, of old formats, out of all."""
    builder = GltfBuilder(asset={"version": "2.0", "generator": generator})
    builder.quad(material)
    mesh, notes = read(builder, tmp_path)
    assert mesh.material.metallic == metallic
    assert len(notes) == n_notes
    assert all("read as non-metallic" in note for note in notes)


def _factors(builder: GltfBuilder, **more: Any) -> dict[str, Any]:
    return {"diffuseFactor": [0.6, 0.03, 0.03, 1], "specularFactor": [0.04] * 3, **more}


def _pictures(builder: GltfBuilder, **more: Any) -> dict[str, Any]:
    diffuse = builder.texture(np.full((2, 2, 3), linear_code(0.6)))
    glossy = builder.texture(np.full((4, 4, 4), [56, 56, 56, 153]))
    return {"diffuseTexture": diffuse, "specularGlossinessTexture": glossy,
            "diffuseFactor": [1, 0.05, 0.05, 1], **more}  # fmt: skip


def linear_code(value: float) -> int:
    """sRGB code of a linear value."""
    return int(np.abs(linear_from_srgb8(np.arange(256, dtype=np.uint8)) - value).argmin())


@pytest.mark.parametrize("make", [_factors, _pictures])
def test_specular_glossiness(tmp_path: Path, make: Callable[..., dict[str, Any]]) -> None:
    builder = GltfBuilder()
    glossiness = {} if make is _pictures else {"glossinessFactor": 0.6}
    builder.quad({"extensions": {GLOSSY: make(builder, **glossiness)}})
    mesh, notes = read(builder, tmp_path)
    np.testing.assert_allclose(
        mesh.base_colour, [[0.6, 0.03, 0.03]] * len(mesh.vertices), atol=4e-3
    )
    assert mesh.material.roughness == pytest.approx(0.4, abs=1e-3)
    assert mesh.material.metallic == pytest.approx(0.0, abs=0.01)
    assert not notes


@pytest.mark.parametrize(
    ("diffuse", "specular", "base", "metallic"),
    [([0.5, 0.4, 0.3], [0.04] * 3, [0.5, 0.4, 0.3], 0.0),
     ([0.5, 0.4, 0.3], [0.2] * 3, [0.5, 0.4, 0.3], 0.0),
     ([0.0] * 3, [0.9, 0.6, 0.3], [0.9, 0.6, 0.3], 1.0), ([0.0] * 3, [0.0] * 3, [0.0] * 3, 0.0)],
)  # fmt: skip
def test_metal_is_what_reflects_and_has_no_diffuse_colour(
    diffuse: list[float], specular: list[float], base: list[float], metallic: float
) -> None:
    colour, metal = metal_from_specular(np.array(diffuse), np.array(specular))
    np.testing.assert_allclose(colour, base, atol=0.01)
    assert metal == pytest.approx(metallic, abs=0.01)


@pytest.mark.parametrize(
    ("stored", "named"),
    [("car paint.png", "car%20paint.png"), ("car%20paint.png", "car%20paint.png"),
     ("tex/a.png", "tex\\a.png"), ("../tex/a.png", "../tex/a.png"), ("Paint.PNG", "paint.png"),
     ("a.png", "C:\\Users\\me\\a.png"), ("a.png", "/home/me/a.png"),
     ("car paint.png", "file:///home/me/car%20paint.png"), ("a.png", "file:///C:/me/a.png"),
     ("a#b?.png", "a#b?.png")],
)  # fmt: skip
def test_names_of_pictures(tmp_path: Path, stored: str, named: str) -> None:
    builder, _ = textured(uv=QUAD_UV * 0.2 + 0.15)
    (tmp_path / "model" / stored).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / "model" / stored).write_bytes(picture(ATLAS))
    builder.document["images"][0] = {"uri": named}
    mesh, notes = read(builder, tmp_path / "model")
    np.testing.assert_allclose(mesh.base_colour, [LINEAR["red"]] * len(mesh.vertices), atol=1e-5)
    assert not notes


@pytest.mark.parametrize(
    ("change", "message"),
    [(lambda b: b.document.update(images=[{"uri": "gone%20away.png"}]), "no file 'gone away.png'"),
     (lambda b: b.document.update(images=[{"uri": "http://a.org/b.png"}]), "named by a URL"),
     (lambda b: b.document.update(images=[{"uri": "data:image/png;base64,iVBORw0K"}]), "truncated"),
     (lambda b: b.document.update(images=[{}]), "neither data nor the name of a file"),
     (lambda b: b.document.update(textures=[{}]), "a texture without a picture"),
     (lambda b: b.document.update(textures=[{"extensions": {"KHR_texture_basisu": {"source": 0}}}]),
      r"KTX2 pictures \(KHR_texture_basisu\) are not read")],
)  # fmt: skip
def test_a_picture_that_cannot_be_read_is_a_note(
    tmp_path: Path, change: Callable[[GltfBuilder], None], message: str
) -> None:
    builder, _ = textured()
    builder.document["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [0.5, 0.5, 0, 1]
    change(builder)
    mesh, (note,) = read(builder, tmp_path)
    assert (mesh.base_colour == [0.5, 0.5, 0]).all()
    assert message.replace("\\", "") in note
    assert note.endswith("the material's factors alone remain (paint: linear 0.5 0.5 0)")


def test_pictures_of_other_formats(tmp_path: Path) -> None:
    """WebP is read; where KTX2 has an ordinary picture beside it, that one is."""
    for form, extension in (("WEBP", "EXT_texture_webp"), ("PNG", "KHR_texture_basisu")):
        builder, _ = textured(uv=QUAD_UV * 0.2 + 0.15)
        builder.texture(ATLAS, form)
        source = builder.document["textures"][1]["source"]
        other = {"extensions": {extension: {"source": source}}}
        is_webp = form == "WEBP"
        builder.document["textures"][0] = other | ({} if is_webp else {"source": 0})
        builder.document["extensionsRequired"] = [extension] if is_webp else []
        mesh, notes = read(builder, tmp_path)
        np.testing.assert_allclose(
            mesh.base_colour, [LINEAR["red"]] * len(mesh.vertices), atol=1e-5
        )
        assert not notes


def _extension(name: str, **value: Any) -> GltfBuilder:
    return one(extensions={name: value})


def _animated(node: int) -> GltfBuilder:
    builder = one()
    builder.document["nodes"] = [{"children": [1]}, {"mesh": 0}, {}]
    channel = {"sampler": 0, "target": {"node": node, "path": "rotation"}}
    builder.document["animations"] = [{"channels": [channel]}]
    return builder


def _top(**top: Any) -> GltfBuilder:
    builder = one()
    builder.document |= top
    return builder


def _light(is_in_scene: bool) -> GltfBuilder:
    light = {"extensions": {"KHR_lights_punctual": {"light": 0}}}
    builder = one()
    builder.document["nodes"] += [light]
    builder.document["scenes"] = [{"nodes": [0, 1] if is_in_scene else [0]}]
    return builder


VARIANTS = {"KHR_materials_variants": {"variants": [{"name": "red"}, {"name": "blue"}]}}
NOTES: dict[str, tuple[Callable[[], GltfBuilder], str]] = {
    "nothing": (one, ""),
    "normal map": (lambda: one(normalTexture={"index": 0}), "normal maps are not read: .*paint"),
    "emission": (lambda: one(emissiveFactor=[0, 0, 1]), "emission is not read: .*paint"),
    "no emission": (lambda: one(emissiveFactor=[0, 0, 0], occlusionTexture={"index": 0}), ""),
    "unlit": (lambda: _extension("KHR_materials_unlit"), "unlit is read as matte"),
    "ior": (lambda: _extension("KHR_materials_ior", ior=1.45), ""),
    "diamond": (lambda: _extension("KHR_materials_ior", ior=2.4), "non-metals reflect 4 %"),
    "specular": (lambda: _extension("KHR_materials_specular", specularFactor=0), "reflect 4 %"),
    "specular 1": (lambda: _extension("KHR_materials_specular", specularFactor=0.9), ""),
    "clearcoat": (lambda: _extension("KHR_materials_clearcoat", clearcoatFactor=1), "base coat"),
    "no clearcoat": (lambda: _extension("KHR_materials_clearcoat"), ""),
    "sheen": (lambda: _extension("KHR_materials_sheen", sheenColorFactor=[0, 0, 1]), "no sheen"),
    "animated": (lambda: _animated(0), "animations are not read: the model has its rest pose"),
    "animated elsewhere": (lambda: _animated(2), ""),
    "light": (lambda: _light(True), "lights are not read"),
    "light elsewhere": (lambda: _light(False), ""),
    "scenes": (lambda: _top(scenes=[{"nodes": [0]}, {}]), "of 2 scenes the default one"),
    "variants": (lambda: _top(extensions=VARIANTS), r"of 2 variants \(red, blue"),
    "unknown": (lambda: _top(extensionsUsed=["EXT_x", "FB_ngon_encoding"]), r"out \(EXT_x\)"),
}


@pytest.mark.parametrize("case", NOTES)
def test_what_is_not_read_is_noted(tmp_path: Path, case: str) -> None:
    make, message = NOTES[case]
    mesh, notes = read(make(), tmp_path)
    assert len(mesh.faces) == 2
    if message:
        assert len(notes) == 1
        assert re.search(message, notes[0])
    else:
        assert notes == []


def test_points_and_hidden_nodes_are_left_out(tmp_path: Path) -> None:
    builder = one()
    builder.primitive(BOX, mode=1)
    builder.document["nodes"].append(
        {"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": False}}}
    )
    builder.document["scenes"] = [{"nodes": [0, 1]}]
    mesh, notes = read(builder, tmp_path)
    assert len(mesh.faces) == 2
    assert notes == ["points and lines are left out"]


def test_more_materials_than_a_mesh_has_keep_their_looks(tmp_path: Path) -> None:
    builder = GltfBuilder()
    for i in range(300):
        pbr = {"metallicFactor": i % 2, "roughnessFactor": 0.2 if i < 150 else 0.8}
        builder.document["materials"].append({"name": f"m{i}", "pbrMetallicRoughness": pbr})
        builder.primitive(BOX, BOX_FACES[:1], material=i)
    mesh, _ = read(builder, tmp_path)
    roughness = mesh.face_roughness()
    np.testing.assert_allclose(roughness, np.repeat([0.2, 0.8], 150), atol=1e-6)
