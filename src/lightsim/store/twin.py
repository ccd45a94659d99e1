"""Files of the twin for other programs: twin.json and glTF meshes that common viewers open."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lightsim.core.actors import ActorKind
from lightsim.core.mesh import SunVisibility, TriMesh
from lightsim.core.twin import ActorAsset, DigitalTwin, SceneAssets
from lightsim.errors import ArtefactError
from lightsim.store.arrays import ArrayFile, save_arrays
from lightsim.store.artefact import json_ready, write_json
from lightsim.store.assets import read_gains
from lightsim.store.entries import Entries
from lightsim.store.meshes import read_glb, write_glb
from lightsim.store.names import file_names, inside


def write_twin(folder: Path, twin: DigitalTwin, inferred: TriMesh) -> None:
    """Write twin.json, background.glb, inferred.glb and actors/<actor_id>.glb.

    twin.json names the file of each actor, since an id may not be a safe file name
    (store/names.py). A mesh with estimated visibility of the recorded sun has a further file,
    NAME.sun.npz.
    """
    _write_mesh(folder / "background.glb", twin.assets.background)
    if len(inferred.faces):
        write_glb(folder / "inferred.glb", inferred)
    (folder / "actors").mkdir(exist_ok=True)
    files = {a: f"actors/{name}.glb" for a, name in file_names(twin.assets.actors).items()}
    for actor_id, actor in twin.assets.actors.items():
        _write_mesh(inside(folder, files[actor_id]), actor.mesh)
    tracks = {track.actor_id: track for track in twin.log.actors}
    write_json(
        folder / "twin.json",
        {
            "log": twin.log.name,
            "frame": "world, metres, z up (glTF files are y up, as glTF requires)",
            "background": "background.glb",
            "background_faces": len(twin.assets.background.faces),
            "inferred": "inferred.glb" if len(inferred.faces) else None,
            "camera_gains": json_ready(dict(twin.assets.camera_gains)),
            "notes": list(twin.assets.notes),
            "actors": [
                {
                    "actor_id": a.actor_id,
                    "kind": a.kind,
                    "label": a.label,
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
    """Return the scene assets, and the mesh of unobserved occluders (empty if there are none).

    Raises:
        InputError, ArtefactError: a file is missing or damaged, or lies outside the folder.
    """
    value = Entries.of_file(folder / "twin.json")
    actors: dict[str, ActorAsset] = {}
    for entry in value.objects("actors"):
        actor_id = entry.text("actor_id")
        mesh = _read_mesh(inside(folder, entry.text("mesh")), "actor")
        kind = entry.member("kind", ActorKind)
        actors[actor_id] = ActorAsset(actor_id, kind, mesh, entry.text("label"))
    background = _read_mesh(inside(folder, value.text("background")), "world")
    inferred = empty_mesh()
    if not value.is_null("inferred"):
        inferred = read_glb(inside(folder, value.text("inferred")), "world")
    notes = value.texts("notes") if "notes" in value else ()
    return SceneAssets(background, actors, read_gains(value), notes), inferred


def _write_mesh(path: Path, mesh: TriMesh) -> None:
    """Write one mesh, and its sun visibility, which glTF cannot store, in a file beside it."""
    write_glb(path, mesh)
    found = mesh.sun_visibility
    if found is not None:
        arrays = {"vertex": found.vertex}
        if found.texel is not None:
            arrays["texel"] = found.texel
        save_arrays(path.with_suffix(".sun.npz"), arrays)


def _read_mesh(path: Path, frame: str) -> TriMesh:
    mesh = read_glb(path, frame)
    beside = path.with_suffix(".sun.npz")
    if not beside.exists():
        return mesh
    arrays = ArrayFile(beside)
    vertex = arrays.take("vertex", "u1", "n")
    texel = arrays.find("texel", "u1", "h w")
    size = None if mesh.texture is None else mesh.texture.image.shape[:2]
    # The mesh may have been replaced without its file of visibility.
    is_other = len(vertex) != len(mesh.vertices) or (texel is not None and texel.shape != size)
    if is_other:
        raise ArtefactError(
            "the sun's visibility belongs to another mesh", where=beside, remedy="Build again."
        )
    return replace(mesh, sun_visibility=SunVisibility(vertex, texel))


def empty_mesh() -> TriMesh:
    """Return a mesh without vertices and faces in frame `world`."""
    return TriMesh(
        "world",
        np.zeros((0, 3), np.float32),
        np.zeros((0, 3), np.int32),
        np.zeros((0, 3), np.float32),
    )
