"""glTF: loss-free round trip, a standard file for others, and the CAD models."""

from __future__ import annotations

import dataclasses
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import trimesh.visual
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lightsim.core.colour import linear_from_srgb8, srgb8_from_linear
from lightsim.core.mesh import Material, Provenance, Texture, TriMesh
from lightsim.errors import InputError
from lightsim.store import gltf
from lightsim.store.gltf import read_gltf
from lightsim.store.meshes import read_glb, write_glb
from lightsim.store.primitive_mesh import mesh_of


@pytest.fixture
def mesh(rng: np.random.Generator) -> TriMesh:
    vertices = rng.normal(0, 100, (40, 3)).astype(np.float32)
    faces = rng.permuted(np.tile(np.arange(40, dtype=np.int32), (25, 1)), axis=1)[:, :3]
    colour = rng.random((40, 3)).astype(np.float32)
    return TriMesh("world", vertices, np.ascontiguousarray(faces), colour, (Material(0.4, 0.1),))


def test_the_file_keeps_the_standard(tmp_path: Path, mesh: TriMesh) -> None:
    write_glb(tmp_path / "a.glb", mesh)
    data = (tmp_path / "a.glb").read_bytes()
    document, binary = _chunks(data)
    assert document["asset"]["version"] == "2.0"
    size = {"SCALAR": 4, "VEC3": 12}
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        assert accessor["count"] * size[accessor["type"]] == view["byteLength"]
        assert view["byteOffset"] + view["byteLength"] <= document["buffers"][0]["byteLength"]
    assert document["buffers"][0]["byteLength"] == len(binary)
    positions = document["accessors"][0]
    np.testing.assert_array_equal(np.float32(positions["min"]), mesh.vertices.min(axis=0))
    np.testing.assert_array_equal(np.float32(positions["max"]), mesh.vertices.max(axis=0))
    view = document["bufferViews"][2]
    indices = np.frombuffer(binary, "<u4", offset=view["byteOffset"])
    assert indices.max() < positions["count"]


def _rich(mesh: TriMesh, rng: np.random.Generator, *, textured: bool) -> TriMesh:
    """Every vertex used, two materials, confidence, and a texture."""
    faces = np.arange(39, dtype=np.int32).reshape(-1, 3)
    faces = np.concatenate([faces, [[39, 0, 1]]]).astype(np.int32)
    number = (np.arange(len(faces)) > 5).astype(np.uint8)
    materials = (Material(0.3, 0.4, "car paint"), Material(0.9, 0.0, "asphalt"))
    codes = rng.integers(0, 256, (50, 70, 3)).astype(np.uint8)
    uv = (np.floor(rng.uniform(0, 50, (len(faces), 3, 2))) + 0.5).astype(np.float32)
    texture = Texture(linear_from_srgb8(codes), uv) if textured else None
    confidence = rng.random(40).astype(np.float32)
    provenance = (np.arange(len(faces)) % len(Provenance)).astype(np.uint8)
    return TriMesh(
        "world",
        mesh.vertices,
        faces,
        mesh.base_colour,
        materials,
        number,
        texture,
        confidence,
        provenance,
    )


def _assert_equal(back: TriMesh, mesh: TriMesh) -> None:
    names = (
        "vertices", "faces", "base_colour", "face_material", "confidence", "face_provenance",
    )  # fmt: skip
    for name in names:
        np.testing.assert_array_equal(getattr(back, name), getattr(mesh, name))
    assert back.materials == mesh.materials
    assert back.frame == mesh.frame
    if mesh.texture is None or back.texture is None:
        assert mesh.texture is back.texture
        return
    np.testing.assert_array_equal(back.texture.corner_uv, mesh.texture.corner_uv)
    np.testing.assert_allclose(back.texture.image, mesh.texture.image, atol=1e-6)


@pytest.mark.parametrize("kind", ["plain", "materials", "texture"])
def test_materials_texture_confidence_and_provenance_come_back(
    tmp_path: Path, mesh: TriMesh, rng: np.random.Generator, kind: str
) -> None:
    made = mesh if kind == "plain" else _rich(mesh, rng, textured=kind == "texture")
    write_glb(tmp_path / "a.glb", made)
    _assert_equal(read_glb(tmp_path / "a.glb", "world"), made)


