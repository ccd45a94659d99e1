"""Assets from files, from the library, from other twins, and those that ship."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.render.rendering_scenes import box

from lightsim.core.actors import ActorKind
from lightsim.core.mesh import Material, TriMesh, concatenate_meshes
from lightsim.core.twin import ActorAsset
from lightsim.errors import InputError
from lightsim.scenario.asset_library import AssetLibrary, add_model
from lightsim.scenario.models import ModelSettings, read_model
from lightsim.scenario.orientation import Front
from lightsim.scenario.shipped_assets import shipped_assets
from lightsim.store.meshes import write_glb


def wedge(front: Front) -> TriMesh:
    """A body of 4 x 1.8 x 1.5 m with a low bonnet that looks to `front` of its file, off centre."""
    body = box((-0.6, 0, 0.75), (2.8, 1.8, 1.5), 0.3)
    bonnet = box((1.4, 0, 0.4), (1.2, 1.8, 0.8), 0.3)
    mesh = replace(concatenate_meshes([body, bonnet]), frame="actor")
    # In the file z is our -y.
    c, s = {"+x": (1, 0), "-x": (-1, 0), "+z": (0, -1), "-z": (0, 1)}[front]
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.float32)
    moved = mesh.vertices @ turn.T + np.array([3.0, -2.0, 0.5], np.float32)
    return replace(mesh, vertices=moved, materials=(Material(0.25, 0.5, "paint"),))


@pytest.mark.parametrize("front", ["+x", "-x", "+z", "-z"])
def test_a_models_front_is_found_by_its_bonnet(tmp_path: Path, front: Front) -> None:
    path = tmp_path / "model.glb"
    write_glb(path, wedge(front))
    for asked in ("auto", front):
        mesh = read_model(path, asked)
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        np.testing.assert_allclose([low, high], [[-2, -0.9, -0.75], [2, 0.9, 0.75]], atol=1e-5)
        assert mesh.vertices[mesh.vertices[:, 0] > 1.9][:, 2].max() < 0.1
        assert (mesh.material.roughness, mesh.material.metallic) == pytest.approx((0.25, 0.5))


def test_obj_files_and_other_units_are_read(tmp_path: Path) -> None:
    lines = ["v 0 0 0", "v 400 0 0", "v 400 150 0", "v 0 150 0", "v 0 0 180", "f 1 2 3", "f 1 3 5"]
    (tmp_path / "m.obj").write_text("\n".join(lines))
    with pytest.raises(InputError, match="metres-per-unit"):
        read_model(tmp_path / "m.obj")
    mesh = read_model(tmp_path / "m.obj", "+x", 0.01)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [4.0, 1.8, 1.5], atol=1e-5)


def test_what_is_added_can_be_listed_and_loaded(tmp_path: Path) -> None:
    write_glb(tmp_path / "van.glb", wedge("-x"))
    library = AssetLibrary(tmp_path / "library", {})
    settings = ModelSettings(length_m=5.0)
    info, _ = add_model(library, tmp_path / "van.glb", "my-van", settings, kind=ActorKind.TRUCK)
    assert info.size_lwh_m == pytest.approx((5.0, 2.25, 1.875))
    assert [i.name for i in library.infos()] == ["my-van"]
    asset = library.load("my-van")
    assert (asset.kind, asset.mesh.frame) == (ActorKind.TRUCK, "actor")
    assert library.key("my-van") != library.key("other")
    with pytest.raises(InputError, match="overwrite"):
        library.add("my-van", asset, "again")
    with pytest.raises(InputError, match="my-van"):
        library.load("nothing")
    beside = AssetLibrary(tmp_path / "library", {}, beside=tmp_path)
    assert len(beside.load("van.glb").mesh.faces) == 24


def test_a_file_is_read_once_and_anew_when_it_is_replaced(tmp_path: Path) -> None:
    write_glb(tmp_path / "van.glb", wedge("-x"))
    library = AssetLibrary(tmp_path / "library", {}, beside=tmp_path)
    assert library.load("van.glb") is library.load("van.glb")
    for length_m in (5.0, 4.0):
        settings = ModelSettings(length_m=length_m)
        add_model(library, tmp_path / "van.glb", "van", settings, is_replacing=True)
        assert np.ptp(library.load("van").mesh.vertices[:, 0]) == pytest.approx(length_m)


def test_what_ships_stands_in_the_middle_of_its_box_and_looks_outwards() -> None:
    for name, asset in shipped_assets().items():
        mesh = asset.mesh
        np.testing.assert_allclose(
            mesh.vertices.min(axis=0), -mesh.vertices.max(axis=0), atol=1e-5, err_msg=name
        )
        assert ((mesh.base_colour > 0) & (mesh.base_colour <= 0.81)).all()
        # Faces look outwards: by the divergence theorem their volume is positive.
        a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
        assert np.einsum("nc,nc->n", a, np.cross(b, c)).sum() > 0, name
    assert isinstance(shipped_assets()["cone"], ActorAsset)
