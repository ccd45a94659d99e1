"""Reader of a synthetic log's ground truth: meshes and skies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lightsim.core.actors import ActorTrack
from lightsim.core.dome import SkyDome, Sun
from lightsim.core.mesh import TriMesh
from lightsim.core.scenario import ActorPlacement, Scenario
from lightsim.core.twin import ActorAsset
from lightsim.store.arrays import load_arrays
from lightsim.store.artefact import read_json
from lightsim.store.images import read_hdr


def read_true_meshes(path: Path) -> dict[str, TriMesh]:
    """Read the background (frame `world`) and actors (frame `actor`) of a log's scene.npz, by name.

    Each face has its own vertices, so that vertex normals equal face normals and edges are sharp.
    """
    arrays = load_arrays(path)
    meshes = {}
    for name in dict.fromkeys(key.split("/")[0] for key in arrays):
        # Base colours are not part of the file; 0.5 is a placeholder.
        corners = arrays[f"{name}/vertices"].astype(np.float32)[arrays[f"{name}/faces"]]
        vertices = corners.reshape(-1, 3)
        frame = "world" if name == "background" else "actor"
        faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
        meshes[name] = TriMesh(frame, vertices, faces, np.full_like(vertices, 0.5))
    return meshes


def true_scenario(meshes: Mapping[str, TriMesh], tracks: Sequence[ActorTrack]) -> Scenario:
    """Return the scenario of a log's actors with their true meshes (`read_true_meshes`)."""
    by_id = {track.actor_id: track for track in tracks}
    placements = tuple(
        ActorPlacement(ActorAsset(name, by_id[name].kind, mesh), by_id[name])
        for name, mesh in meshes.items()
        if name in by_id
    )
    return Scenario("truth", (), placements, tracks=tuple(tracks))


def true_sky(truth: Path, name: str = "source") -> SkyDome:
    """Read the source sky of a synthetic log, or one of its target skies by name.

    Raises:
        InputError, ArtefactError: `truth` is not a folder of `lightsim synthesize`.
    """
    # The sun's disc is smaller than a pixel; its exact direction is in the JSON file.
    beside = read_json(truth / "skies" / f"{name}.json")
    dome = read_hdr(truth / "skies" / f"{name}.exr")
    if beside["direction_world"] is None:
        return SkyDome(dome, None)
    direction = np.array(beside["direction_world"], dtype=np.float64)
    return SkyDome(dome, Sun(direction, np.array(beside["irradiance"], dtype=np.float32)))
