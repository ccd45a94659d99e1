"""Meshes of the viewer: limits, axes, colours and the artefact."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.render.rendering_scenes import box, plane
from tests.tiny_world import GROUND, TinyWorkspace, tiny_world

from lightsim.app import meshes
from lightsim.app.baked import LightTracer, Surface
from lightsim.app.glb import MAX_TEXTURE_PX
from lightsim.app.meshes import decimated
from lightsim.app.stored import view_meshes
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.dome import SkyDome
from lightsim.core.mesh import Material, Texture, TriMesh
from lightsim.errors import InputError
from lightsim.progress import SilentProgress
from lightsim.store.gltf import read_gltf
from lightsim.store.primitives import Primitive

TETRAHEDRON = np.array([[0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1]], np.float32)
"""Three edges of different lengths along the axes: no turn or mirror maps it onto itself."""
OUTWARD = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


def tetrahedron(**values: Any) -> TriMesh:
    colours = np.linspace(0.05, 0.95, 12, dtype=np.float32).reshape(4, 3)
    return TriMesh("actor", TETRAHEDRON, OUTWARD, colours, **values)


def file_of(mesh: TriMesh) -> bytes:
    """The file of a mesh under light 1."""
    surface = Surface.of(mesh)
    return surface.file.glb(np.ones((len(surface.position), 3), np.float32))


def primitives_of(glb: bytes, folder: Path) -> tuple[Primitive, ...]:
    path = folder / "mesh.glb"
    path.write_bytes(glb)
    return read_gltf(path).primitives


def document_of(glb: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON of a .glb file and its binary data."""
    (length,) = struct.unpack_from("<I", glb, 12)
    return json.loads(glb[20 : 20 + length]), glb[20 + length + 8 :]


