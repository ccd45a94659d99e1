"""A scene as Mitsuba 3 wants it: corner meshes, materials, and the sky with its sun as lights."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32

from lightsim.core.dome import Sun
from lightsim.core.mesh import MATTE_ROUGHNESS, TriMesh

_MIN_LLVM = 17
_SUN_DISTANCE_M = 2.0e5
"""Far enough that the sun's direction changes by 0.03 degrees over 100 m."""
_SPECULAR = 0.5
"""Reflects 4 % at normal incidence, an index of 1.5."""
_LOWEST_BASE_COLOUR = 0.01
"""Diffuse radiance is divided by the base colour to get the light that arrives."""
_LEAST_AGREEMENT = 0.85
"""Smooth normals farther off their face (hard edges) give way to the face's own: paths that leave
on the wrong side of a face pass through open meshes and bring light from behind."""


def choose_variant() -> str:
    """`cuda_ad_rgb` with a CUDA device; `llvm_ad_rgb` where DRJIT_LIBLLVM_PATH names an LLVM of
    at least version 17; else `scalar_rgb`.

    Versions 14 to 16 cannot translate Mitsuba's kernels for every processor and end the process,
    and Mitsuba by itself takes the first one it finds; so LLVM is used only when named.
    """
    if _has_cuda():
        return "cuda_ad_rgb"
    named = Path(os.environ.get("DRJIT_LIBLLVM_PATH", "")).name
    version = re.search(r"LLVM(?:-|\.so\.)(\d+)", named)
    return "llvm_ad_rgb" if version and int(version.group(1)) >= _MIN_LLVM else "scalar_rgb"


def _has_cuda() -> bool:
    import torch

    return torch.cuda.is_available()


@dataclass(frozen=True, eq=False)
class CornerMesh:
    """A mesh whose faces share no vertices, so that colour and normals may jump at edges.

    Args:
        vertices: of the corners, three a face.
        normals: shading normals; on the outer side of their face.
        uv: fractions of the texture's width and height from its first pixel; 0 without one.
        colour: of the vertices.
        roughness: of each face.
        metallic: of each face.
        specular: of each face: 0.5 reflects 4 % at normal incidence, 0 nothing (metals apart).
    """

    vertices: Float32[np.ndarray, "c 3"]
    normals: Float32[np.ndarray, "c 3"]
    uv: Float32[np.ndarray, "c 2"]
    colour: Float32[np.ndarray, "c 3"]
    texture: Float32[np.ndarray, "h w 3"] | None
    roughness: Float32[np.ndarray, " m"]
    metallic: Float32[np.ndarray, " m"]
    specular: Float32[np.ndarray, " m"]


def corner_mesh(mesh: TriMesh, vertex_normals: Float32[np.ndarray, "n 3"]) -> CornerMesh:
    """Base colours are kept within [0.01, 1], as an energy-conserving renderer needs them."""
    corners = mesh.faces.ravel()
    face_normals = np.repeat(mesh.face_normals(), 3, axis=0)
    smooth = vertex_normals[corners].astype(np.float64)
    smooth = smooth / np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-30)
    agreement = (smooth * face_normals).sum(axis=1, keepdims=True)
    smooth = np.where(agreement < 0, -smooth, smooth)
    normals = np.where(np.abs(agreement) < _LEAST_AGREEMENT, face_normals, smooth)
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
        np.where(roughness < MATTE_ROUGHNESS, _SPECULAR, 0.0).astype(np.float32),
    )


def as_albedo(colour: Float32[np.ndarray, "*n 3"]) -> Float32[np.ndarray, "*n 3"]:
    """Kept within [0.01, 1]."""
    return np.clip(colour, _LOWEST_BASE_COLOUR, 1.0).astype(np.float32)


