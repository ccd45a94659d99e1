"""The artefact WORK/view/meshes: the viewer's meshes with the light of the recorded sky."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path

from lightsim.app.baked import LightTracer
from lightsim.app.meshes import ViewMeshes
from lightsim.build.sources import stage_sources
from lightsim.build.workspace import Workspace
from lightsim.progress import Progress
from lightsim.store.artefact import ArtefactKey, make_artefact, state_of
from lightsim.store.lock import LOCK_NAME, locked
from lightsim.store.names import file_names

FOLDER = Path("view") / "meshes"
"""The artefact, relative to the work folder."""


def view_meshes(tracer: LightTracer, progress: Progress) -> ViewMeshes:
    """Return the meshes of a twin in the light of the log's first frame.

    They are made at the first call and read from WORK/view/meshes later.

    Raises:
        ArtefactError: the twin has not been built, or another command makes the meshes.
    """
    workspace = tracer.workspace
    folder = workspace.root / FOLDER
    inputs = {"twin": workspace.record("twin")["key"]}
    key = ArtefactKey("view", stage_sources(_write, is_first=False), {}, inputs, 0)
    if state_of(folder, key, is_hashed=True) != "made":
        folder.parent.mkdir(exist_ok=True)
        with locked(folder.parent / LOCK_NAME):
            make_artefact(folder, key, partial(_write, tracer=tracer, progress=progress))
    return _read(folder, workspace)


def _write(folder: Path, tracer: LightTracer, progress: Progress) -> Iterable[str]:
    """Write background.glb, inferred.glb and actors/NAME.glb; return notes."""
    workspace = tracer.workspace
    meshes = tracer.recorded(workspace.log.frames, progress)
    (folder / "background.glb").write_bytes(meshes.background)
    if meshes.inferred is not None:
        (folder / "inferred.glb").write_bytes(meshes.inferred)
    (folder / "actors").mkdir(exist_ok=True)
    names = file_names(workspace.twin.assets.actors)
    for actor_id, glb in meshes.glb_by_actor.items():
        (folder / "actors" / f"{names[actor_id]}.glb").write_bytes(glb)
    shown, whole = len(tracer.meshes[0].faces), len(workspace.twin.assets.background.faces)
    return () if shown == whole else (f"background: {shown} of {whole} triangles",)


def _read(folder: Path, workspace: Workspace) -> ViewMeshes:
    names = file_names(workspace.twin.assets.actors)
    paths = {actor_id: folder / "actors" / f"{name}.glb" for actor_id, name in names.items()}
    inferred = folder / "inferred.glb"
    return ViewMeshes(
        (folder / "background.glb").read_bytes(),
        inferred.read_bytes() if inferred.exists() else None,
        {actor_id: path.read_bytes() for actor_id, path in paths.items() if path.exists()},
    )
