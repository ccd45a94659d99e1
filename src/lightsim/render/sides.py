"""Which side of which face rays meet.

A side is 2 x (running number of the face over the caster's meshes) + (1 if met from the back).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Int32

from lightsim.core.casting import RayCaster
from lightsim.core.mesh import TriMesh

OPEN = -1
"""Side of a ray that meets nothing."""


def met_sides(
    caster: RayCaster,
    origins: Float32[np.ndarray, "r 3"],
    directions: Float32[np.ndarray, "r 3"],
) -> Int32[np.ndarray, " r"]:
    """Side that each ray meets first, or OPEN."""
    first_face = np.cumsum([0] + [len(mesh.faces) for mesh in caster.meshes])[:-1]
    hits = caster.intersect(origins, directions)
    rays = np.flatnonzero(hits.is_hit)
    mesh, face = hits.mesh_index[rays], hits.face_index[rays]
    is_back = _is_back(caster.meshes, mesh, face, directions[rays])
    sides = np.full(len(directions), OPEN, dtype=np.int32)
    if len(rays):
        sides[rays] = (2 * (first_face[mesh] + face) + is_back).astype(np.int32)
    return sides


def _is_back(
    meshes: Sequence[TriMesh],
    mesh_index: Int32[np.ndarray, " n"],
    face_index: Int32[np.ndarray, " n"],
    directions: Float32[np.ndarray, "n 3"],
) -> Bool[np.ndarray, " n"]:
    """Whether a ray meets the clockwise side of its face."""
    from lightsim.render.transport_kernels import meets_back

    is_back = np.zeros(len(mesh_index), dtype=np.bool_)
    for k, mesh in enumerate(meshes):
        if len(mesh.faces):
            meets_back(k, mesh.vertices, mesh.faces, mesh_index, face_index, directions, is_back)
    return is_back
