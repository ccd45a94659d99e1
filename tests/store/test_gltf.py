"""glTF from all kinds of exporters: every encoding of a model gives the same mesh."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gltf_files import BOX, BOX_FACES, QUAD, QUAD_FACES, GltfBuilder, glb, picture, rich_document
from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError
from lightsim.store import gltf, gltf_accessors, gltf_scene
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
        with pytest.raises(InputError, match="nothing of the model is visible"):
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


def _draco(document: dict[str, Any]) -> None:
    for accessor in document["accessors"]:
        del accessor["bufferView"]
    document["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": {}}


def _meshopt(document: dict[str, Any]) -> None:
    document["buffers"] = [{"byteLength": 96}, {"byteLength": 96}]
    extension = {"EXT_meshopt_compression": {"buffer": 0}}
    document["bufferViews"][0] |= {"buffer": 1, "extensions": extension}


def _accessor(**more: Any) -> Callable[[dict[str, Any]], None]:
    return lambda d: d["accessors"][0].update(more)


def _skin(**skin: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        document["nodes"][0]["skin"] = 0
        document["skins"] = [{"joints": [0], **skin}]
        document["meshes"][0]["primitives"][0]["attributes"] |= {"JOINTS_0": 2, "WEIGHTS_0": 2}

    return change


BROKEN: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "required": (lambda d: d.update(extensionsRequired=["EXT_x"]), "EXT_x, expected.*Export"),
    "draco": (_draco, "KHR_draco_mesh_compression, .*gltf-transform"),
    "meshopt": (_meshopt, "EXT_meshopt_compression, .*gltf-transform"),
    "ktx2": (lambda d: d.update(extensionsRequired=["KHR_texture_basisu"]), "basisu.*PNG"),
    "version": (lambda d: d["asset"].update(version="1.0"), "it is glTF 1.0"),
    "points": (lambda d: d["meshes"][0]["primitives"][0].update(mode=0), "no triangles.*points"),
    "nothing": (lambda d: d["nodes"][0].pop("mesh"), "no triangles.*no mesh"),
    "index": (lambda d: d["accessors"][0].update(count=5), "a triangle names vertex 7, of 5"),
    "negative": (lambda d: d["nodes"][0].update(mesh=-1), r"meshes\[-1\] is named"),
    "count": (_accessor(count=10**9), "runs past"),
    "sparse": (_accessor(sparse={"count": 9}), "KeyError: 'indices'"),
    "no buffer": (lambda d: (d.update(buffers=[{"byteLength": 9}, {}]),
                             d["bufferViews"][0].update(buffer=1)), r"buffers\[1\] has no data"),
    "buffer": (lambda d: d["bufferViews"][0].update(buffer=3), r"buffers\[3\] is named"),
    "far": (lambda d: d["nodes"][0].update(scale=[1e30] * 3), "1e\\+12 or more from the origin"),
    "loop": (lambda d: d["nodes"][0].update(children=[0]), "form a loop"),
    "loop of joints": (lambda d: (_skin()(d), d["nodes"].append({"children": [0]}),
                                  d["nodes"][0].update(children=[1])), "form a loop"),
    "joint": (_skin(joints=[0]), "names no joint"),
    "no joints": (_skin(joints=[]), "a skin has 0 joints"),
    "material": (lambda d: d["meshes"][0]["primitives"][0].update(material=4), r"materials\[4\]"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("case", "form"),
    [(case, form) for case in BROKEN for form in ("glb", "embedded")
     if form == "glb" or case not in ("meshopt", "no buffer")],  # The buffer is another one there.
)  # fmt: skip
def test_what_is_broken_is_named_with_its_file(tmp_path: Path, case: str, form: str) -> None:
    builder = GltfBuilder()
    builder.primitive(BOX, BOX_FACES)
    builder.accessor(np.full((8, 4), 3), "u1")
    change, message = BROKEN[case]
    change(builder.document)
    path = builder.write(tmp_path / "model.gltf", form)
    with pytest.raises(InputError, match=rf"model\.gltf: .*{message}"):
        read_gltf(path)


@pytest.mark.parametrize(
    ("data", "message"),
    [(b"solid ascii", "neither glTF binary nor JSON"), (b"", "neither"), (b"\xff\xfe{", "neither"),
     (b"[]", "no glTF document"), (b'{"asset":' * 100_000, "nested too deep|neither"),
     (struct.pack("<4sII", b"glTF", 1, 12), "glTF 1, not"), (glb(b"{}", b"")[:-3], "truncated"),
     (b" " * (17 << 20), "more than 16777216")],
)  # fmt: skip
def test_what_is_no_gltf(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "a.gltf").write_bytes(data)
    with pytest.raises(InputError, match=rf"a\.gltf: the model cannot be read, .*{message}"):
        read_gltf(tmp_path / "a.gltf")


def test_a_missing_buffer_is_named(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.primitive(BOX, BOX_FACES)
    path = builder.write(tmp_path / "my car.gltf", "separate")
    path.with_suffix(".bin").unlink()
    with pytest.raises(InputError, match=r"my car\.gltf: the model's buffer is missing.*car\.bin'"):
        read_gltf(path)


def _claims(builder: GltfBuilder) -> None:
    accessor = builder.document["accessors"][builder.primitive(BOX)["attributes"]["POSITION"]]
    del accessor["bufferView"]
    places = {"bufferView": builder.view(b"\0"), "componentType": 5121}
    values = {"bufferView": builder.view(bytes(12))}
    accessor |= {"count": 10**9, "sparse": {"count": 1, "indices": places, "values": values}}


def _copies(builder: GltfBuilder) -> None:
    builder.primitive(np.zeros((30_000, 3)), [0, 1, 2])
    moves = builder.accessor(np.zeros((900, 3)))
    instances = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": moves}}}
    builder.document["nodes"][0]["extensions"] = instances


def _tree(builder: GltfBuilder) -> None:
    """Nodes of which each has the next one twice: 2 to the power of 60 places."""
    builder.primitive(QUAD, QUAD_FACES)
    nodes = [{"children": [i + 1, i + 1]} for i in range(60)]
    builder.document["nodes"] = [*nodes, {"mesh": 0}]


def _morphs(builder: GltfBuilder) -> None:
    value = builder.primitive(np.zeros((30_000, 3)), [0, 1, 2])
    value["targets"] = [{"POSITION": 0}] * 50_000
    builder.document["meshes"][0]["weights"] = [1e-9] * 50_000


@pytest.mark.parametrize("attack", [_claims, _copies, _tree, _morphs])
def test_small_files_do_not_become_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, attack: Callable[[GltfBuilder], None]
) -> None:
    """The limits are lowered, so that the test is quick; without them it would take for ever."""
    monkeypatch.setattr(gltf_accessors, "_MAX_VALUES", 10**7)
    monkeypatch.setattr(gltf_scene, "_MAX_VISITS", 1000)
    builder = GltfBuilder()
    attack(builder)
    path = builder.write(tmp_path / "a.glb")
    with pytest.raises(InputError, match=r"a\.glb: .*(claims|more than|loop)"):
        read_gltf(path)


def test_a_picture_is_not_decoded_beyond_the_limit(tmp_path: Path) -> None:
    header = bytearray(picture(np.zeros((1, 1, 3))))
    header[16:24] = struct.pack(">II", 60_000, 60_000)
    header[29:33] = struct.pack(">I", zlib.crc32(header[12:29]))
    builder = GltfBuilder()
    reference = builder.texture(np.zeros((1, 1, 3)))
    builder.document["images"][0]["bufferView"] = builder.view(bytes(header))
    builder.quad({"pbrMetallicRoughness": {"baseColorTexture": reference, "metallicFactor": 0}})
    (note,) = read_gltf(builder.write(tmp_path / "a.glb")).notes
    assert note.startswith("picture 0 is not read (Image size (3600000000 pixels) exceeds")


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
def test_damaged_documents(tmp_path: Path, data: st.DataObject) -> None:
    """A value anywhere in the document is replaced or removed: a mesh, or our error."""
    builder = rich_document()
    places = _places(builder.document)
    for _ in range(data.draw(st.integers(1, 3))):
        container, key = data.draw(st.sampled_from(places))
        if data.draw(st.booleans()) and isinstance(container, dict):
            container.pop(key, None)
        elif isinstance(container, dict) or key < len(container):
            values = [-1, 0, 1, 5, 2**31, 1e300, 0.5, None, "x", [], {}, [1, 2], True]
            container[key] = data.draw(st.sampled_from(values))
    path = tmp_path / "fuzz.gltf"
    builder.write(path, data.draw(st.sampled_from(["glb", "embedded"])))
    try:
        mesh, _ = mesh_of(read_gltf(path), texture_edge_m=1.0)
    except InputError as error:
        message = str(error)
    else:
        message = f"fuzz.gltf: {np.isfinite(mesh.base_colour).all()}"
    assert "fuzz.gltf" in message
    assert "False" not in message


def _places(value: Any) -> list[tuple[Any, Any]]:
    items = list(value.items()) if isinstance(value, dict) else list(enumerate(value))
    found = [(value, key) for key, _ in items]
    return found + [p for _, v in items if isinstance(v, dict | list) for p in _places(v)]


def test_limits_count_faces_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gltf, "_MAX_FACES", 11)
    builder = GltfBuilder()
    builder.primitive(BOX, BOX_FACES)
    path = builder.write(tmp_path / "a.glb")
    with pytest.raises(InputError, match="more than"):
        read_gltf(path)