def rows_of(glb: bytes, primitive: int, attribute: str) -> np.ndarray:
    document, data = document_of(glb)
    mesh = document["meshes"][0]["primitives"][primitive]
    accessor = document["accessors"][mesh["attributes"][attribute]]
    view = document["bufferViews"][accessor["bufferView"]]
    rows = np.frombuffer(data, "<f4", view["byteLength"] // 4, view["byteOffset"])
    return rows.reshape(accessor["count"], -1)


def test_the_file_has_the_axes_of_the_mesh(tmp_path: Path) -> None:
    (part,) = primitives_of(file_of(tetrahedron()), tmp_path)
    corners = part.vertices[part.faces]
    np.testing.assert_array_equal(corners, TETRAHEDRON[OUTWARD])
    volume = np.linalg.det(corners).sum() / 6  # positive: fronts are still outside
    assert volume == pytest.approx(1.0)


def test_vertex_colours_are_linear_and_exact(tmp_path: Path) -> None:
    mesh = tetrahedron()
    (part,) = primitives_of(file_of(mesh), tmp_path)
    np.testing.assert_array_equal(part.colour[part.faces], mesh.base_colour[OUTWARD])


def test_texture_colours_are_srgb(tmp_path: Path) -> None:
    image = np.full((64, 64, 3), (0.5, 0.2, 0.05), np.float32)
    uv = np.full((4, 3, 2), 32.0, np.float32)
    (part,) = primitives_of(file_of(tetrahedron(texture=Texture(image, uv))), tmp_path)
    assert part.texture is not None
    shown = linear_from_srgb8(part.texture.pixels[32, 32])
    np.testing.assert_allclose(shown[:3], image[0, 0], rtol=0.03)  # 8 bits and JPEG
    assert part.uv is not None
    np.testing.assert_allclose(part.uv, 0.5)


def test_a_large_texture_is_reduced_and_its_coordinates_stay_fractions(tmp_path: Path) -> None:
    image = np.full((16, 2 * MAX_TEXTURE_PX, 3), 0.25, np.float32)
    uv = np.full((4, 3, 2), (MAX_TEXTURE_PX / 2, 4.0), np.float32)
    (part,) = primitives_of(file_of(tetrahedron(texture=Texture(image, uv))), tmp_path)
    assert part.texture is not None
    assert part.uv is not None
    assert part.texture.pixels.shape[:2] == (16, MAX_TEXTURE_PX)
    np.testing.assert_allclose(part.uv, [[0.25, 0.25]] * len(part.uv))


def test_edges_of_a_box_are_sharp_and_its_points_lie_outside() -> None:
    apart = box((0, 0, 0), (4.0, 2.0, 1.0), 0.2)
    vertices, number = np.unique(apart.vertices, axis=0, return_inverse=True)
    faces = number.reshape(-1)[apart.faces].astype(np.int32)
    surface = Surface.of(TriMesh("actor", vertices, faces, apart.base_colour[:8]))
    assert len(surface.position) == 24  # three at each of 8 corners
    np.testing.assert_allclose(np.abs(surface.normal).max(axis=1), 1.0)
    beyond = np.abs(surface.position) - [2.0, 1.0, 0.5]
    np.testing.assert_allclose(beyond.max(axis=1), 0.02, atol=1e-6)
    light = np.abs(surface.normal).astype(np.float32)
    colours = rows_of(surface.file.glb(light), 0, "COLOR_0")
    np.testing.assert_allclose(np.sort(colours, axis=1)[:, :2], 0.0, atol=1e-6)


def test_materials_share_no_vertex() -> None:
    ground = plane(10.0, 2)
    half = np.arange(len(ground.faces)) % 2
    two = replace(
        ground,
        materials=(Material(name="a"), Material(name="b")),
        face_material=half.astype(np.uint8),
    )
    document, _ = document_of(file_of(two))
    first, second = document["meshes"][0]["primitives"]
    assert set(first["attributes"].values()).isdisjoint(second["attributes"].values())
    assert [m["name"] for m in document["materials"]] == ["a", "b"]


def test_a_mesh_without_faces_is_refused() -> None:
    with pytest.raises(InputError, match="without faces"):
        file_of(plane(cells=0))


def test_a_small_mesh_is_not_decimated() -> None:
    ground = plane(10.0, 4)
    assert decimated(ground, len(ground.faces)) is ground


def test_a_plane_is_decimated_to_the_limit_in_its_colour() -> None:
    ground = plane(10.0, 40, GROUND)
    small = decimated(ground, 300)
    assert 0 < len(small.faces) <= 300 < len(ground.faces)
    assert small.face_areas_m2().sum() == pytest.approx(ground.face_areas_m2().sum(), rel=1e-3)
    np.testing.assert_allclose(small.base_colour, np.tile(GROUND, (len(small.vertices), 1)))


def test_of_pieces_that_cannot_be_joined_the_largest_remain() -> None:
    size = np.arange(1.0, 101.0)
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    places = 200.0 * np.arange(100.0)[:, None, None] * [1.0, 0.0, 0.0]
    vertices = (size[:, None, None] * triangle + places).reshape(-1, 3).astype(np.float32)
    faces = np.arange(300, dtype=np.int32).reshape(-1, 3)
    pieces = TriMesh("world", vertices, faces, np.zeros((300, 3), np.float32))
    largest = decimated(pieces, 10)
    areas = np.sort(largest.face_areas_m2())
    np.testing.assert_allclose(areas, np.arange(91.0, 101.0) ** 2 / 2, rtol=1e-5)


class BuiltWorkspace(TinyWorkspace):
    """A tiny world in a real folder, whose twin has an artefact key."""

    twin_key: str

    def record(self, stage: str) -> dict[str, Any]:
        assert stage == "twin"
        return {"key": self.twin_key}


@pytest.fixture
def work(tmp_path: Path) -> BuiltWorkspace:
    work = tiny_world(SkyDome(np.ones((8, 16, 3), np.float32), None))
    work.__class__ = BuiltWorkspace
    assert isinstance(work, BuiltWorkspace)
    work.root, work.twin_key = tmp_path, "first"
    return work


def test_the_meshes_are_made_once_and_again_for_another_twin(work: BuiltWorkspace) -> None:
    made = view_meshes(LightTracer(work), SilentProgress())
    path = work.root / "view" / "meshes" / "background.glb"
    time_ns = path.stat().st_mtime_ns
    again = view_meshes(LightTracer(work), SilentProgress())
    assert path.stat().st_mtime_ns == time_ns
    assert (again.background, again.glb_by_actor) == (made.background, made.glb_by_actor)
    assert made.inferred is None
    assert set(made.glb_by_actor) == {"car"}
    work.twin_key = "second"
    view_meshes(LightTracer(work), SilentProgress())
    assert path.stat().st_mtime_ns > time_ns


def test_background_and_inferred_surfaces_share_the_limit(
    work: BuiltWorkspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(meshes, "MAX_TRIANGLES", 400)
    assets = replace(work.assets, background=plane(60.0, 30, GROUND))
    work.__dict__["twin"] = replace(work.twin, assets=assets)
    found = view_meshes(LightTracer(work), SilentProgress())
    (part,) = primitives_of(found.background, tmp_path)
    assert 0 < len(part.faces) <= 400
    note = json.loads((work.root / "view" / "meshes" / "artefact.json").read_text())["notes"]
    assert note == [f"background: {len(part.faces)} of 1800 triangles"]
