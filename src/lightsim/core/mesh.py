"""Triangle meshes with base colour and a material."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float32, Int32

from lightsim.core.frames import RigidTransform
from lightsim.errors import FrameMismatchError, InputError


@dataclass(frozen=True)
class Material:
    """Principled parameters (Burley 2012); base colour lies on the mesh."""

    roughness: float = 0.9
    metallic: float = 0.0


@dataclass(frozen=True, eq=False)
class TriMesh:
    """Triangles in `frame`; counter-clockwise seen from outside.

    Args:
        vertices: metres.
        faces: vertex indices.
        base_colour: linear diffuse albedo of each vertex, in [0, 1].
    """

    frame: str
    vertices: Float32[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    base_colour: Float32[np.ndarray, "n 3"]
    material: Material = field(default_factory=Material)

    def __post_init__(self) -> None:
        if not np.isfinite(self.vertices).all():
            raise InputError("a mesh vertex is not finite", where=f"mesh in '{self.frame}'")
        is_out = len(self.faces) and (
            self.faces.min() < 0 or self.faces.max() >= len(self.vertices)
        )
        if is_out:
            raise InputError("a face names no vertex", where=f"mesh in '{self.frame}'")

    def moved(self, transform: RigidTransform) -> TriMesh:
        """The same mesh in frame `transform.dst`."""
        if transform.src != self.frame:
            raise FrameMismatchError(
                "the transform does not start in the mesh's frame",
                got=transform.src,
                expected=self.frame,
            )
        vertices = transform.apply(self.vertices.astype(np.float64)).astype(np.float32)
        return TriMesh(transform.dst, vertices, self.faces, self.base_colour, self.material)

    def face_normals(self) -> Float[np.ndarray, "m 3"]:
        """Unit normals; zero for degenerate faces."""
        a, b, c = (self.vertices[self.faces[:, i]].astype(np.float64) for i in range(3))
        normals = np.cross(b - a, c - a)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return normals / np.where(length > 0, length, 1.0)

    def vertex_normals(self) -> Float32[np.ndarray, "n 3"]:
        """Area-weighted unit normals; zero for vertices without a face."""
        a, b, c = (self.vertices[self.faces[:, i]].astype(np.float64) for i in range(3))
        weighted = np.cross(b - a, c - a)
        normals = np.zeros((len(self.vertices), 3))
        for i in range(3):
            for axis in range(3):
                normals[:, axis] += np.bincount(
                    self.faces[:, i], weighted[:, axis], minlength=len(self.vertices)
                )
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return (normals / np.where(length > 0, length, 1.0)).astype(np.float32)


def concatenate_meshes(meshes: list[TriMesh]) -> TriMesh:
    """One mesh of several in the same frame (the first one's material)."""
    if not meshes:
        raise InputError("no meshes to concatenate")
    if len({mesh.frame for mesh in meshes}) > 1:
        raise FrameMismatchError("meshes lie in several frames")
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return TriMesh(
        meshes[0].frame,
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(
            [mesh.faces + np.int32(o) for mesh, o in zip(meshes, offsets, strict=True)]
        ).astype(np.int32),
        np.concatenate([mesh.base_colour for mesh in meshes]),
        meshes[0].material,
    )
