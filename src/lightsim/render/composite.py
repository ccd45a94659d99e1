"""Ray caster that combines several casters, so that the static structure is built once per log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from lightsim.core.casting import RayCaster, RayHits
from lightsim.core.mesh import TriMesh


class CompositeCaster:
    """Ray caster that returns the nearest hit over several casters.

    `mesh_index` counts the first caster's meshes first.
    """

    def __init__(self, casters: Sequence[RayCaster]) -> None:
        self._casters = tuple(casters)
        self._meshes = tuple(mesh for c in casters for mesh in c.meshes)
        counts = [len(c.meshes) for c in casters]
        self._first_mesh = [sum(counts[:i]) for i in range(len(counts))]

    @property
    def meshes(self) -> Sequence[TriMesh]:
        """Meshes of all casters, in the order of the casters."""
        return self._meshes

    def intersect(
        self, origins_world: Float[np.ndarray, "n 3"], directions_world: Float[np.ndarray, "n 3"]
    ) -> RayHits:
        """Return the nearest first hit of each ray; at equal distances the earlier caster's."""
        best: RayHits | None = None
        for caster, first in zip(self._casters, self._first_mesh, strict=True):
            if best is None:
                # The first caster's hits are used as they are, without a copy.
                best = caster.intersect(origins_world, directions_world)
            elif _has_faces(caster):
                _take_nearer(best, caster.intersect(origins_world, directions_world), first)
        return RayHits.misses(len(origins_world)) if best is None else best

    def is_occluded(
        self, origins_world: Float[np.ndarray, "n 3"], directions_world: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Return the rays that meet a surface of any caster."""
        occluded = np.zeros(len(origins_world), dtype=bool)
        for caster in self._casters:
            if not _has_faces(caster):
                continue
            # Later casters trace only the rays that earlier casters found unoccluded.
            open_rays = np.flatnonzero(~occluded)
            if len(open_rays) == len(occluded):
                occluded = caster.is_occluded(origins_world, directions_world)
            else:
                occluded[open_rays] = caster.is_occluded(
                    origins_world[open_rays], directions_world[open_rays]
                )
        return occluded


def _has_faces(caster: RayCaster) -> bool:
    return any(len(mesh.faces) for mesh in caster.meshes)


def _take_nearer(best: RayHits, found: RayHits, first_mesh: int) -> None:
    """Write the nearer hits of `found` into `best`."""
    nearer = np.flatnonzero(found.distance_m < best.distance_m)
    best.distance_m[nearer] = found.distance_m[nearer]
    best.mesh_index[nearer] = found.mesh_index[nearer] + np.int32(first_mesh)
    best.face_index[nearer] = found.face_index[nearer]
    best.barycentric[nearer] = found.barycentric[nearer]
