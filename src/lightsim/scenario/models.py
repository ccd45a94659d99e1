"""CAD files as actors: metres, z up, the front ahead, the origin in the middle of the box."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from lightsim.core.actors import ActorKind
from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError
from lightsim.store.meshes import read_glb

Front = Literal["auto", "+x", "-x", "+z", "-z"]
"""Where a model looks, in the axes of its file (y up). glTF says +z, but many models lie along x:
`auto` takes the longer side as the length and its lower end, the bonnet, as the front."""
_LONGEST_M, _SHORTEST_M = 60.0, 0.05
_END, _EVEN = 0.1, 0.02
"""Parts of the length and of the height: how far an end reaches, and what differs in height."""
_CAR_M = ((2.8, 1.3, 1.0), (6.0, 2.5, 2.4))


def read_model(path: Path, front: Front = "auto", metres_per_unit: float = 1.0) -> TriMesh:
    """A .glb, .gltf or .obj file as a mesh in frame `actor`, with its materials.

    Raises:
        InputError: it cannot be read, or is too large or small for anything in a street.
    """
    mesh = read_glb(path, "actor") if path.suffix.lower() == ".glb" else _converted(path)
    vertices = mesh.vertices.astype(np.float64) * metres_per_unit
    extent = np.ptp(vertices, axis=0)
    if not _SHORTEST_M <= extent.max() <= _LONGEST_M:
        raise InputError(
            "the model has not the size of anything in a street",
            where=path,
            got=" x ".join(f"{e:.4g}" for e in extent) + " m",
            expected=f"a longest side from {_SHORTEST_M} to {_LONGEST_M} m",
            remedy="Tell its unit: lightsim assets add --metres-per-unit 0.01 for centimetres.",
        )
    vertices = vertices @ _turn(_front_of(vertices) if front == "auto" else front).T
    return centred(replace(mesh, vertices=vertices.astype(np.float32)))


def _front_of(vertices: Float[np.ndarray, "n 3"]) -> Front:
    """The bonnet of cars, pickups and trucks is lower than what their other end has; models whose
    ends are equally high look to the positive one."""
    low, extent = vertices.min(axis=0), np.ptp(vertices, axis=0)
    along = 0 if extent[0] >= extent[1] else 1
    part = (vertices[:, along] - low[along]) / extent[along]
    ends = [vertices[is_end, 2].max() for is_end in (part <= _END, part >= 1 - _END)]
    is_negative = ends[0] < ends[1] - _EVEN * extent[2]
    if along == 0:
        return "-x" if is_negative else "+x"
    # Their z is our -y.
    return "+z" if is_negative or abs(ends[0] - ends[1]) <= _EVEN * extent[2] else "-z"


def _turn(front: Front) -> Float[np.ndarray, "3 3"]:
    """Brings the front to +x. Files are y up: their z is our -y."""
    quarters = {"+x": 0, "+z": 1, "-x": 2, "-z": 3, "auto": 0}[front]
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters]
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=np.float64)


def centred(mesh: TriMesh) -> TriMesh:
    """The mesh with the origin in the middle of its own box."""
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    return replace(mesh, vertices=mesh.vertices - middle)


def _converted(path: Path) -> TriMesh:
    """Other formats by way of glTF, which trimesh writes."""
    import tempfile

    import trimesh

    if path.suffix.lower() not in (".gltf", ".obj"):
        raise InputError(
            "the model's format is not understood", where=path, expected=".glb, .gltf or .obj"
        )
    try:
        data = trimesh.load_scene(path).export(file_type="glb")
    except Exception as error:
        raise InputError(
            "the model cannot be read",
            where=path,
            got=f"{type(error).__name__}: {error}"[:200],
            remedy="Export it again as .glb.",
        ) from error
    with tempfile.TemporaryDirectory() as folder:
        glb = Path(folder) / "model.glb"
        assert isinstance(data, bytes)
        glb.write_bytes(data)
        return read_glb(glb, "actor")


def guessed_kind(name: str, mesh: TriMesh) -> ActorKind:
    """What a model is, by its name, else by its size."""
    words = name.lower().replace("_", " ").replace("-", " ")
    for kind in ActorKind:
        if str(kind) in words and kind is not ActorKind.OTHER:
            return kind
    size = np.ptp(mesh.vertices, axis=0)
    low, high = np.array(_CAR_M)
    return ActorKind.CAR if ((size > low) & (size < high)).all() else ActorKind.OTHER
