"""One caster over several, so that the static structure is built once per log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from lightsim.core.casting import RayCaster, RayHits
from lightsim.core.mesh import TriMesh


class CompositeCaster:
    """Nearest hit over several casters; `mesh_index` counts the first caster's meshes first."""

    def __init__(self, casters: Sequence[RayCaster]) -> None:
        self._casters = tuple(c for c in casters)
        self._meshes = tuple(mesh for c in casters for mesh in c.meshes)
        counts = [len(c.meshes) for c in casters]
        self._first_mesh = [sum(counts[:i]) for i in range(len(counts))]

    @property
    def meshes(self) -> Sequence[TriMesh]:
        """Those of all casters, one caster after another."""
        return self._meshes

    def intersect(
        self, origins_world: Float[np.ndarray, "n 3"], directions_world: Float[np.ndarray, "n 3"]
    ) -> RayHits:
        """The nearest of the first hits; at equal distances the earlier caster wins."""
        best: RayHits | None = None
        for caster, first in zip(self._casters, self._first_mesh, strict=True):
            if best is not None and not _has_faces(caster):
                continue
            found = caster.intersect(origins_world, directions_world)
            best = found if best is None and first == 0 else _nearer(best, found, first)
        if best is None:
            return _no_hits(len(origins_world))
        return best

    def is_occluded(
        self, origins_world: Float[np.ndarray, "n 3"], directions_world: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Whether any caster meets the ray; later ones are asked about open rays alone."""
        occluded = np.zeros(len(origins_world), dtype=bool)
        for caster in self._casters:
            if not _has_faces(caster):
                continue
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


def _no_hits(count: int) -> RayHits:
    return RayHits(
        np.full(count, np.inf, np.float32),
        np.full(count, -1, np.int32),
        np.full(count, -1, np.int32),
        np.zeros((count, 3), np.float32),
    )


def _nearer(best: RayHits | None, found: RayHits, first_mesh: int) -> RayHits:
    """`best` with the hits of `found` that are nearer, in place: only those are touched."""
    if best is None:
        best = _no_hits(len(found.distance_m))
    nearer = np.flatnonzero(found.distance_m < best.distance_m)
    best.distance_m[nearer] = found.distance_m[nearer]
    best.mesh_index[nearer] = found.mesh_index[nearer] + np.int32(first_mesh)
    best.face_index[nearer] = found.face_index[nearer]
    best.barycentric[nearer] = found.barycentric[nearer]
    return best
