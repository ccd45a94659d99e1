"""glTF from all kinds of exporters: every encoding of a model gives the same mesh."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gltf_files import BOX, BOX_FACES, QUAD, QUAD_FACES, GltfBuilder, rich_document
from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError
from lightsim.store.gltf import read_gltf
from lightsim.store.primitive_mesh import mesh_of

RED = {"pbrMetallicRoughness": {"baseColorFactor": [0.6, 0.03, 0.03, 1], "metallicFactor": 0}}


def read(builder: GltfBuilder, folder: Path, form: str = "glb") -> tuple[TriMesh, tuple[str, ...]]:
    return mesh_of(read_gltf(builder.write(folder / f"model.{form}", form)))


def triangles(mesh: TriMesh) -> list[Any]:
    """Corners of all triangles, independent of the order of faces and of their first corner."""
    corners = np.round(mesh.vertices[mesh.faces].astype(np.float64), 4) + 0.0
    return sorted(min(tuple(map(tuple, np.roll(c, k, axis=0))) for k in range(3)) for c in corners)


def _indices(dtype: str) -> Callable[[GltfBuilder], None]:
    def add(b: GltfBuilder) -> None:
        b.primitive(BOX)["indices"] = b.accessor(BOX_FACES.ravel(), dtype)

    return add


def _without_indices(b: GltfBuilder) -> None:
    b.primitive(BOX[BOX_FACES.ravel()])


def _strided(b: GltfBuilder) -> None:
    rows = np.concatenate([np.full((8, 1), np.nan), BOX, np.zeros((8, 1))], axis=1)
    value = b.primitive(BOX, BOX_FACES)
    view = b.view(rows.astype("<f4").tobytes(), byteStride=20)
    b.document["accessors"][value["attributes"]["POSITION"]] |= {
        "bufferView": view,
        "byteOffset": 4,
    }


def _sparse(has_base: bool) -> Callable[[GltfBuilder], None]:
    def add(b: GltfBuilder) -> None:
        rows = np.array([1, 6]) if has_base else np.arange(8)
        base = BOX.copy()
        base[rows] = 9
        accessor = b.document["accessors"][b.primitive(base, BOX_FACES)["attributes"]["POSITION"]]
        accessor["sparse"] = {
            "count": len(rows),
            "indices": {"bufferView": b.view(rows.astype("u1").tobytes()), "componentType": 5121},
            "values": {"bufferView": b.view(BOX[rows].tobytes())},
        }
        if not has_base:
            del accessor["bufferView"]

    return add


def _quantised(dtype: str, factor: float, **more: Any) -> Callable[[GltfBuilder], None]:
    def add(b: GltfBuilder) -> None:
        low = 0 if dtype.startswith("i") else 1
        value = b.primitive(BOX, BOX_FACES)
        value["attributes"]["POSITION"] = b.accessor((BOX + low) * factor, dtype, **more)
        scale = 1.0 if more else 1 / factor
        b.document["nodes"] = [{"mesh": 0, "scale": [scale] * 3, "translation": [-low] * 3}]

    return add


def _strip(b: GltfBuilder) -> None:
    """Triangles one after the other, joined by ones without area; even ones keep their order."""
    corners: list[int] = []
    for face in BOX_FACES.tolist():
        corners += [*([corners[-1], face[0]] if corners else []), *face]
        corners += [face[-1]] * (len(corners) % 2)
    b.primitive(BOX, corners, mode=5)


def _fans(b: GltfBuilder) -> None:
    for (_, second, third), (first, _, fourth) in zip(BOX_FACES[::2], BOX_FACES[1::2], strict=True):
        b.primitive(BOX, [first, second, third, fourth], mode=6)


def _instanced(b: GltfBuilder) -> None:
    """Turned by a quarter about z, moved by the instance, and back by the node."""
    turned_back = np.stack([BOX[:, 1], -BOX[:, 0], BOX[:, 2]], axis=1)
    b.primitive((turned_back - [0, 5, 0]) / 2, BOX_FACES)
    half = np.sqrt(0.5)
    attributes = {
        "TRANSLATION": b.accessor([[-5.0 - 7, 0, 0]]), "SCALE": b.accessor([[2.0, 2, 2]]),
        "ROTATION": b.accessor([[0, 0, half, half]]),
    }  # fmt: skip
    extension = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    b.document["nodes"] = [{"mesh": 0, "translation": [7.0, 0, 0], "extensions": extension}]


def _skinned(b: GltfBuilder) -> None:
    """Two joints of half the weight each, in a scaled armature; the mesh's node is elsewhere."""
    value = b.primitive((BOX + [0, 3, 0]) * 100, BOX_FACES)
    value["attributes"]["JOINTS_0"] = b.accessor(np.tile([1, 0, 9, 9], (8, 1)), "u1")
    value["attributes"]["WEIGHTS_0"] = b.accessor(np.tile([64, 0, 0, 0], (8, 1)), "u1")
    value["attributes"]["JOINTS_1"] = b.accessor(np.tile([0, 0, 0, 0], (8, 1)), "u2")
    weights = b.accessor(np.tile([64 * 257, 0, 0, 0], (8, 1)), "u2", normalized=True)
    value["attributes"]["WEIGHTS_1"] = weights
    bind = np.tile(np.eye(4), (2, 1, 1))
    bind[:, 1, 3] = -300
    b.document["skins"] = [{
        "joints": [2, 1], "inverseBindMatrices": b.accessor(bind.transpose(0, 2, 1).reshape(2, 16)),
    }]  # fmt: skip
    b.document["nodes"] = [
        {"mesh": 0, "skin": 0, "translation": [50, 60, 70], "scale": [-3, 2, 1]},
        {"translation": [0, 0, 100]}, {"translation": [0, 0, -100]},
        {"scale": [0.01] * 3, "children": [1, 2]},
    ]  # fmt: skip
    b.document["scenes"] = [{"nodes": [3, 0]}]


