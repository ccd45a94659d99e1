"""Triangle meshes with base colour and a material."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int32, Shaped, UInt8

from lightsim.core.frames import RigidTransform
from lightsim.errors import FrameMismatchError, InputError

MATTE_ROUGHNESS = 0.6
"""Least roughness of a matte surface. Its specular lobe is so wide that the reflection varies as
slowly over the picture as diffuse light. Its diffuse reflection is Lambertian: towards grazing
angles, the diffuse gain of rough materials about cancels Fresnel's loss (Burley 2012, Sec. 5.3)."""
MIRROR_ROUGHNESS = 0.2
"""Largest roughness of a pane, whose picture is a reflection or shows what is behind it."""


class Provenance(IntEnum):
    """Evidence for the shape of a face."""

    MEASURED = 0
    """Sensors observed the surface."""
    MIRRORED = 1
    """Sensors observed the opposite half of a vehicle."""
    INTERPOLATED = 2
    """A hole within measured surface was closed: ground under a vehicle, a window pane."""
    INFERRED = 3
    """Extrapolated: default shapes, roofs, upper facades."""
    BACKGROUND_PROXY = 4
    """Represents everything beyond the range of the sensors."""


@dataclass(frozen=True)
class Material:
    """Principled parameters (Burley 2012) of one class of surfaces; base colour lies on the mesh.

    Args:
        roughness: perceptual; its square is the width of the microfacets' slopes.
        name: the class, such as "car paint"; for display only.
    """

    roughness: float = 0.8
    metallic: float = 0.0
    name: str = "matte"


# Panes of vehicles: smooth, as float glass is.
CAR_GLASS = Material(0.1, 0.0, "glass")
CAR_GLASS_COLOUR = (0.03, 0.034, 0.036)
"""Base colour of vehicle panes: dark, as the cabin behind them is. Chosen; not measured."""


@dataclass(frozen=True, eq=False)
class Texture:
    """Colours of a mesh at image resolution.

    Args:
        image: linear, of the same quantity as `TriMesh.base_colour`.
        corner_uv: (u, v) of each face's three corners, in pixels of `image` (CONVENTIONS: Pixels:
            the first pixel's centre is (0.5, 0.5)). Bilinear look-up between pixel centres is
            safe everywhere inside a face.
    """

    image: Float32[np.ndarray, "h w 3"]
    corner_uv: Float32[np.ndarray, "m 3 2"]

    def look_up(
        self, face: Int[np.ndarray, " n"], barycentric: Float[np.ndarray, "n 3"]
    ) -> Float32[np.ndarray, "n 3"]:
        """Return the bilinear colour at points of faces."""
        return self.look_up_in(self.image, face, barycentric)

    def look_up_in(
        self,
        image: Shaped[np.ndarray, "h w c"],
        face: Int[np.ndarray, " n"],
        barycentric: Float[np.ndarray, "n 3"],
    ) -> Float32[np.ndarray, "n c"]:
        """Look up another image with the layout of this texture, at points of faces."""
        height, width = image.shape[:2]
        uv = (barycentric[:, :, None] * self.corner_uv[face]).sum(axis=1)
        x = np.clip(uv[:, 0] - 0.5, 0, width - 1)
        y = np.clip(uv[:, 1] - 0.5, 0, height - 1)
        # The left of two columns: at the last column, its weight is 0 instead of an index beyond.
        j = np.minimum(x.astype(np.int64), max(width - 2, 0))
        i = np.minimum(y.astype(np.int64), max(height - 2, 0))
        fx, fy = (x - j).astype(np.float32)[:, None], (y - i).astype(np.float32)[:, None]
        i1, j1 = np.minimum(i + 1, height - 1), np.minimum(j + 1, width - 1)
        top = (1 - fx) * image[i, j] + fx * image[i, j1]
        low = (1 - fx) * image[i1, j] + fx * image[i1, j1]
        return (1 - fy) * top + fy * low


@dataclass(frozen=True, eq=False)
class SunVisibility:
    """Fraction of the recorded sun's disc that reached a mesh, in 255ths.

    Args:
        vertex: at the vertices.
        texel: at the texels of the mesh's texture; None without one.
    """

    vertex: UInt8[np.ndarray, " n"]
    texel: UInt8[np.ndarray, "h w"] | None = None


