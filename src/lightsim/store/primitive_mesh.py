"""One mesh of the primitives of a model file: textures become vertex colours, alpha shape."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32

from lightsim.core.colour import linear_from_srgb8
from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError
from lightsim.store.primitives import (
    Y_UP_FROM_Z_UP,
    ImageTexture,
    ModelFile,
    Primitive,
    group_materials,
)
from lightsim.store.rejoin import rejoin
from lightsim.store.subdivide import split_long_edges

_MAX_FACES = 1_000_000
"""Of a model after its textured triangles are split."""


def mesh_of(
    model: ModelFile, frame: str = "actor", texture_edge_m: float = 0.06
) -> tuple[TriMesh, tuple[str, ...]]:
    """Join the primitives of a model file (y up, x stays) as one mesh in `frame` (z up).

    A file that `meshes.write_glb` wrote keeps its texture and vertices. In other files, a textured
    triangle is split until no edge is longer than `texture_edge_m` (at most a million faces), then
    the texture is sampled at its vertices, in linear light.

    Args:
        model: result of `read_gltf` or `read_obj`.
        texture_edge_m: in units of the file: divide by its metres per unit.

    Returns:
        The mesh in units of the file, and the notes of the file with those of this conversion.

    Raises:
        InputError: a file of LightSim's own writer is damaged, or nothing of the model is visible
            because its alpha is 0 everywhere.
    """
    try:
        mesh = rejoin(model.primitives, frame)
    except ValueError as error:
        raise InputError(
            "the mesh is damaged", where=model.path, got=error, remedy="Write or copy it again."
        ) from error
    if mesh is None:
        mesh = _foreign(list(model.primitives), frame, texture_edge_m)
    return mesh, model.notes


def _foreign(primitives: list[Primitive], frame: str, texture_edge_m: float) -> TriMesh:
    """Textures become vertex colours."""
    most = _MAX_FACES // len(primitives)
    parts = [_textured(p, texture_edge_m, most) for p in primitives]
    offsets = np.cumsum([0] + [len(vertices) for vertices, _, _ in parts[:-1]])
    faces = [f + np.int32(o) for (_, f, _), o in zip(parts, offsets, strict=True)]
    vertices = np.concatenate([v for v, _, _ in parts]) @ Y_UP_FROM_Z_UP[:3, :3]
    colour = np.clip(np.concatenate([c for _, _, c in parts]), 0.0, 1.0)
    materials, face_material = group_materials(primitives, [len(f) for f in faces])
    return TriMesh(
        frame,
        vertices.astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        colour.astype(np.float32),
        materials,
        face_material,
    )


def _textured(
    primitive: Primitive, edge_m: float, most_faces: int
) -> tuple[Float64[np.ndarray, "n 3"], Int32[np.ndarray, "m 3"], Float32[np.ndarray, "n 3"]]:
    """Vertices, faces and linear colour with the texture multiplied in."""
    if primitive.uv is None or primitive.texture is None:
        return primitive.vertices, primitive.faces, primitive.colour
    values = np.concatenate([primitive.vertices, primitive.uv, primitive.colour], axis=1)
    values, faces = split_long_edges(values, primitive.faces, edge_m, most_faces)
    texels = _sample_texture(primitive.texture, values[:, 3:5])
    return values[:, :3], faces, texels * values[:, 5:].astype(np.float32)


def _sample_texture(
    texture: ImageTexture, uv: Float[np.ndarray, "n 2"]
) -> Float32[np.ndarray, "n 3"]:
    """Bilinear look-up in linear light; coordinates repeat, row 0 is v = 0."""
    linear = linear_from_srgb8(texture.pixels[..., :3])
    height, width = linear.shape[:2]
    x, y = uv[:, 0] % 1.0 * width - 0.5, uv[:, 1] % 1.0 * height - 0.5
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    left, right, top, bottom = x0 % width, (x0 + 1) % width, y0 % height, (y0 + 1) % height
    upper = linear[top, left] * (1 - fx) + linear[top, right] * fx
    lower = linear[bottom, left] * (1 - fx) + linear[bottom, right] * fx
    return (upper * (1 - fy) + lower * fy).astype(np.float32)