def _morphed(b: GltfBuilder) -> None:
    value = b.primitive(BOX * [1, 0.5, 1], BOX_FACES)
    delta = b.accessor(BOX * np.array([0, 1, 0], np.float32))
    value["targets"] = [{"POSITION": b.accessor(BOX * 9)}, {"POSITION": delta}]
    b.document["meshes"][0]["weights"] = [1.0, 1.0]
    b.document["nodes"][0]["weights"] = [0.0, 0.5]


def _mirrored(b: GltfBuilder) -> None:
    b.primitive(BOX * [-1, 1, 1], BOX_FACES[:, ::-1])
    b.document["nodes"] = [{"children": [1]}, {"mesh": 0, "scale": [-1, 1, 1]}]


ENCODINGS: dict[str, Callable[[GltfBuilder], None]] = {
    "u1 indices": _indices("u1"), "u2 indices": _indices("u2"), "u4 indices": _indices("u4"),
    "without indices": _without_indices, "strided": _strided, "sparse": _sparse(True),
    "sparse alone": _sparse(False), "i1 normalised": _quantised("i1", 127, normalized=True),
    "i2": _quantised("i2", 300), "u2": _quantised("u2", 1000), "strip": _strip, "fans": _fans,
    "instanced": _instanced, "skinned": _skinned, "morphed": _morphed, "mirrored": _mirrored,
}  # fmt: skip


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_encoding_gives_the_same_box(tmp_path: Path, encoding: str) -> None:
    builder = GltfBuilder(materials=[RED])
    ENCODINGS[encoding](builder)
    for primitive in builder.document["meshes"][0]["primitives"]:
        primitive["material"] = 0
    mesh, notes = read(builder, tmp_path)
    upright = TriMesh(
        "actor",
        np.stack([BOX[:, 0], -BOX[:, 2], BOX[:, 1]], axis=1),
        BOX_FACES.astype(np.int32),
        BOX,
    )
    assert triangles(mesh) == triangles(upright)
    np.testing.assert_allclose(
        mesh.base_colour, [[0.6, 0.03, 0.03]] * len(mesh.vertices), rtol=1e-6
    )
    assert (mesh.material.metallic, notes) == (0.0, ())


@pytest.mark.parametrize("name", ["car #2.glb", "in two parts.gltf", "named.gltf", "named.glb"])
def test_all_forms_give_the_same_bytes(tmp_path: Path, name: str) -> None:
    """Also of a binary file named .gltf, and the other way round."""
    form = {"car #2.glb": "glb", "in two parts.gltf": "separate", "named.gltf": "glb"}.get(name)
    expected, notes = mesh_of(
        read_gltf(rich_document().write(tmp_path / "a.glb")), texture_edge_m=0.3
    )
    path = rich_document().write(tmp_path / name, form or "embedded")
    mesh, notes_of_form = mesh_of(read_gltf(path), texture_edge_m=0.3)
    for field in ("vertices", "faces", "base_colour", "face_material"):
        np.testing.assert_array_equal(getattr(mesh, field), getattr(expected, field))
    assert (mesh.materials, notes_of_form) == (expected.materials, notes)


