"""Reconstruction of a mesh from the primitives that `meshes.write_glb` wrote, without loss."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int, UInt8

from lightsim.core.colour import linear_from_srgb8
from lightsim.core.mesh import Provenance, Texture, TriMesh
from lightsim.store.gltf_writer import CONFIDENCE, PROVENANCE, VERTEX_COLOUR, VERTEX_NUMBER
from lightsim.store.primitives import Y_UP_FROM_Z_UP, Primitive, group_materials

# Steps per pixel to which texture coordinates are rounded; float32 numbers in [0, 1] resolve them.
_STEPS_PER_PX = 256


def rejoin(primitives: Sequence[Primitive], frame: str) -> TriMesh | None:
    """Return the mesh that `write_glb` wrote; None if another program wrote the file.

    Raises:
        ValueError: LightSim wrote the file, but its parts contradict each other.
    """
    if all(VERTEX_NUMBER not in p.own for p in primitives):
        return None
    if any(VERTEX_NUMBER not in p.own for p in primitives):
        raise ValueError("some of its parts lack their vertex numbers")
    if any(_pixels(p) is not _pixels(primitives[0]) for p in primitives):
        raise ValueError("its parts have several textures")
    is_textured = primitives[0].texture is not None
    if is_textured and any(VERTEX_COLOUR not in p.own or p.uv is None for p in primitives):
        raise ValueError("some of its parts lack colours or texture coordinates")
    number = np.concatenate([p.own[VERTEX_NUMBER][:, 0] for p in primitives])
    _, first, vertex = np.unique(number, return_index=True, return_inverse=True)
    vertices = np.concatenate([p.vertices for p in primitives])
    # All copies of a vertex must have the same position.
    if not np.array_equal(vertices[first][vertex], vertices):
        raise ValueError("the corners of its triangles do not meet")
    offsets = np.cumsum([0] + [len(p.vertices) for p in primitives[:-1]])
    corners = np.concatenate([p.faces + o for p, o in zip(primitives, offsets, strict=True)])
    own = {
        name: np.concatenate([p.own[name] for p in primitives])[first]
        for name in (VERTEX_COLOUR, CONFIDENCE)
        if all(name in p.own for p in primitives)
    }
    colour = own[VERTEX_COLOUR] if is_textured else np.concatenate([p.colour for p in primitives])
    materials, face_material = group_materials(
        [p.material for p in primitives], [len(p.faces) for p in primitives]
    )
    return TriMesh(
        frame,
        (vertices[first] @ Y_UP_FROM_Z_UP[:3, :3]).astype(np.float32),
        vertex[corners].astype(np.int32),
        (colour if is_textured else colour[first]).astype(np.float32),
        materials,
        face_material,
        _texture(primitives, corners) if is_textured else None,
        own[CONFIDENCE][:, 0].astype(np.float32) if CONFIDENCE in own else None,
        _provenance(primitives, corners),
    )


def _provenance(
    primitives: Sequence[Primitive], corners: Int[np.ndarray, "m 3"]
) -> UInt8[np.ndarray, " m"] | None:
    if all(PROVENANCE not in p.own for p in primitives):
        return None
    if any(PROVENANCE not in p.own for p in primitives):
        raise ValueError("some of its parts lack their provenance")
    of_corner = np.concatenate([p.own[PROVENANCE][:, 0] for p in primitives])[corners]
    is_known = np.isin(of_corner, list(Provenance)).all()
    if not is_known or (of_corner != of_corner[:, :1]).any():
        raise ValueError("a triangle has no provenance")
    return of_corner[:, 0].astype(np.uint8)


def _texture(primitives: Sequence[Primitive], corners: Int[np.ndarray, "m 3"]) -> Texture:
    """Return the texture with corner coordinates in pixels, rounded to undo float32 rounding."""
    image = _pixels(primitives[0])
    assert image is not None
    uv = np.concatenate([p.uv for p in primitives if p.uv is not None])
    pixels = np.rint(uv * np.array(image.shape[1::-1]) * _STEPS_PER_PX) / _STEPS_PER_PX
    return Texture(linear_from_srgb8(image[..., :3]), pixels[corners].astype(np.float32))


def _pixels(primitive: Primitive) -> UInt8[np.ndarray, "h w _"] | None:
    return None if primitive.texture is None else primitive.texture.pixels