def mitsuba_mesh(mi: Any, name: str, mesh: CornerMesh, is_principled: bool) -> Any:
    """A Mitsuba mesh with its material, two-sided."""
    properties = mi.Properties()
    properties["bsdf"] = _bsdf(mi, mesh, is_principled)
    count = len(mesh.vertices)
    body = mi.Mesh(
        name,
        count,
        count // 3,
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=properties,
    )
    # Attributes come first: the last update of the parameters makes all of it known.
    for key, width, value in (
        ("vertex_color", 3, mesh.colour),
        ("face_roughness", 1, mesh.roughness),
        ("face_metallic", 1, mesh.metallic),
        ("face_lobe", 1, _has_lobe(mesh).astype(np.float32)),
    ):
        body.add_attribute(key, width, value.ravel())
    parameters = mi.traverse(body)
    for key, value in (
        ("vertex_positions", mesh.vertices),
        ("vertex_normals", mesh.normals),
        ("vertex_texcoords", mesh.uv),
        ("faces", np.arange(count, dtype=np.uint32)),
    ):
        parameters[key] = type(parameters[key])(np.ascontiguousarray(value).ravel())
    parameters.update()
    return body


def _bsdf(mi: Any, mesh: CornerMesh, is_principled: bool) -> Any:
    colour: dict[str, Any] = {"type": "mesh_attribute", "name": "vertex_color"}
    if mesh.texture is not None:
        colour = {
            "type": "bitmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(mesh.texture)),
            "raw": True,
            "filter_type": "bilinear",
            "wrap_mode": "clamp",
        }
    inner: dict[str, Any] = {"type": "diffuse", "reflectance": colour}
    if is_principled and _has_lobe(mesh).any():
        principled = {
            "type": "principled",
            "base_color": colour,
            "roughness": {"type": "mesh_attribute", "name": "face_roughness"},
            "metallic": {"type": "mesh_attribute", "name": "face_metallic"},
            "specular": _SPECULAR,
        }
        lobe = {"type": "mesh_attribute", "name": "face_lobe"}
        inner = {"type": "blendbsdf", "weight": lobe, "matte": inner, "glossy": principled}
    return mi.load_dict({"type": "twosided", "material": inner})


def _has_lobe(mesh: CornerMesh) -> Bool[np.ndarray, " m"]:
    """Faces with a specular lobe; the others are Lambert's: Mitsuba's own diffuse lobe for rough
    surfaces (Burley 2012) reflects more than the base colour at grazing angles."""
    return (mesh.specular > 0) | (mesh.metallic > 0)


def mitsuba_sky(mi: Any, radiance: Float32[np.ndarray, "h w 3"]) -> dict[str, Any]:
    axes = [[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(rows_at_edges(radiance))),
        "to_world": mi.ScalarTransform4f(axes),
    }


def rows_at_edges(radiance: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "r w 3"]:
    """Mitsuba puts the first and the last row at the poles. With 2h + 1 rows its interpolation
    is that of `core.equirect.sample_bilinear`."""
    height = len(radiance)
    rows = np.empty((2 * height + 1, *radiance.shape[1:]), dtype=np.float32)
    rows[1::2] = radiance
    rows[2:-1:2] = (radiance[1:] + radiance[:-1]) / 2
    rows[0], rows[-1] = radiance[0], radiance[-1]
    return rows


def mitsuba_sun(mi: Any, sun: Sun, around_world: Float[np.ndarray, "3"]) -> dict[str, Any]:
    """A glowing disc of the sun's angular size: one light of its own is sampled far better than a
    few bright texels of the sky, and it shows in reflections."""
    radius = np.radians(sun.angular_radius_deg)
    towards = sun.direction_world / np.linalg.norm(sun.direction_world)
    helper = [1.0, 0.0, 0.0] if abs(towards[0]) < 0.9 else [0.0, 1.0, 0.0]
    place = mi.ScalarTransform4f().look_at(
        origin=(around_world + _SUN_DISTANCE_M * towards).tolist(),
        target=around_world.tolist(),
        up=helper,
    )
    radiance = sun.irradiance.astype(np.float64) / (np.pi * np.sin(radius) ** 2)
    return {
        "type": "disk",
        "to_world": place @ mi.ScalarTransform4f().scale(_SUN_DISTANCE_M * float(np.tan(radius))),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance.tolist()}},
    }
