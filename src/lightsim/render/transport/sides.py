"""Face sides that rays meet.

A side is 2 x (running number of the face over the caster's meshes) + (1 if met from the back).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int32

from lightsim.core.casting import RayCaster

# Side of a ray that meets no surface.
OPEN = -1


class SideFinder:
    """Finder of the face sides that rays meet; make it once for many calls."""

    def __init__(self, caster: RayCaster) -> None:
        from lightsim.render.transport.kernels import face_normals

        self._caster = caster
        counts = [len(mesh.faces) for mesh in caster.meshes]
        self._first_face = np.cumsum([0, *counts])
        # Normals decide front or back; they are not normalised, since only the sign matters.
        self._normals = np.empty((int(self._first_face[-1]), 3), dtype=np.float32)
        for first, mesh in zip(self._first_face[:-1], caster.meshes, strict=True):
            face_normals(mesh.vertices, mesh.faces, self._normals[first : first + len(mesh.faces)])

    def met(
        self, origins: Float32[np.ndarray, "r 3"], directions: Float32[np.ndarray, "r 3"]
    ) -> Int32[np.ndarray, " r"]:
        """Return the side that each ray meets first, or OPEN."""
        from lightsim.render.transport.kernels import sides_of_hits

        hits = self._caster.intersect(origins, directions)
        sides = np.empty(len(directions), dtype=np.int32)
        sides_of_hits(
            self._first_face, self._normals, hits.mesh_index, hits.face_index, directions, sides
        )
        return sides
