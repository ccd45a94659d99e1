"""Scene assets on disk between the stages: meshes in npz, gains in JSON."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.core.mesh import Material, Texture, TriMesh
from lightsim.core.twin import ActorAsset, SceneAssets
from lightsim.errors import ArtefactError
from lightsim.store.arrays import load_arrays, save_arrays
from lightsim.store.artefact import json_ready, read_json, write_json
from lightsim.store.names import file_names, inside

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
        raise ArtefactError("an array of the mesh is missing", where=path, got=error) from error


def write_assets(folder: Path, assets: SceneAssets) -> None:
    """background.npz, assets.json, and a file for each actor, which assets.json names."""
    write_mesh(folder / "background.npz", assets.background)
    (folder / "actors").mkdir(exist_ok=True)
    files = {a: f"actors/{name}.npz" for a, name in file_names(assets.actors).items()}
    for actor_id, actor in assets.actors.items():
        write_mesh(inside(folder, files[actor_id]), actor.mesh)
    write_json(
        folder / "assets.json",
        {
            "camera_gains": json_ready(dict(assets.camera_gains)),
            "notes": list(assets.notes),
            "actors": [
                {
                    "actor_id": actor_id,
                    "kind": actor.kind,
                    "mesh": files[actor_id],
                    "faces": len(actor.mesh.faces),
                }
                for actor_id, actor in assets.actors.items()
            ],
        },
    )


def read_assets(folder: Path) -> SceneAssets:
    """The assets written by `write_assets`.

    Raises:
        ArtefactError: a file is missing or broken, or leads out of the folder.
    """
    value = read_json(folder / "assets.json")
    try:
        actors = {entry["actor_id"]: _read_actor(folder, entry) for entry in value["actors"]}
        gains = {name: np.array(g, np.float32) for name, g in value["camera_gains"].items()}
        notes = tuple(value["notes"]) if "notes" in value else ()
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ArtefactError(
            "the list of assets is broken",
            where=folder / "assets.json",
            got=error,
            remedy="Build again.",
        ) from error
    return SceneAssets(read_mesh(folder / "background.npz", "world"), actors, gains, notes)


def _read_actor(folder: Path, entry: Mapping[str, Any]) -> ActorAsset:
    actor_id = entry["actor_id"]
    # Older versions named the file by the id and did not say so.
    file = entry.get("mesh", f"actors/{actor_id}.npz")
    return ActorAsset(actor_id, entry["kind"], read_mesh(inside(folder, file), "actor"))
