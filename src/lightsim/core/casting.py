"""Interface of ray casters, so that stages do not depend on `render`, which implements it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from lightsim.core.mesh import TriMesh
from lightsim.errors import FrameMismatchError

MISS = -1
"""`face_index` of a ray that meets no face."""


@dataclass(frozen=True, eq=False)
class RayHits:
    """First hits. Misses: distance inf, face and mesh MISS, barycentric 0.

    Args:
        distance_m: along the unit direction.
        mesh_index: index into the caster's meshes.
        face_index: face within that mesh.
        barycentric: weights of the face's three vertices.
    """

    distance_m: Float32[np.ndarray, " n"]
    mesh_index: Int32[np.ndarray, " n"]
    face_index: Int32[np.ndarray, " n"]
    barycentric: Float32[np.ndarray, "n 3"]

    @classmethod
    def misses(cls, count: int) -> RayHits:
        """Return arrays for `count` rays, all of them misses."""
        return cls(
            np.full(count, np.inf, dtype=np.float32),
            np.full(count, MISS, dtype=np.int32),
            np.full(count, MISS, dtype=np.int32),
            np.zeros((count, 3), dtype=np.float32),
        )

    @property
    def is_hit(self) -> Bool[np.ndarray, " n"]:
        """True for rays that meet a face."""
        return self.face_index != MISS


@runtime_checkable
class RayCaster(Protocol):
    """Intersects rays with a fixed list of meshes in frame `world`. Directions are unit vectors."""

    @property
    def meshes(self) -> Sequence[TriMesh]:
        """The meshes, in the order of `RayHits.mesh_index`."""
        ...

    def intersect(
        self, origins_world: Float[np.ndarray, "n 3"], directions_world: Float[np.ndarray, "n 3"]
    ) -> RayHits:
        """Return the nearest face on each ray; faces count from both sides."""
        ...

    def is_occluded(
        self, origins_world: Float[np.ndarray, "n 3"], directions_world: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Return whether each ray meets a face at any distance."""
        ...


def check_world(meshes: Sequence[TriMesh]) -> None:
    """Reject meshes outside of frame `world`.

    Raises:
        FrameMismatchError: a mesh lies in another frame.
    """
    for mesh in meshes:
        if mesh.frame != "world":
            raise FrameMismatchError(
                "rays are cast in frame 'world'", got=mesh.frame, expected="world"
            )


MakeCaster = Callable[[Sequence[TriMesh]], RayCaster]
