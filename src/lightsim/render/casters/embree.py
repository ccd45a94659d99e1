"""Ray casting with Intel Embree through the pip package embreex."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from lightsim.core.casting import MISS, RayHits, check_world
from lightsim.core.cores import worker_count
from lightsim.core.mesh import TriMesh
from lightsim.core.threads import for_ranges

# Most rays in one call of embreex, which bounds its temporary copies to about 20 MB. Not measured
# alone.
_MAX_RAYS = 1 << 18
# Least number of rays of a thread's task: fewer cost more than they save.
_MIN_RAYS = 1 << 13
# Distance of ray origins from their surface, in metres. Smaller values cause self-intersections,
# larger ones light leaks under cars. Not measured alone.
_OFFSET_M = 0.002


class EmbreeCaster:
    """`core.casting.RayCaster` over a fixed list of meshes in frame `world`.

    Embree computes in float32: distances are accurate to about 0.02 mm at coordinates of 100 m, to
    0.2 mm at 1 km. A ray that starts on a surface may meet that surface again; see
    `offset_origins`. Both sides of a triangle are hit. The acceleration structure is released with
    the object.
    """

    def __init__(self, meshes: Sequence[TriMesh]) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        check_world(meshes)
        self._meshes = tuple(meshes)
        filled = [i for i, mesh in enumerate(meshes) if len(mesh.faces)]
        self._mesh_by_geometry = np.array(filled, dtype=np.int32)
        self._scene = EmbreeScene() if filled else None
        self._geometries = [
            TriangleMesh(
                self._scene,
                np.ascontiguousarray(meshes[i].vertices),
                np.ascontiguousarray(meshes[i].faces),
            )
            for i in filled
        ]

    @property
    def meshes(self) -> Sequence[TriMesh]:
        """Meshes in the given order, which `RayHits.mesh_index` counts."""
        return self._meshes

    def intersect(
        self, origins_world: Float[np.ndarray, "n 3"], directions_world: Float[np.ndarray, "n 3"]
    ) -> RayHits:
        """Return the first hits along unit directions, from distance 0 on."""
        count = len(origins_world)
        hits = RayHits.misses(count)
        if self._scene is None:
            return hits
        scene = self._scene

        def cast(first: int, last: int) -> None:
            part = slice(first, last)
            rays = _single(origins_world[part]), _single(directions_world[part])
            found = scene.run(*rays, output=True)
            face = found["primID"]
            is_hit = face != MISS
            hits.face_index[part] = face
            hits.mesh_index[part] = np.where(is_hit, self._mesh_by_geometry[found["geomID"]], MISS)
            hits.distance_m[part] = np.where(is_hit, found["tfar"], np.float32(np.inf))
            hits.barycentric[part] = _weights(found["u"], found["v"], face)

        _in_threads(cast, count)
        return hits

    def is_occluded(
        self, origins_world: Float[np.ndarray, "n 3"], directions_world: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Return the rays that meet any surface; faster than `intersect`."""
        occluded = np.zeros(len(origins_world), dtype=bool)
        if self._scene is None:
            return occluded
        scene = self._scene

        def cast(first: int, last: int) -> None:
            part = slice(first, last)
            rays = _single(origins_world[part]), _single(directions_world[part])
            occluded[part] = scene.run(*rays, query="OCCLUDED") != MISS

        _in_threads(cast, len(occluded))
        return occluded


def make_embree_caster(meshes: Sequence[TriMesh]) -> EmbreeCaster:
    """Return a caster over meshes in frame `world`; no meshes and meshes without faces are allowed.

    Raises:
        FrameMismatchError: a mesh lies in another frame.
    """
    return EmbreeCaster(meshes)


def offset_origins(
    points_world: Float[np.ndarray, "n 3"],
    directions_world: Float[np.ndarray, "n 3"],
) -> Float32[np.ndarray, "n 3"]:
    """Return ray origins offset from a surface, which avoids self-intersections.

    The offset is 2 mm, or eight float32 steps at the point's largest coordinate if that is more.

    Args:
        points_world: on the surface.
        directions_world: unit vectors of the step: the surface's normals, or the rays.
    """
    largest = np.abs(points_world).max(axis=1, initial=0.0)
    ulp = np.spacing(largest.astype(np.float32)).astype(np.float64)
    # Far from the origin (beyond 2 km) 2 mm would be lost in rounding.
    step = np.maximum(_OFFSET_M, 8.0 * ulp)[:, None]
    return (points_world + step * directions_world).astype(np.float32)


def _single(vectors: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    return np.ascontiguousarray(vectors, dtype=np.float32)


def _in_threads(cast: Callable[[int, int], None], count: int) -> None:
    # embreex releases Python's lock, and rays do not depend on each other.
    for_ranges(cast, count, worker_count(), smallest=_MIN_RAYS, largest=_MAX_RAYS)


def _weights(
    u: Float32[np.ndarray, " n"], v: Float32[np.ndarray, " n"], face: Int32[np.ndarray, " n"]
) -> Float32[np.ndarray, "n 3"]:
    """Return the vertex weights of Embree's (u, v); 0 without a hit."""
    # Rounding can move hits at an edge slightly outside of their face.
    u, v = np.clip(u, 0.0, 1.0), np.clip(v, 0.0, 1.0)
    weights = np.stack([np.maximum(1 - u - v, 0), u, v], axis=1)
    return np.where((face != MISS)[:, None], weights, np.float32(0))
