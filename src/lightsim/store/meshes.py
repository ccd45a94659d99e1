"""Triangle meshes as glTF 2.0 binary (.glb), the form that viewers and CAD libraries use.

glTF is y up; our frames are z up with x forward. The vertex data stay as they are in memory, and
a root node `gltf_from_<frame>` turns them upright for viewers. Geometry and vertex colours
(linear in glTF as they are here) are float32, nothing of them is lost; textures become 8-bit sRGB.
"""

from __future__ import annotations

from pathlib import Path

from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError
from lightsim.store.atomic import whole_file
from lightsim.store.gltf import read_gltf
from lightsim.store.gltf_writer import glb_pieces
from lightsim.store.primitive_mesh import mesh_of
from lightsim.store.primitives import Y_UP_FROM_Z_UP


def write_glb(path: Path, mesh: TriMesh) -> None:
    """Write one mesh: its texture as 8-bit sRGB, or linear float vertex colours without one.

    Faces are grouped by material; materials without faces are left out.

    Raises:
        InputError: the mesh has no face, or the folder does not exist.
    """
    if not len(mesh.faces):
        raise InputError(
            "a mesh without faces is not written", where=path, expected="one face or more"
        )
    pieces = glb_pieces(mesh, Y_UP_FROM_Z_UP)
    with whole_file(path) as temporary, temporary.open("wb") as handle:
        handle.writelines(pieces)


def read_glb(path: Path, frame: str, texture_edge_m: float = 0.06) -> TriMesh:
    """Return all triangles of a .glb or .gltf file as one mesh in `frame` (z up, metres).

    Notes of the reader are dropped: this is for files of LightSim's own. Models of other programs
    are read by `read_gltf` and `mesh_of`, which return notes.

    Raises:
        InputError: the file is missing, damaged, or has no triangles.
    """
    mesh, _ = mesh_of(read_gltf(path), frame, texture_edge_m)
    return mesh
