"""Scene assets on disk between the stages: full-precision meshes in npz, gains in JSON."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightsim.core.mesh import Material, TriMesh
from lightsim.core.twin import ActorAsset, SceneAssets
from lightsim.errors import ArtefactError
from lightsim.store.arrays import load_arrays, save_arrays
from lightsim.store.artefact import json_ready, read_json, write_json


def write_mesh(path: Path, mesh: TriMesh) -> None:
    """One mesh as npz, without loss."""
    material = np.array([mesh.material.roughness, mesh.material.metallic])
    save_arrays(
        path,
        {
            "vertices": mesh.vertices,
            "faces": mesh.faces,
            "base_colour": mesh.base_colour,
            "material": material,
        },
    )


def read_mesh(path: Path, frame: str) -> TriMesh:
    """A mesh written by `write_mesh`.

    Raises:
        ArtefactError: an array is missing.
    """
    arrays = load_arrays(path)
    try:
        roughness, metallic = (float(v) for v in arrays["material"])
        return TriMesh(
            frame,
            arrays["vertices"],
            arrays["faces"],
            arrays["base_colour"],
            (Material(roughness, metallic),),
        )
    except KeyError as error:
        raise ArtefactError("an array of the mesh is missing", where=path, got=error) from error


def write_assets(folder: Path, assets: SceneAssets) -> None:
    write_mesh(folder / "background.npz", assets.background)
    (folder / "actors").mkdir(exist_ok=True)
    for actor in assets.actors.values():
        write_mesh(folder / "actors" / f"{actor.actor_id}.npz", actor.mesh)
    write_json(
        folder / "assets.json",
        {
            "camera_gains": json_ready(dict(assets.camera_gains)),
            "actors": [
                {"actor_id": a.actor_id, "kind": a.kind, "faces": len(a.mesh.faces)}
                for a in assets.actors.values()
            ],
        },
    )


def read_assets(folder: Path) -> SceneAssets:
    """The assets written by `write_assets`."""
    value = read_json(folder / "assets.json")
    actors = {
        entry["actor_id"]: ActorAsset(
            entry["actor_id"],
            entry["kind"],
            read_mesh(folder / "actors" / f"{entry['actor_id']}.npz", "actor"),
        )
        for entry in value["actors"]
    }
    gains = {name: np.array(g, np.float32) for name, g in value["camera_gains"].items()}
    return SceneAssets(read_mesh(folder / "background.npz", "world"), actors, gains)
