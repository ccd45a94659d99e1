"""Reader and writer of triangle meshes as glTF 2.0 binary (.glb).

glTF is y up; LightSim's frames are z up with x forward. Vertices are stored in LightSim's frame,
and a root node `gltf_from_<frame>` rotates them for viewers. Geometry and vertex colours (linear in
glTF, too) are stored as float32 without loss; textures become 8-bit sRGB.
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
    """Write one mesh with its texture as 8-bit sRGB, or with linear float vertex colours.

    Faces are grouped by material; materials without faces are omitted.

    Raises:
        InputError: the mesh has no face, or the folder does not exist.
    """
    if not len(mesh.faces):
        raise InputError(
            "a mesh without faces cannot be written", where=path, expected="one face or more"
        )
    pieces = glb_pieces(mesh, Y_UP_FROM_Z_UP)
    with whole_file(path) as temporary, temporary.open("wb") as handle:
        handle.writelines(pieces)


def read_glb(path: Path, frame: str) -> TriMesh:
    """Return all triangles of a .glb or .gltf file as one mesh in `frame` (z up, metres).

    For files that LightSim wrote: notes of the reader are ignored. Models of other programs are
    read by `read_gltf` and `mesh_of`, which return notes.

    Raises:
        InputError: the file is missing, damaged, or has no triangles.
    """
    mesh, _ = mesh_of(read_gltf(path), frame)
    return mesh
