"""Meshes of the viewer: background and actors within limits of triangles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lightsim.appearance.colour import colour_of_nearest
from lightsim.build.workspace import Workspace
from lightsim.core.mesh import TriMesh
from lightsim.geometry.simplify import simplify

MAX_TRIANGLES = 200_000
"""Most triangles of the static scene. A browser without a graphics card draws 64,296 of them at 22
frames/s (two cores, SwiftShader)."""
MAX_ASSET_TRIANGLES = 50_000
"""Most triangles of one actor. Reconstructed vehicles have 2,000 to 4,000, CAD models may have
millions. Chosen."""
# First RMS error of the simplification, in metres; each attempt doubles it. Chosen; sensitivity not
# measured.
_FIRST_ERROR_M = 0.01
# Largest RMS error of the simplification, in metres. Chosen; sensitivity not measured.
_LARGEST_ERROR_M = 0.64
# Longest edge after simplification, in multiples of the error: colours vary along edges of 0.5 m
# and more at the first error. Chosen; sensitivity not measured.
_EDGE_PER_ERROR = 50.0


@dataclass(frozen=True, eq=False)
class ViewMeshes:
    """Binary glTF files of a twin with their light, z up.

    Args:
        background: static scene, frame `world`.
        inferred: unobserved surfaces that cast shadows, frame `world`; None if there are none.
        glb_by_actor: each actor with a mesh, frame `actor`.
    """

    background: bytes
    inferred: bytes | None
    glb_by_actor: Mapping[str, bytes]


def static_meshes(workspace: Workspace) -> tuple[TriMesh, TriMesh]:
    """Return background and unobserved surfaces, of at most `MAX_TRIANGLES` together."""
    inferred = decimated(workspace.unobserved_occluders, MAX_TRIANGLES // 2)
    background = workspace.twin.assets.background
    return decimated(background, MAX_TRIANGLES - len(inferred.faces)), inferred


def decimated(mesh: TriMesh, max_triangles: int) -> TriMesh:
    """Return the mesh with at most `max_triangles` faces; unchanged if it has no more.

    The error bound of the simplification is doubled until the mesh is small enough. If the largest
    bound does not suffice, as with many separate pieces, only the largest faces remain. The result
    has vertex colours.
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
