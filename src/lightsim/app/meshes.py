"""Meshes of the viewer: the twin within a limit of triangles, made once as WORK/view/meshes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lightsim.app.glb import mesh_glb
from lightsim.appearance.colour import colour_of_nearest
from lightsim.build.sources import stage_sources
from lightsim.build.workspace import Workspace
from lightsim.core.mesh import TriMesh
from lightsim.geometry.simplify import simplify
from lightsim.progress import Progress
from lightsim.store.artefact import ArtefactKey, make_artefact, state_of
from lightsim.store.lock import LOCK_NAME, locked
from lightsim.store.names import file_names

MAX_TRIANGLES = 200_000
"""Most triangles of the static scene. A browser without a graphics card draws 203,522 of them with
shadows at 1.8 frames/s and 64,296 without shadows at 22 (two cores, SwiftShader)."""
MAX_ASSET_TRIANGLES = 50_000
"""Most triangles of one actor. Reconstructed vehicles have 2,000 to 4,000, CAD models may have
millions. Chosen."""
FOLDER = Path("view") / "meshes"
"""The artefact, relative to the work folder."""
# First and largest RMS error of the simplification, in metres; each attempt doubles it. Chosen;
# sensitivity not measured.
_FIRST_ERROR_M, _LARGEST_ERROR_M = 0.01, 0.64
# Longest edge after simplification, in multiples of the error: colours vary along edges of 0.5 m
# and more at the first error. Chosen; sensitivity not measured.
_EDGE_PER_ERROR = 50.0


@dataclass(frozen=True, eq=False)
class ViewMeshes:
    """Binary glTF files of a twin, z up.

    Args:
        background: static scene, frame `world`.
        inferred: unobserved surfaces that cast shadows, frame `world`; None if there are none.
        glb_by_actor: each reconstructed actor, frame `actor`.
    """

    background: bytes
    inferred: bytes | None
    glb_by_actor: Mapping[str, bytes]


def view_meshes(workspace: Workspace, progress: Progress) -> ViewMeshes:
    """Return the meshes of a twin, made at the first call and read from WORK/view/meshes later.

    Raises:
        ArtefactError: the twin has not been built, or another command makes the meshes.
    """
    folder = workspace.root / FOLDER
    inputs = {"twin": workspace.record("twin")["key"]}
    key = ArtefactKey("view", stage_sources(_write, is_first=False), {}, inputs, 0)
    if state_of(folder, key, is_hashed=True) != "made":
        folder.parent.mkdir(exist_ok=True)
        with locked(folder.parent / LOCK_NAME):
            make_artefact(folder, key, partial(_write, workspace=workspace, progress=progress))
    return _read(folder, workspace)


def asset_glb(mesh: TriMesh) -> bytes:
    """Return an actor as binary glTF of at most `MAX_ASSET_TRIANGLES`, frame `actor`, z up.

    Raises:
        InputError: the mesh has no face.
    """
    return mesh_glb(decimated(mesh, MAX_ASSET_TRIANGLES))


def static_meshes(workspace: Workspace) -> tuple[TriMesh, TriMesh]:
    """Return background and unobserved surfaces, of at most `MAX_TRIANGLES` together."""
    inferred = decimated(workspace.unobserved_occluders, MAX_TRIANGLES // 2)
    background = workspace.twin.assets.background
    return decimated(background, MAX_TRIANGLES - len(inferred.faces)), inferred


def decimated(mesh: TriMesh, max_triangles: int) -> TriMesh:
    """Return the mesh with at most `max_triangles` faces; unchanged if it has no more.

    The error bound of the simplification doubles until the mesh is small enough. If it never is,
    as with many separate pieces, the largest faces remain. The result has vertex colours.
    """
    if len(mesh.faces) <= max_triangles:
        return mesh
    small, error_m = mesh, _FIRST_ERROR_M
    while len(small.faces) > max_triangles and error_m <= _LARGEST_ERROR_M:
        count = len(small.vertices)
        errors, edges = np.full(count, error_m), np.full(count, _EDGE_PER_ERROR * error_m)
        small, error_m = simplify(small, errors, edges), 2 * error_m
    coloured = colour_of_nearest(small, mesh)
    if len(coloured.faces) <= max_triangles:
        return coloured
    return _with_faces(coloured, np.argsort(-coloured.face_areas_m2())[:max_triangles])


def _with_faces(mesh: TriMesh, faces: np.ndarray) -> TriMesh:
    used, index = np.unique(mesh.faces[faces], return_inverse=True)
    material = None if mesh.face_material is None else mesh.face_material[faces]
    return TriMesh(
        mesh.frame,
        mesh.vertices[used],
        index.reshape(-1, 3).astype(np.int32),
        mesh.base_colour[used],
        mesh.materials,
        material,
    )


def _write(folder: Path, workspace: Workspace, progress: Progress) -> Iterable[str]:
    """Write background.glb, inferred.glb and actors/NAME.glb; return notes."""
    assets = workspace.twin.assets
    background, inferred = static_meshes(workspace)
    (folder / "background.glb").write_bytes(mesh_glb(background))
    if len(inferred.faces):
        (folder / "inferred.glb").write_bytes(mesh_glb(inferred))
    (folder / "actors").mkdir(exist_ok=True)
    names = file_names(assets.actors)
    actors = assets.actors.items()
    for actor_id, actor in progress.track(actors, "meshes of the viewer", len(actors)):
        if len(actor.mesh.faces):
            path = folder / "actors" / f"{names[actor_id]}.glb"
            path.write_bytes(asset_glb(actor.mesh))
    if background is assets.background:
        return ()
    return (f"background: {len(background.faces)} of {len(assets.background.faces)} triangles",)


def _read(folder: Path, workspace: Workspace) -> ViewMeshes:
    names = file_names(workspace.twin.assets.actors)
    paths = {actor_id: folder / "actors" / f"{name}.glb" for actor_id, name in names.items()}
    inferred = folder / "inferred.glb"
    return ViewMeshes(
        (folder / "background.glb").read_bytes(),
        inferred.read_bytes() if inferred.exists() else None,
        {actor_id: path.read_bytes() for actor_id, path in paths.items() if path.exists()},
    )