def test_instances_number_what_they_name(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.primitive(QUAD, QUAD_FACES)
    moves = builder.accessor([[0, 0, 0], [3, 0, 0], [0, 0, 0]])
    scales = builder.accessor([[1, 1, 1], [1, 1, 1], [-1, 1, 1]])
    attributes = {"TRANSLATION": moves, "SCALE": scales}
    extension = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    builder.document["nodes"][0]["extensions"] = extension
    mesh, _ = read(builder, tmp_path)
    assert np.ptp(mesh.vertices[:, 0]) == 5.0
    np.testing.assert_allclose(mesh.face_normals(), [[0, -1, 0]] * 6, atol=1e-7)


@pytest.mark.parametrize(
    ("dtype", "white", "more"),
    [("f4", 1, {}), ("u1", 255, {"normalized": True}), ("u1", 255, {}),
     ("u2", 65535, {"normalized": True})],
)  # fmt: skip
@pytest.mark.parametrize("width", [3, 4])
def test_vertex_colours(
    tmp_path: Path, dtype: str, white: int, more: dict[str, Any], width: int
) -> None:
    """Linear in every number type; alpha counts where the material asks for it."""
    builder = GltfBuilder(materials=[RED | {"alphaMode": "MASK"}])
    value = builder.primitive(QUAD, QUAD_FACES, material=0)
    colour = np.tile([1, 1, 0.2, 0.4][:width], (4, 1)) * white
    value["attributes"]["COLOR_0"] = builder.accessor(colour, dtype, **more)
    if width == 4:
        with pytest.raises(InputError, match="the model has no visible surface"):
            read(builder, tmp_path)
        del builder.document["materials"][0]["alphaMode"]
    mesh, _ = read(builder, tmp_path)
    np.testing.assert_allclose(mesh.base_colour, [[0.6, 0.03, 0.006]] * 4, rtol=1e-4)


def test_data_that_the_fallback_has_is_read(tmp_path: Path) -> None:
    """Compression that a file does not require leaves ordinary data beside it."""
    builder = GltfBuilder(extensionsUsed=["KHR_draco_mesh_compression", "EXT_meshopt_compression"])
    value = builder.primitive(BOX, BOX_FACES)
    value["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {}}}
    extension = {"EXT_meshopt_compression": {"buffer": 0, "byteLength": 1, "count": 8}}
    builder.document["bufferViews"][0]["extensions"] = extension
    mesh, notes = read(builder, tmp_path)
    assert (len(mesh.faces), len(notes)) == (12, 1)


def test_texts_that_are_like_data_uris_and_capital_ones_are_read(tmp_path: Path) -> None:
    builder = GltfBuilder(asset={"version": "2"})
    builder.primitive(BOX, BOX_FACES, material=0)
    builder.document["materials"] = [RED | {"name": "data:red"}]
    path = builder.write(tmp_path / "m.gltf", "embedded")
    text = path.read_text().replace("data:application", "DATA:application")
    path.write_text(text.replace(";base64,", ";BASE64,"))
    (primitive,) = read_gltf(path).primitives
    assert primitive.material.name == "data:red"
    np.testing.assert_array_equal(primitive.vertices, BOX)


def test_a_json_chunk_may_be_filled_with_zeros(tmp_path: Path) -> None:
    builder = GltfBuilder(asset={"version": "2.0", "generator": "odd"})
    builder.primitive(BOX, BOX_FACES)
    path = builder.write(tmp_path / "m.glb")
    data = path.read_bytes()
    end = data.index(b"BIN\0") - 4
    text = data[20:end].rstrip() + b"\0" * 8
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(data) - end, len(text), b"JSON")
    path.write_bytes(head + text + data[end:])
    np.testing.assert_array_equal(read_gltf(path).primitives[0].vertices, BOX)


def _no_rows(b: GltfBuilder, value: dict[str, Any]) -> None:
    b.document["accessors"][value["attributes"]["POSITION"]]["count"] = 0


@pytest.mark.parametrize(
    "spoil",
    [
        _no_rows,
        lambda b, value: b.document["accessors"][value["indices"]].update(count=0),
        lambda b, value: value["attributes"].pop("POSITION"),
        lambda b, value: value.pop("attributes"),
        lambda b, value: b.document["meshes"][1].update(primitives=[]),
        lambda b, value: b.document["meshes"][1].pop("primitives"),
    ],
)
def test_empty_primitives_are_left_out(
    tmp_path: Path, spoil: Callable[[GltfBuilder, dict[str, Any]], None]
) -> None:
    builder = GltfBuilder(nodes=[{"mesh": 0, "children": [1]}, {"mesh": 1}])
    builder.primitive(BOX, BOX_FACES)
    value = builder.primitive(QUAD, QUAD_FACES)
    builder.document["meshes"][0]["primitives"].pop()
    builder.document["meshes"].append({"primitives": [value]})
    spoil(builder, value)
    model = read_gltf(builder.write(tmp_path / "m.glb"))
    assert [len(p.faces) for p in model.primitives] == [12]
    assert any(n.startswith("empty meshes and primitives are left out (") for n in model.notes)
    builder.document["nodes"] = [{"mesh": 1}]
    with pytest.raises(InputError, match="no triangles, got empty meshes"):
        read_gltf(builder.write(tmp_path / "m.glb"))
