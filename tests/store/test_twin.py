"""A hostile twin or log writes and reads nothing outside the artefact's folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import gettempdir

import numpy as np
import pytest

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.alignment import Alignment
from lightsim.core.dome import SkyDome
from lightsim.core.frames import Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import SunVisibility, Texture, TriMesh
from lightsim.core.twin import ActorAsset, DigitalTwin, SceneAssets, SkyEstimate
from lightsim.errors import ArtefactError
from lightsim.store.alignment import read_alignment, write_alignment
from lightsim.store.arrays import save_arrays
from lightsim.store.artefact import read_json, write_json
from lightsim.store.assets import read_assets, write_assets
from lightsim.store.twin import empty_mesh, read_twin_assets, write_twin

HOSTILE = (
    "../../../x",
    f"{gettempdir()}/lightsim-escaped",
    "a" * 300,
    "..",
    "Car",
    "car",
    "x.npy",
    "x",
)


def _triangle(frame: str) -> TriMesh:
    corners = np.eye(3, dtype=np.float32)
    faces = np.arange(3, dtype=np.int32)[None]
    return TriMesh(frame, corners, faces, np.full((3, 3), 0.5, np.float32))


def _hostile_assets() -> SceneAssets:
    actors = {a: ActorAsset(a, ActorKind.CAR, _triangle("actor")) for a in HOSTILE}
    gains = {"front_camera": np.ones(3, np.float32)}
    return SceneAssets(_triangle("world"), actors, gains)


def _twin(assets: SceneAssets) -> DigitalTwin:
    times_ns, matrices = np.array([0, 10], dtype=np.int64), np.tile(np.eye(4), (2, 1, 1))
    path = Trajectory("world", "actor", times_ns, matrices)
    size = np.array([4.0, 2.0, 1.5])
    tracks = tuple(ActorTrack(a, ActorKind.CAR, size, path, False) for a in assets.actors)
    ego = Trajectory("world", "ego", times_ns, matrices)
    log = DrivingLog("log", {}, (), (), ego, tracks, None, {})
    dome = SkyDome(np.ones((2, 4, 3), np.float32), None)
    sky = SkyEstimate(dome, None, 10.0, "image", 1.0, 1.0, np.ones(3, np.float32), 0.1)
    return DigitalTwin(log, assets, sky)


def _written(root: Path) -> set[Path]:
    return {p for p in root.rglob("*") if p.is_file()}


@pytest.mark.parametrize("kind", ["assets", "twin"])
def test_hostile_ids_stay_inside_and_come_back(tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "a" / "b" / "artefact"
    folder.mkdir(parents=True)
    assets = _hostile_assets()
    if kind == "assets":
        write_assets(folder, assets)
        back = read_assets(folder)
    else:
        write_twin(folder, _twin(assets), empty_mesh())
        back, _ = read_twin_assets(folder)
    assert list(back.actors) == list(HOSTILE)
    assert len(list((folder / "actors").iterdir())) == len(HOSTILE)
    assert all(p.is_relative_to(folder) for p in _written(tmp_path))
    assert not list(Path("/tmp").glob("lightsim-escaped*"))


@pytest.mark.parametrize("name", ["../../x.glb", "/etc/passwd.glb"])
def test_files_that_our_own_json_names_lie_inside(tmp_path: Path, name: str) -> None:
    write_twin(tmp_path, _twin(_hostile_assets()), empty_mesh())
    value = read_json(tmp_path / "twin.json")
    value["actors"][0]["mesh"] = name
    write_json(tmp_path / "twin.json", value)
    with pytest.raises(ArtefactError, match="leads out of its folder"):
        read_twin_assets(tmp_path)
    write_assets(tmp_path, _hostile_assets())
    value = read_json(tmp_path / "assets.json")
    value["actors"][0]["mesh"] = name
    write_json(tmp_path / "assets.json", value)
    with pytest.raises(ArtefactError, match="leads out of its folder"):
        read_assets(tmp_path)


def test_a_list_of_files_that_is_broken_says_so(tmp_path: Path) -> None:
    write_twin(tmp_path, _twin(_hostile_assets()), empty_mesh())
    for broken in ({}, [], {"actors": [{}], "camera_gains": {}}):
        write_json(tmp_path / "twin.json", broken)
        with pytest.raises(ArtefactError, match=r"twin\.json.*Build again"):
            read_twin_assets(tmp_path)


def test_the_alignment_of_hostile_ids_comes_back(tmp_path: Path) -> None:
    actors = {a: np.eye(4)[None] * (i + 1) for i, a in enumerate(HOSTILE)}
    write_alignment(tmp_path, Alignment(None, actors=actors))
    back = read_alignment(tmp_path).actors
    assert list(back) == list(HOSTILE)
    for actor_id, matrices in actors.items():
        np.testing.assert_array_equal(back[actor_id], matrices)


def test_the_visibility_of_the_sun_comes_back_and_belongs_to_its_mesh(tmp_path: Path) -> None:
    """Of a car that was always parked; one that drove has none."""
    texel = np.arange(35, dtype=np.uint8).reshape(5, 7)
    texture = Texture(np.full((5, 7, 3), 0.5, np.float32), np.zeros((1, 3, 2), np.float32) + 2.5)
    found = SunVisibility(np.array([0, 128, 255], np.uint8), texel)
    background = replace(_triangle("world"), texture=texture, sun_visibility=found)
    parked = replace(_triangle("actor"), sun_visibility=SunVisibility(found.vertex))
    actors = {
        name: ActorAsset(name, ActorKind.CAR, mesh)
        for name, mesh in (("parked", parked), ("driving", _triangle("actor")))
    }
    assets = SceneAssets(background, actors, {"front_camera": np.ones(3, np.float32)})
    (tmp_path / "twin").mkdir()
    write_twin(tmp_path / "twin", _twin(assets), empty_mesh())
    back, _ = read_twin_assets(tmp_path / "twin")
    assert back.background.sun_visibility is not None
    np.testing.assert_array_equal(back.background.sun_visibility.vertex, found.vertex)
    np.testing.assert_array_equal(back.background.sun_visibility.texel, texel)
    middle = np.full((1, 3), 1 / 3)
    face = np.zeros(1, np.int64)
    np.testing.assert_allclose(back.background.sun_visibility_at(face, middle), texel[2, 2] / 255)
    np.testing.assert_allclose(
        back.actors["parked"].mesh.sun_visibility_at(face, middle), 383 / 3 / 255, rtol=1e-5
    )
    assert np.isnan(back.actors["driving"].mesh.sun_visibility_at(face, middle)).all()
    save_arrays(tmp_path / "twin" / "background.sun.npz", {"vertex": found.vertex[:2]})
    with pytest.raises(ArtefactError, match="another mesh"):
        read_twin_assets(tmp_path / "twin")