def test_another_reader_sees_texture_and_materials(
    tmp_path: Path, mesh: TriMesh, rng: np.random.Generator
) -> None:
    rich = _rich(mesh, rng, textured=True)
    write_glb(tmp_path / "a.glb", rich)
    parts = list(trimesh.load_scene(tmp_path / "a.glb").geometry.values())
    assert [len(part.faces) for part in parts] == [6, 8]
    material = parts[0].visual.material
    assert material.name == "car paint"
    assert (material.roughnessFactor, material.metallicFactor) == (0.3, 0.4)
    assert material.baseColorTexture.size == (70, 50)
    assert rich.texture is not None
    pixels = np.asarray(material.baseColorTexture.convert("RGB"))
    np.testing.assert_array_equal(pixels, srgb8_from_linear(rich.texture.image))
    # trimesh counts v from the bottom.
    uv = np.asarray(parts[0].visual.uv) * [70, 50]
    uv[:, 1] = 50 - uv[:, 1]
    np.testing.assert_allclose(uv, rich.texture.corner_uv[:6].reshape(-1, 2), atol=1e-3)


def test_another_reader_sees_it_upright(tmp_path: Path, mesh: TriMesh) -> None:
    write_glb(tmp_path / "a.glb", mesh)
    scene = trimesh.load_scene(tmp_path / "a.glb")
    x, y, z = mesh.vertices.T
    expected = np.stack([x, z, -y], axis=1)
    np.testing.assert_allclose(
        scene.bounds, [expected.min(axis=0), expected.max(axis=0)], atol=1e-4
    )


def test_cad_models(shared_data: Path) -> None:
    models = sorted((shared_data / "cad").glob("*.glb"))
    assert len(models) == 10
    for path in models:
        mesh = mesh_of(read_gltf(path), "actor", 0.2)[0]
        scene = trimesh.load_scene(path)
        low, high = np.asarray(scene.bounds)
        x, y, z = mesh.vertices.T
        np.testing.assert_allclose(np.stack([x.min(), z.min(), -y.max()]), low, atol=1e-5)
        np.testing.assert_allclose(np.stack([x.max(), z.max(), -y.min()]), high, atol=1e-5)
        assert abs(mesh.vertices[:, 2].min()) < 1e-3
        assert mesh.base_colour.std() > 0.01
        area = mesh.face_areas_m2().sum()
        assert area == pytest.approx(float(scene.to_mesh().area), rel=1e-4)
    red = read_glb(shared_data / "cad" / "hatchback_red.glb", "actor").base_colour.mean(axis=0)
    assert red[0] > 1.5 * red[1]


def test_texture_becomes_colour_in_linear_light(tmp_path: Path) -> None:
    """A quad, left half sRGB 188, right half black, times a factor of 0.5."""
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:, :4] = 188
    image = trimesh.visual.material.PBRMaterial(
        baseColorTexture=_pil(pixels), baseColorFactor=[0.5, 0.5, 0.5, 1.0]
    )
    quad = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False
    )
    uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
    quad.visual = trimesh.visual.TextureVisuals(uv=uv, material=image)
    trimesh.Scene(quad).export(tmp_path / "quad.glb")
    mesh = mesh_of(read_gltf(tmp_path / "quad.glb"), "actor", 0.1)[0]
    x = mesh.vertices[:, 0]
    np.testing.assert_allclose(mesh.base_colour[(x > 0.1) & (x < 0.4)], 0.5 * 0.5029, atol=3e-3)
    np.testing.assert_allclose(mesh.base_colour[(x > 0.6) & (x < 0.9)], 0.0, atol=1e-6)
    np.testing.assert_allclose(mesh.vertices[:, 1], 0.0, atol=1e-7)
    assert mesh.vertices[:, 2].max() == 1.0
    longest = max(
        float(
            np.linalg.norm(
                mesh.vertices[mesh.faces[:, i]] - mesh.vertices[mesh.faces[:, j]], axis=1
            ).max()
        )
        for i, j in ((0, 1), (1, 2), (2, 0))
    )
    assert longest <= 0.1
    assert (mesh.face_normals()[:, 1] < 0).all()
    _assert_watertight_inside(mesh)


