"""Assets between stages: everything comes back, textures as half floats."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightsim.core.actors import ActorKind
from lightsim.core.mesh import Material, Texture, TriMesh
from lightsim.core.twin import ActorAsset, SceneAssets
from lightsim.store.assets import read_assets, write_assets


def _mesh(frame: str, rng: np.random.Generator) -> TriMesh:
    faces = rng.permuted(np.tile(np.arange(9, dtype=np.int32), (5, 1)), axis=1)[:, :3]
    image = rng.uniform(0, 4, (7, 11, 3)).astype(np.float16).astype(np.float32)
    return TriMesh(
        frame,
        rng.random((9, 3)).astype(np.float32),
        np.ascontiguousarray(faces),
        rng.random((9, 3)).astype(np.float32),
        (Material(0.3, 0.4, "car paint"), Material(0.05, 0.0, "glass")),
        np.array([0, 1, 1, 0, 1], dtype=np.uint8),
        Texture(image, rng.uniform(0, 7, (5, 3, 2)).astype(np.float32)),
        rng.random(9).astype(np.float32),
        np.arange(5, dtype=np.uint8),
    )


def test_assets_come_back(tmp_path: Path, rng: np.random.Generator) -> None:
    actor = ActorAsset("car-1", ActorKind.CAR, _mesh("actor", rng), "Car")
    gains = {"front": np.array([1.0, 0.9, 1.1], np.float32)}
    assets = SceneAssets(_mesh("world", rng), {"car-1": actor}, gains, ("one default shape",))
    write_assets(tmp_path, assets)
    back = read_assets(tmp_path)
    assert back.notes == assets.notes
    np.testing.assert_array_equal(back.camera_gains["front"], gains["front"])
    assert back.actors["car-1"].kind is ActorKind.CAR
    assert back.actors["car-1"].label == "Car"
    pairs = [(back.background, assets.background), (back.actors["car-1"].mesh, actor.mesh)]
    names = (
        "vertices", "faces", "base_colour", "face_material", "confidence", "face_provenance",
    )  # fmt: skip
    for mesh, expected in pairs:
        for name in names:
            np.testing.assert_array_equal(getattr(mesh, name), getattr(expected, name))
        assert mesh.materials == expected.materials
        assert mesh.frame == expected.frame
        assert mesh.texture is not None
        assert expected.texture is not None
        np.testing.assert_array_equal(mesh.texture.image, expected.texture.image)
        np.testing.assert_array_equal(mesh.texture.corner_uv, expected.texture.corner_uv)
