"""Transparent surfaces: masks are cut, panes become dark glass, invisible ones go."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gltf_files import QUAD_UV, GltfBuilder, disc_picture
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.mesh import CAR_GLASS, CAR_GLASS_COLOUR, TriMesh
from lightsim.errors import InputError
from lightsim.store import primitive_mesh
from lightsim.store.gltf import read_gltf
from lightsim.store.primitive_mesh import mesh_of

GREEN = linear_from_srgb8(np.array([0, 128, 0], np.uint8))


def quad(pixels: Any = None, factor: Any = (1, 1, 1, 1), **material: Any) -> GltfBuilder:
    builder = GltfBuilder()
    pbr: dict[str, Any] = {"metallicFactor": 0, "baseColorFactor": list(factor)}
    if pixels is not None:
        pbr["baseColorTexture"] = builder.texture(pixels)
    builder.quad({"name": "leaf", "pbrMetallicRoughness": pbr, **material})
    return builder


def read(builder: GltfBuilder, folder: Path, edge_m: float = 0.06) -> tuple[TriMesh, list[str]]:
    mesh, notes = mesh_of(read_gltf(builder.write(folder / "a.glb")), texture_edge_m=edge_m)
    return mesh, list(notes)


@pytest.mark.parametrize("mode", ["MASK", "BLEND"])
def test_a_disc_is_cut_along_its_contour(tmp_path: Path, mode: str) -> None:
    """Of the disc's area within half a percent, without the colour that alpha hides, without
    cracks."""
    mesh, notes = read(quad(disc_picture(), alphaMode=mode), tmp_path)
    assert mesh.face_areas_m2().sum() == pytest.approx(np.pi * 0.4**2, rel=5e-3)
    radius = np.linalg.norm(mesh.vertices[:, [0, 2]] - 0.5, axis=1)
    assert radius.max() < 0.4 + 1 / 64
    np.testing.assert_allclose(mesh.base_colour, [GREEN] * len(mesh.vertices), atol=1e-4)
    edges = np.sort(np.concatenate([mesh.faces[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    assert count.max() == 2
    assert (radius[unique[count == 1]] > 0.4 - 1 / 64).all()
    assert (mesh.face_normals()[:, 1] < 0).all()
    expected = (
        [] if mode == "MASK" else ["blended surfaces are cut where their alpha is 0.5 (leaf)"]
    )
    assert notes == expected


def test_a_hole_lets_rays_through(tmp_path: Path) -> None:
    """The same picture with its alpha turned: a square with a round hole."""
    pixels = disc_picture()
    pixels[..., 3] = 255 - pixels[..., 3]
    mesh, _ = read(quad(pixels, alphaMode="MASK"), tmp_path)
    assert mesh.face_areas_m2().sum() == pytest.approx(1 - np.pi * 0.4**2, rel=5e-3)
    middles = mesh.vertices[mesh.faces].mean(axis=1)[:, [0, 2]] - 0.5
    assert np.linalg.norm(middles, axis=1).min() > 0.4 - 1 / 64


@pytest.mark.parametrize(
    ("mode", "factor", "expected"),
    [
        ("OPAQUE", [0.6, 0.1, 0.1, 0.0], "paint"), ("MASK", [0.6, 0.1, 0.1, 0.6], "paint"),
        ("BLEND", [0.6, 0.1, 0.1, 1.0], "paint"), ("BLEND", [0.6, 0.1, 0.1, 0.9], "noted paint"),
        ("BLEND", [1, 1, 1, 0.1], "glass"), ("BLEND", [0.2, 0.2, 0.2, 0.7], "glass"),
        ("BLEND", [0.8, 0.0, 0.0, 0.5], "red glass"), ("BLEND", [1, 1, 1, 0.01], "nothing"),
        ("MASK", [0.6, 0.1, 0.1, 0.4], "nothing"),
    ],
)  # fmt: skip
def test_even_alpha(tmp_path: Path, mode: str, factor: list[float], expected: str) -> None:
    builder = quad(None, factor, alphaMode=mode)
    if expected == "nothing":
        with pytest.raises(InputError, match=r"a\.glb: the model has no visible surface"):
            read(builder, tmp_path)
        return
    mesh, notes = read(builder, tmp_path)
    if "glass" in expected:
        assert mesh.material == CAR_GLASS
        dark = np.array(CAR_GLASS_COLOUR)
        wanted = dark + 0.5 * (np.array(factor[:3]) - dark) if "red" in expected else dark
        np.testing.assert_allclose(mesh.base_colour[0], wanted, atol=1e-6)
        assert notes == ["transparent surfaces are read as dark glass (leaf)"]
    else:
        assert mesh.material.name == "leaf"
        np.testing.assert_allclose(mesh.base_colour[0], factor[:3], atol=1e-6)
        assert len(notes) == expected.startswith("noted")


def test_invisible_parts_are_left_out_and_noted(tmp_path: Path) -> None:
    builder = quad()
    pbr = {"baseColorFactor": [1, 1, 1, 0], "metallicFactor": 0}
    builder.quad({"name": "ghost", "alphaMode": "BLEND", "pbrMetallicRoughness": pbr})
    mesh, notes = read(builder, tmp_path)
    assert len(mesh.faces) == 2
    assert notes == ["invisible surfaces are left out (ghost)"]


@pytest.mark.parametrize(("transmission", "name"), [(1.0, "glass"), (0.3, "leaf")])
def test_transmission(tmp_path: Path, transmission: float, name: str) -> None:
    extension = {"KHR_materials_transmission": {"transmissionFactor": transmission}}
    mesh, notes = read(quad(extensions=extension), tmp_path)
    assert mesh.material.name == name
    assert len(notes) == 1


def test_an_atlas_with_paint_panes_and_holes(tmp_path: Path) -> None:
    """One blended picture for all of a car: a third opaque, a third of alpha 0.3, a third empty."""
    pixels = np.full((30, 30, 4), [200, 0, 0, 255], np.uint8)
    pixels[10:20] = [90, 90, 90, 77]
    pixels[20:, :, 3] = 0
    mesh, notes = read(quad(pixels, alphaMode="BLEND"), tmp_path, 0.03)
    area, middle = mesh.face_areas_m2(), mesh.vertices[mesh.faces].mean(axis=1)[:, 2]
    assert mesh.face_material is not None
    is_glass = np.array([m.name == "glass" for m in mesh.materials])[mesh.face_material]
    assert area[is_glass].sum() == pytest.approx(1 / 3, abs=0.05)
    assert area[~is_glass].sum() == pytest.approx(1 / 3, abs=0.05)
    assert middle[~is_glass].min() > 0.6
    assert len(notes) == 2


def test_vertex_alpha_is_cut_too(tmp_path: Path) -> None:
    """Alpha from 0 at the left to 1 at the right."""
    builder = quad(alphaMode="MASK", alphaCutoff=0.25)
    value = builder.document["meshes"][0]["primitives"][0]
    colours = [[1, 1, 1, alpha] for alpha in (0, 1, 1, 0)]
    value["attributes"]["COLOR_0"] = builder.accessor(colours)
    mesh, _ = read(builder, tmp_path)
    assert mesh.vertices[:, 0].min() == pytest.approx(0.25, abs=1e-6)
    assert mesh.face_areas_m2().sum() == pytest.approx(0.75, abs=1e-6)


def test_faces_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disc repeated a thousand times has more contour than faces may be: what is left lets as
    much light through, and has no colour that alpha hides."""
    monkeypatch.setattr(primitive_mesh, "_MAX_FACES", 20_000)
    builder = quad(disc_picture(), alphaMode="MASK")
    value = builder.document["meshes"][0]["primitives"][0]
    value["attributes"]["TEXCOORD_0"] = builder.accessor(QUAD_UV * 987.6)
    mesh, (note,) = read(builder, tmp_path, 0.01)
    assert 1000 < len(mesh.faces) <= 40_000
    assert note == "textures and contours are coarser than requested, within 20000 faces"
    assert mesh.face_areas_m2().sum() == pytest.approx(np.pi * 0.4**2, rel=0.02)
    np.testing.assert_allclose(mesh.base_colour, [GREEN] * len(mesh.vertices), atol=1e-4)
