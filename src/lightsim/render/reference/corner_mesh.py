"""Meshes for reference renderers, with separate vertices of each face, and their Mitsuba
material."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32

from lightsim.core.mesh import TriMesh
from lightsim.render.mitsuba_scene import bitmap, make_mesh

# Minimum cosine between a smooth normal and its face's normal (32 degrees). At sharper edges the
# face's normal is used, because paths that leave on the wrong side of a face pass through open
# meshes and receive light from behind. Chosen; sensitivity not measured.
_MIN_AGREEMENT = 0.85


@dataclass(frozen=True, eq=False)
class CornerMesh:
    """Mesh with separate vertices of each face, so that colour and normals may be discontinuous at
    edges.

    Args:
        vertices: of the corners, three a face.
        normals: shading normals, on the outer side of their face.
        uv: fractions of the texture's width and height from its first pixel; 0 without one.
        colour: of the vertices.
        texture: base colour; None without one.
        roughness: of each face.
        metallic: of each face.
    """

    vertices: Float32[np.ndarray, "c 3"]
    normals: Float32[np.ndarray, "c 3"]
    uv: Float32[np.ndarray, "c 2"]
    colour: Float32[np.ndarray, "c 3"]
    texture: Float32[np.ndarray, "h w 3"] | None
    roughness: Float32[np.ndarray, " m"]
    metallic: Float32[np.ndarray, " m"]


def corner_mesh(mesh: TriMesh, vertex_normals: Float32[np.ndarray, "n 3"]) -> CornerMesh:
    """Return a mesh with separate corners, and base colours clamped by `as_albedo`."""
    corners = mesh.faces.ravel()
    face_normals = np.repeat(mesh.face_normals(), 3, axis=0)
    smooth = vertex_normals[corners].astype(np.float64)
    smooth = smooth / np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-30)
    agreement = (smooth * face_normals).sum(axis=1, keepdims=True)
    smooth = np.where(agreement < 0, -smooth, smooth)
    normals = np.where(np.abs(agreement) < _MIN_AGREEMENT, face_normals, smooth)
    kind = np.zeros(len(mesh.faces), np.uint8) if mesh.face_material is None else mesh.face_material
    uv = np.zeros((len(corners), 2), dtype=np.float32)
    image = None
    if mesh.texture is not None:
        image = as_albedo(mesh.texture.image)
        size = np.array([image.shape[1], image.shape[0]], dtype=np.float32)
        uv = (mesh.texture.corner_uv.reshape(-1, 2) / size).astype(np.float32)
    roughness = np.array([m.roughness for m in mesh.materials], dtype=np.float32)[kind]
    return CornerMesh(
        mesh.vertices[corners],
        normals.astype(np.float32),
        uv,
        as_albedo(mesh.base_colour[corners]),
        image,
        roughness,
        np.array([m.metallic for m in mesh.materials], dtype=np.float32)[kind],
    )


def as_albedo(colour: Float32[np.ndarray, "*n 3"]) -> Float32[np.ndarray, "*n 3"]:
    """Return the colour clamped to [0.01, 1].

    The upper bound conserves energy. The lower bound allows dividing diffuse radiance by the base
    colour to obtain the irradiance.
    """
    return np.clip(colour, 0.01, 1.0).astype(np.float32)


def mitsuba_mesh(mi: Any, name: str, mesh: CornerMesh, is_principled: bool) -> Any:
    """Return a Mitsuba mesh with its material, two-sided."""
    parameters = {
        "vertex_positions": mesh.vertices,
        "vertex_normals": mesh.normals,
        "vertex_texcoords": mesh.uv,
        "faces": np.arange(len(mesh.vertices), dtype=np.uint32).reshape(-1, 3),
    }
    attributes = {
        "vertex_color": mesh.colour,
        "face_roughness": mesh.roughness,
        "face_metallic": mesh.metallic,
    }
    return make_mesh(mi, name, parameters, _bsdf(mi, mesh, is_principled), attributes)


def _bsdf(mi: Any, mesh: CornerMesh, is_principled: bool) -> Any:
    colour: dict[str, Any] = {"type": "mesh_attribute", "name": "vertex_color"}
    if mesh.texture is not None:
        colour = bitmap(mi, mesh.texture, "clamp")
    inner: dict[str, Any] = {"type": "diffuse", "reflectance": colour}
    if is_principled:
        # The Principled diffuse lobe brightens towards grazing angles (Burley 2012), on rough faces
        # by some 10 %; the light transport matrix uses Lambert's. `specular` 0.5 reflects 4 % at
        # normal incidence, a refractive index of 1.5.
        inner = {
            "type": "principled",
            "base_color": colour,
            "roughness": {"type": "mesh_attribute", "name": "face_roughness"},
            "metallic": {"type": "mesh_attribute", "name": "face_metallic"},
            "specular": 0.5,
        }
    return mi.load_dict({"type": "twosided", "material": inner})
