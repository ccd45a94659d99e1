"""Scene assets on disk between the stages: meshes in npz, gains in JSON."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightsim.core.mesh import Material, Texture, TriMesh
from lightsim.core.twin import ActorAsset, SceneAssets
from lightsim.errors import ArtefactError
from lightsim.store.arrays import load_arrays, save_arrays
from lightsim.store.artefact import json_ready, read_json, write_json

_HALF_MAX = np.float32(65504.0)


def write_mesh(path: Path, mesh: TriMesh) -> None:
    """One mesh as npz, without loss but for textures, which are stored as half floats."""
    materials = mesh.materials
    arrays = {
        "vertices": mesh.vertices,
        "faces": mesh.faces,
        "base_colour": mesh.base_colour,
        "material": np.array([[m.roughness, m.metallic] for m in materials]),
        "material_name": np.array([m.name for m in materials]),
    }
    if mesh.face_material is not None:
        arrays["face_material"] = mesh.face_material
    if mesh.confidence is not None:
        arrays["confidence"] = mesh.confidence
    if mesh.texture is not None:
        arrays["texture"] = np.minimum(mesh.texture.image, _HALF_MAX).astype(np.float16)
        arrays["corner_uv"] = mesh.texture.corner_uv
    save_arrays(path, arrays)


def read_mesh(path: Path, frame: str) -> TriMesh:
    """A mesh written by `write_mesh`.

    Raises:
        ArtefactError: an array is missing.
    """
    arrays = load_arrays(path)
    try:
        numbers = arrays["material"].reshape(-1, 2).tolist()
        # Files of older versions have one material, without name.
        names = arrays["material_name"].tolist() if "material_name" in arrays else ["matte"]
        texture = None
        if "texture" in arrays:
            texture = Texture(arrays["texture"].astype(np.float32), arrays["corner_uv"])
        return TriMesh(
            frame,
            arrays["vertices"],
            arrays["faces"],
            arrays["base_colour"],
            tuple(
                Material(float(roughness), float(metallic), str(name))
                for (roughness, metallic), name in zip(numbers, names, strict=True)
            ),
            arrays.get("face_material"),
            texture,
            arrays.get("confidence"),
        )
    except KeyError as error:
        raise ArtefactError(
            "an array of the mesh is missing", where=path, got=error, remedy="Build again."
        ) from error


def write_assets(folder: Path, assets: SceneAssets) -> None:
    write_mesh(folder / "background.npz", assets.background)
    (folder / "actors").mkdir(exist_ok=True)
    for actor in assets.actors.values():
        write_mesh(folder / "actors" / f"{actor.actor_id}.npz", actor.mesh)
    write_json(
        folder / "assets.json",
        {
            "camera_gains": json_ready(dict(assets.camera_gains)),
            "notes": list(assets.notes),
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
    notes = tuple(value["notes"]) if "notes" in value else ()
    return SceneAssets(read_mesh(folder / "background.npz", "world"), actors, gains, notes)
