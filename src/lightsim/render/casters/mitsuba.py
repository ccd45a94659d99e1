"""Ray casting with Mitsuba: OptiX on CUDA, Embree with compiled kernels on LLVM."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from lightsim.core.casting import MakeCaster, RayHits, check_world
from lightsim.core.mesh import TriMesh
from lightsim.core.mitsuba_variants import Variant, has_cuda, has_llvm, mitsuba_with
from lightsim.errors import InputError
from lightsim.render.mitsuba_scene import columns, make_mesh

MitsubaBackend = Literal["cuda", "llvm"]
VARIANTS: dict[MitsubaBackend, Variant] = {"cuda": "cuda_ad_rgb", "llvm": "llvm_ad_rgb"}
# Rays in one call of Mitsuba, some 0.5 GB with their hits. Not measured alone.
_CHUNK_RAYS = 1 << 23
_REMEDY: dict[MitsubaBackend, str] = {
    "cuda": "Use --backend embree, or a machine with an NVIDIA GPU and driver 535 or newer.",
    "llvm": "Use --backend embree, or set DRJIT_LIBLLVM_PATH to a libLLVM.so of version 17 or "
    "newer (older ones abort the process on some processors).",
}


class MitsubaCaster:
    """`core.casting.RayCaster` over a fixed list of meshes in frame `world`.

    Single precision, and both sides of a triangle are hit, as with `EmbreeCaster`. All meshes form
    one shape, because the meaning of an instance or a shape index differs between Mitsuba's
    variants.
    """

    def __init__(self, meshes: Sequence[TriMesh], backend: MitsubaBackend) -> None:
        check_world(meshes)
        self._meshes = tuple(meshes)
        self._backend: MitsubaBackend = backend
        # Mitsuba numbers the faces of the one shape; these bounds recover mesh and face.
        self._first_face = np.cumsum([0] + [len(mesh.faces) for mesh in meshes])
        self._scene: Any = None
        if self._first_face[-1]:
            with mitsuba_with(VARIANTS[backend]) as mitsuba:
                self._scene = make_mitsuba_scene(mitsuba, self._meshes)

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
        import drjit

        with mitsuba_with(VARIANTS[self._backend]) as mitsuba:
            for start in range(0, count, _CHUNK_RAYS):
                part = slice(start, start + _CHUNK_RAYS)
                rays = _rays(mitsuba, origins_world[part], directions_world[part])
                found = self._scene.ray_intersect_preliminary(rays, coherent=False)
                arrays = (found.t, found.prim_index, *found.prim_uv)
                # Evaluated together: each array read alone would trace the rays again.
                drjit.eval(*arrays)
                t, face, u, v = (np.asarray(array) for array in arrays)
                self._fill(hits, start + np.flatnonzero(np.isfinite(t)), start, (t, face, u, v))
        return hits

    def _fill(
        self,
        hits: RayHits,
        rows: Any,
        start: int,
        found: tuple[Any, Any, Any, Any],
    ) -> None:
        t, face, u, v = (values[rows - start] for values in found)
        mesh = np.searchsorted(self._first_face, face, side="right") - 1
        hits.distance_m[rows] = t
        hits.mesh_index[rows] = mesh
        hits.face_index[rows] = face - self._first_face[mesh]
        # Rounding can move hits at an edge slightly outside of their face.
        u, v = np.clip(u, 0.0, 1.0), np.clip(v, 0.0, 1.0)
        hits.barycentric[rows] = np.stack([np.maximum(1 - u - v, 0), u, v], axis=1)

    def is_occluded(
        self, origins_world: Float[np.ndarray, "n 3"], directions_world: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Return the rays that meet any surface; faster than `intersect`."""
        occluded = np.zeros(len(origins_world), dtype=bool)
        if self._scene is None:
            return occluded
        with mitsuba_with(VARIANTS[self._backend]) as mitsuba:
            for start in range(0, len(origins_world), _CHUNK_RAYS):
                part = slice(start, start + _CHUNK_RAYS)
                rays = _rays(mitsuba, origins_world[part], directions_world[part])
                # By keyword: a positional False would be bound to `active` and trace nothing.
                found = self._scene.ray_test(rays, coherent=False, active=True)
                occluded[part] = np.asarray(found)
        return occluded


def mitsuba_caster_maker(backend: MitsubaBackend) -> MakeCaster:
    """Return a constructor of casters on "cuda" (OptiX) or "llvm".

    Raises:
        InputError: Mitsuba cannot use it on this machine.
    """
    if not is_usable(backend):
        raise InputError(
            f"Mitsuba cannot cast rays with {backend} here",
            where=f"--backend mitsuba-{backend}",
            remedy=_REMEDY[backend],
        )

    def make(meshes: Sequence[TriMesh]) -> MitsubaCaster:
        return MitsubaCaster(meshes, backend)

    return make


@cache
def is_usable(backend: MitsubaBackend) -> bool:
    """Return true if Mitsuba can trace a ray with the backend.

    LLVM requires DRJIT_LIBLLVM_PATH to name a library of version 17 or newer, since older ones may
    end the process.
    """
    if not (has_cuda() if backend == "cuda" else has_llvm()):
        return False
    # Only a traced ray proves that driver and libraries work together.
    triangle = TriMesh(
        "world",
        np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1]], np.float32),
        np.array([[0, 1, 2]], np.int32),
        np.ones((3, 3), np.float32),
    )
    try:
        caster = MitsubaCaster([triangle], backend)
        found = caster.intersect(np.full((1, 3), 0.1), np.array([[0.0, 0.0, 1.0]]))
    except (ImportError, RuntimeError, OSError):
        return False
    return bool(found.is_hit[0])


def make_mitsuba_scene(mitsuba: Any, meshes: Sequence[TriMesh]) -> Any:
    """Return a scene of one shape with all meshes, in Mitsuba's current variant.

    At least one mesh must have faces.
    """
    first_vertex = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    vertices = np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float32)
    faces = np.concatenate(
        [mesh.faces + first for mesh, first in zip(meshes, first_vertex[:-1], strict=True)]
    )
    parameters = {"vertex_positions": vertices, "faces": faces.astype(np.uint32)}
    shape = make_mesh(mitsuba, "scene", parameters)
    return mitsuba.load_dict({"type": "scene", "shape": shape})


def _rays(
    mitsuba: Any, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> Any:
    return mitsuba.Ray3f(columns(mitsuba, origins), columns(mitsuba, directions))
