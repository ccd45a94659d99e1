"""The twin for the world outside: twin.json and glTF meshes that any viewer opens."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lightsim.core.mesh import TriMesh
from lightsim.core.twin import ActorAsset, DigitalTwin, SceneAssets
from lightsim.errors import ArtefactError
from lightsim.store.artefact import json_ready, read_json, write_json
from lightsim.store.meshes import read_glb, write_glb
from lightsim.store.names import file_names, inside


def write_twin(folder: Path, twin: DigitalTwin, inferred: TriMesh) -> None:
    """twin.json, background.glb, inferred.glb and actors/<actor_id>.glb (store/names.py where the
    id is no file name; twin.json names the file of each actor)."""
    write_glb(folder / "background.glb", twin.assets.background)
    if len(inferred.faces):
        write_glb(folder / "inferred.glb", inferred)
    (folder / "actors").mkdir(exist_ok=True)
    files = {a: f"actors/{name}.glb" for a, name in file_names(twin.assets.actors).items()}
    for actor_id, actor in twin.assets.actors.items():
        write_glb(inside(folder, files[actor_id]), actor.mesh)
    tracks = {track.actor_id: track for track in twin.log.actors}
    write_json(
        folder / "twin.json",
        {
            "log": twin.log.name,
            "frame": "world, metres, z up (glTF files are y up, as glTF asks)",
            "background": "background.glb",
            "background_faces": len(twin.assets.background.faces),
            "inferred": "inferred.glb" if len(inferred.faces) else None,
            "camera_gains": json_ready(dict(twin.assets.camera_gains)),
            "notes": list(twin.assets.notes),
            "actors": [
                {
                    "actor_id": a.actor_id,
                    "kind": a.kind,
                    "mesh": files[a.actor_id],
                    "size_lwh_m": tracks[a.actor_id].size_lwh_m.tolist(),
                    "is_moving": tracks[a.actor_id].is_moving,
                    "times_ns": tracks[a.actor_id].trajectory.times_ns.tolist(),
                    "world_from_actor": tracks[a.actor_id].trajectory.matrices.tolist(),
                }
                for a in twin.assets.actors.values()
            ],
        },
    )


def read_twin_assets(folder: Path) -> tuple[SceneAssets, TriMesh]:
    """Meshes with base colour, gains, and the inferred shadow casters (empty if none).

    Raises:
        ArtefactError: twin.json is broken, or names a file outside the folder.
    """
    value = read_json(folder / "twin.json")

    def read(name: Any, frame: str) -> TriMesh:
        return read_glb(inside(folder, name), frame)

    try:
        actors = {
            a["actor_id"]: ActorAsset(a["actor_id"], a["kind"], read(a["mesh"], "actor"))
            for a in value["actors"]
        }
        gains = {name: np.array(g, np.float32) for name, g in value["camera_gains"].items()}
        background = read(value["background"], "world")
        inferred = value["inferred"]
        casters = empty_mesh() if inferred is None else read(inferred, "world")
        notes = tuple(value["notes"]) if "notes" in value else ()
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ArtefactError(
            "the twin's list of files is broken",
            where=folder / "twin.json",
            got=error,
            remedy="Build again.",
        ) from error
    return SceneAssets(background, actors, gains, notes), casters


def empty_mesh() -> TriMesh:
    return TriMesh(
        "world",
        np.zeros((0, 3), np.float32),
        np.zeros((0, 3), np.int32),
        np.zeros((0, 3), np.float32),
    )