@dataclass(frozen=True, eq=False)
class TriMesh:
    """Triangle mesh in `frame`; faces are counter-clockwise from outside.

    Args:
        vertices: metres.
        faces: vertex indices.
        base_colour: linear diffuse albedo of each vertex, in [0, 1]; before the decomposition (the
            twin stage), the radiance that the cameras observed.
        materials: the classes that occur; a mesh without `face_material` is all of the first.
        face_material: index into `materials` for each face.
        texture: the base colour at image resolution; renderers for cameras prefer it to the
            vertices' colour, which is its local mean and serves bounced light.
        confidence: of each vertex's base colour, 0 (guessed) to 1 (observed, light known).
        face_provenance: a `Provenance` for each face; None: all are measured.
        towards_camera: of each vertex, mean direction to the cameras that gave its colour, unit; 0
            where none did. None: unknown.
        sun_visibility: estimate from the pictures; None: unknown, or the mesh has moved since.
    """

    frame: str
    vertices: Float32[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    base_colour: Float32[np.ndarray, "n 3"]
    materials: tuple[Material, ...] = (Material(),)
    face_material: UInt8[np.ndarray, " m"] | None = None
    texture: Texture | None = None
    confidence: Float32[np.ndarray, " n"] | None = None
    face_provenance: UInt8[np.ndarray, " m"] | None = None
    towards_camera: Float32[np.ndarray, "n 3"] | None = None
    sun_visibility: SunVisibility | None = None

    def __post_init__(self) -> None:
        where = f"mesh in '{self.frame}'"
        is_finite = np.isfinite(self.vertices).all(axis=1)
        if not is_finite.all():
            raise InputError(
                "a mesh vertex is not finite",
                where=where,
                got=f"{int((~is_finite).sum())} of {len(self.vertices)}",
                expected="finite coordinates in metres",
            )
        is_out = len(self.faces) and (
            self.faces.min() < 0 or self.faces.max() >= len(self.vertices)
        )
        if is_out:
            raise InputError(
                "a face refers to a missing vertex",
                where=where,
                got=f"vertex numbers {self.faces.min()} to {self.faces.max()}",
                expected=f"numbers from 0 and below {len(self.vertices)}",
            )
        if self.texture is not None and len(self.texture.corner_uv) != len(self.faces):
            raise InputError(
                "the texture and the mesh differ in their number of faces",
                where=where,
                got=len(self.texture.corner_uv),
                expected=len(self.faces),
            )

    @property
    def material(self) -> Material:
        """The first of the mesh's materials."""
        return self.materials[0]

    def has_provenance(self, *sources: Provenance) -> Bool[np.ndarray, " m"]:
        """Return the mask of faces with one of these provenances."""
        if self.face_provenance is None:
            return np.full(len(self.faces), Provenance.MEASURED in sources)
        return np.isin(self.face_provenance, sources)

    def with_provenance(self, provenance: Provenance) -> TriMesh:
        """Return the mesh with one provenance for all faces."""
        return replace(self, face_provenance=np.full(len(self.faces), provenance, dtype=np.uint8))

    def colour_at(
        self, face: Int[np.ndarray, " n"], barycentric: Float[np.ndarray, "n 3"]
    ) -> Float32[np.ndarray, "n 3"]:
        """Return the base colour at points of faces, from the texture, else from the vertices."""
        if self.texture is not None:
            return self.texture.look_up(face, barycentric)
        corners = self.base_colour[self.faces[face]]
        return (barycentric[:, :, None] * corners).sum(axis=1).astype(np.float32)

    def sun_visibility_at(
        self, face: Int[np.ndarray, " n"], barycentric: Float[np.ndarray, "n 3"]
    ) -> Float32[np.ndarray, " n"]:
        """Return the recorded sun's estimated visibility at points of faces; NaN if unknown."""
        found = self.sun_visibility
        if found is None:
            return np.full(len(face), np.nan, np.float32)
        if self.texture is not None and found.texel is not None:
            values = self.texture.look_up_in(found.texel[..., None], face, barycentric)[:, 0]
        else:
            values = (barycentric * found.vertex[self.faces[face]]).sum(axis=1)
        return (values / 255.0).astype(np.float32)

    def transformed(self, transform: RigidTransform) -> TriMesh:
        """Return the mesh in frame `transform.dst`."""
        if transform.src != self.frame:
            raise FrameMismatchError(
                "the transform does not start in the mesh's frame",
                got=transform.src,
                expected=self.frame,
            )
        vertices = transform.apply(self.vertices.astype(np.float64)).astype(np.float32)
        # Directions are rotated only.
        towards = self.towards_camera
        if towards is not None:
            towards = transform.rotate(towards.astype(np.float64)).astype(np.float32)
        return replace(self, frame=transform.dst, vertices=vertices, towards_camera=towards)

    def face_roughness(self) -> Float32[np.ndarray, " m"]:
        """Return the roughness of each face's material."""
        known = np.array([material.roughness for material in self.materials], dtype=np.float32)
        if self.face_material is None:
            return np.full(len(self.faces), known[0])
        return known[self.face_material]

    def vertex_roughness(self) -> Float32[np.ndarray, " n"]:
        """Return the least roughness of the faces around each vertex; 1 without a face."""
        # The least: the colour of a vertex at the edge of a pane may contain a reflection.
        roughness = np.ones(len(self.vertices), dtype=np.float32)
        np.minimum.at(roughness, self.faces.ravel(), np.repeat(self.face_roughness(), 3))
        return roughness

    def face_normals(self) -> Float[np.ndarray, "m 3"]:
        """Return unit normals; zero for degenerate faces."""
        across = self._edge_products()
        length = np.linalg.norm(across, axis=1, keepdims=True)
        return across / np.where(length > 0, length, 1.0)

    def face_areas_m2(self) -> Float64[np.ndarray, " m"]:
        """Return the area of each face, in square metres."""
        return np.linalg.norm(self._edge_products(), axis=1) / 2

    def _edge_products(self) -> Float64[np.ndarray, "m 3"]:
        """Return the cross product of two edges of each face: its normal times twice its area."""
        a, b, c = (self.vertices[self.faces[:, i]].astype(np.float64) for i in range(3))
        return np.cross(b - a, c - a)

    def vertex_normals(self) -> Float32[np.ndarray, "n 3"]:
        """Return area-weighted unit normals; zero for vertices without a face."""
        # Longer products of larger faces are the weights. bincount sums repeated vertices, and is
        # faster than np.add.at.
        weighted = self._edge_products()
        normals = np.zeros((len(self.vertices), 3))
        for i in range(3):
            for axis in range(3):
                normals[:, axis] += np.bincount(
                    self.faces[:, i], weighted[:, axis], minlength=len(self.vertices)
                )
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return (normals / np.where(length > 0, length, 1.0)).astype(np.float32)


def concatenate_meshes(meshes: list[TriMesh]) -> TriMesh:
    """Join several meshes of one frame.

    Textures are dropped (they belong to single meshes); confidence is retained if all have it.
    """
    if not meshes:
        raise InputError("no meshes to concatenate", expected="one mesh or more")
    frames = {mesh.frame for mesh in meshes}
    if len(frames) > 1:
        raise FrameMismatchError(
            "the meshes differ in frame", got=", ".join(sorted(frames)), expected="one of them"
        )
    # Vertex numbers of each mesh are shifted by the vertices before it.
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    materials = tuple(dict.fromkeys(m for mesh in meshes for m in mesh.materials))
    face_material = [_renumbered(mesh, materials) for mesh in meshes]
    confidence = [m.confidence for m in meshes if m.confidence is not None]
    return TriMesh(
        meshes[0].frame,
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(
            [mesh.faces + np.int32(o) for mesh, o in zip(meshes, offsets, strict=True)]
        ).astype(np.int32),
        np.concatenate([mesh.base_colour for mesh in meshes]),
        materials,
        np.concatenate(face_material) if len(materials) > 1 else None,
        None,
        np.concatenate(confidence) if len(confidence) == len(meshes) else None,
        _joined_provenance(meshes),
    )


def _joined_provenance(meshes: list[TriMesh]) -> UInt8[np.ndarray, " m"] | None:
    if all(mesh.face_provenance is None for mesh in meshes):
        return None
    return np.concatenate(
        [
            np.full(len(mesh.faces), Provenance.MEASURED, dtype=np.uint8)
            if mesh.face_provenance is None
            else mesh.face_provenance
            for mesh in meshes
        ]
    )


def _renumbered(mesh: TriMesh, materials: tuple[Material, ...]) -> UInt8[np.ndarray, " m"]:
    """Return the mesh's face materials as indices into a longer list."""
    number = np.array([materials.index(m) for m in mesh.materials], dtype=np.uint8)
    if mesh.face_material is None:
        return np.full(len(mesh.faces), number[0], dtype=np.uint8)
    return number[mesh.face_material]