def _assert_watertight_inside(mesh: TriMesh) -> None:
    """No T-junctions: every edge is shared by two faces or lies on the quad's border."""
    edges = np.sort(np.concatenate([mesh.faces[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    middle = mesh.vertices[unique[count == 1]].mean(axis=1)[:, [0, 2]]
    assert (np.isclose(middle, 0) | np.isclose(middle, 1)).any(axis=1).all()
    assert count.max() == 2


def test_broken_models(tmp_path: Path, mesh: TriMesh) -> None:
    path = tmp_path / "a.glb"
    with pytest.raises(InputError, match="cannot open"):
        read_glb(path, "actor")
    path.write_bytes(b"solid ascii stl")
    with pytest.raises(InputError, match=r"a\.glb.*glTF"):
        read_glb(path, "actor")
    with pytest.raises(InputError, match="without faces"):
        write_glb(path, TriMesh("world", mesh.vertices, mesh.faces[:0], mesh.base_colour))
    write_glb(path, mesh)
    document, binary = _chunks(path.read_bytes())
    for change, message in _BREAKAGES:
        broken = json.loads(json.dumps(document))
        change(broken)
        path.write_bytes(_join(broken, binary))
        with pytest.raises(InputError, match=rf"a\.glb.*{message}"):
            read_glb(path, "actor")


@pytest.mark.parametrize("textured", [False, True])
def test_our_own_file_with_a_moved_corner_is_no_foreign_model(
    tmp_path: Path, mesh: TriMesh, rng: np.random.Generator, textured: bool
) -> None:
    """One flipped bit once made another mesh of it: refined to a million faces, and no message."""
    path = tmp_path / "a.glb"
    write_glb(path, _rich(mesh, rng, textured=textured))
    document, binary = _chunks(path.read_bytes())
    position = document["bufferViews"][document["accessors"][0]["bufferView"]]["byteOffset"]
    document["meshes"][0]["primitives"][1]["attributes"].pop("_VERTEX")
    path.write_bytes(_join(document, binary))
    with pytest.raises(InputError, match="lack their vertex numbers"):
        read_glb(path, "world")
    if not textured:
        return
    write_glb(path, _rich(mesh, rng, textured=True))
    document, binary = _chunks(path.read_bytes())
    flipped = bytearray(binary)
    flipped[position + 2] ^= 0x40
    path.write_bytes(_join(document, bytes(flipped)))
    with pytest.raises(InputError, match="do not meet"):
        read_glb(path, "world")


def test_a_huge_textured_triangle_is_split_within_the_limit(
    tmp_path: Path, mesh: TriMesh, rng: np.random.Generator
) -> None:
    path = tmp_path / "huge.glb"
    rich = _rich(mesh, rng, textured=True)
    write_glb(path, dataclasses.replace(rich, vertices=(rich.vertices * 1e6).astype(np.float32)))
    document, binary = _chunks(path.read_bytes())
    for primitive in document["meshes"][0]["primitives"]:
        for name in ("_VERTEX", "_BASE_COLOUR", "_CONFIDENCE"):
            del primitive["attributes"][name]
    path.write_bytes(_join(document, binary))
    model = read_glb(path, "actor")
    assert 1e5 < len(model.faces) <= 1e6


def test_many_instances_of_a_mesh_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mesh: TriMesh
) -> None:
    monkeypatch.setattr(gltf, "MAX_VERTICES", 50 * len(mesh.vertices))
    path = tmp_path / "a.glb"
    write_glb(path, mesh)
    document, binary = _chunks(path.read_bytes())
    node = next(n for n in document["nodes"] if "mesh" in n)
    document["nodes"].extend([dict(node)] * 50)
    n = len(document["nodes"])
    document["scenes"][0]["nodes"].extend(range(n - 50, n))
    path.write_bytes(_join(document, binary))
    with pytest.raises(InputError, match="its instances have more than"):
        read_glb(path, "actor")


_BREAKAGES = [
    (lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]), "draco"),
    (lambda d: d["accessors"][0].update(count=10**9), "runs past"),
    (lambda d: d["accessors"][0].update(count=float("inf")), "inf where a whole number"),
    (lambda d: d["bufferViews"][1].update(byteOffset=10**6), "runs past"),
    (lambda d: d["nodes"][1].update(children=[0]), "loop"),
    (lambda d: d["nodes"][0].update(matrix=[1.0]), "reshape"),
    (lambda d: d["nodes"][1].update(rotation=[1e200] * 4), "not a unit quaternion"),
    (lambda d: d["nodes"][1].update(rotation=[0.0] * 4), "zero norm"),
    (lambda d: d["meshes"][0]["primitives"][0].update(mode=7), "a primitive of mode 7"),
    (lambda d: d["meshes"][0]["primitives"][0].update(mode=0), "no triangles"),
    (lambda d: d.pop("meshes"), "meshes"),
    (lambda d: d["accessors"][0].update(count=2), "names vertex"),
]


@settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
def test_flipped_and_cut_bytes(tmp_path: Path, mesh: TriMesh, data: st.DataObject) -> None:
    path = tmp_path / "fuzz.glb"
    write_glb(path, mesh)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, 1500))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(content[: data.draw(st.integers(0, len(content)))]))
    message = "fuzz.glb"
    try:
        read_glb(path, "actor")
    except InputError as error:
        message = str(error)
    assert "fuzz.glb" in message


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, total = struct.unpack_from("<4sII", data)
    assert (magic, version, total) == (b"glTF", 2, len(data))
    length, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert length % 4 == 0
    size, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert kind == b"BIN\0"
    assert 28 + length + size == total
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def _join(document: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    json_chunk = struct.pack("<I4s", len(text), b"JSON") + text
    return head + json_chunk + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def _pil(pixels: np.ndarray) -> Any:
    from PIL import Image

    return Image.fromarray(pixels)
