"""The reader of a synthetic log's truth: meshes and the source sky."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightsim.core.dome import SkyDome, Sun
from lightsim.core.mesh import TriMesh
from lightsim.store.arrays import load_arrays
from lightsim.store.artefact import read_json
from lightsim.store.images import read_hdr


def read_true_meshes(path: Path) -> dict[str, TriMesh]:
    """Background (frame `world`) and actors (frame `actor`) of a synthetic log's scene.npz.

    No two faces share a vertex: the street's edges are sharp, and vertex normals those of the
    faces.
    """
    arrays = load_arrays(path)
    meshes = {}
    for name in dict.fromkeys(key.split("/")[0] for key in arrays):
        corners = arrays[f"{name}/vertices"].astype(np.float32)[arrays[f"{name}/faces"]]
        vertices = corners.reshape(-1, 3)
        frame = "world" if name == "background" else "actor"
        faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
        meshes[name] = TriMesh(frame, vertices, faces, np.full_like(vertices, 0.5))
    return meshes


def true_sky(truth: Path, name: str = "source") -> SkyDome:
    """The sky that a synthetic log was recorded under, or one of those it was rendered anew under.

    Raises:
        InputError, ArtefactError: `truth` is not a folder that `lightsim synthesize` wrote.
    """
    # The disc is smaller than a pixel of the file: its exact direction stands beside it.
    beside = read_json(truth / "skies" / f"{name}.json")
    dome = read_hdr(truth / "skies" / f"{name}.exr")
    if beside["direction_world"] is None:
        return SkyDome(dome, None)
    direction = np.array(beside["direction_world"], dtype=np.float64)
    return SkyDome(dome, Sun(direction, np.array(beside["irradiance"], dtype=np.float32)))
