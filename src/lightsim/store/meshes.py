"""Triangle meshes as glTF 2.0 binary (.glb), the form that viewers and CAD libraries use.

glTF is y up; our frames are z up with x forward. The vertex data stay as they are in memory, and
a root node `gltf_from_<frame>` turns them upright for viewers. Geometry and vertex colours
(linear in glTF as they are here) are float32, nothing of them is lost; textures become 8-bit sRGB.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Float64, Int, Int32, UInt8

from lightsim.core.colour import linear_from_srgb8
from lightsim.core.mesh import Material, Provenance, Texture, TriMesh
from lightsim.errors import InputError
from lightsim.store.atomic import whole_file
from lightsim.store.gltf import Primitive, parse_glb
from lightsim.store.gltf_writer import (
    CONFIDENCE,
    PROVENANCE,
    VERTEX_COLOUR,
    VERTEX_NUMBER,
    glb_pieces,
)
from lightsim.store.reading import read_bytes

_REMEDY = "Export the model again as glTF 2.0 binary (.glb) with triangles."
_MAX_BYTES = 2 << 30
"""A street of ten million vertices takes half of it; glTF itself ends at 4 GiB."""
_MAX_FACES = 1_000_000
_MAX_MATERIALS = 256
_STEPS_PER_PX = 256
_GLTF_FROM_Z_UP = np.array(
    [[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]], dtype=np.float64
)
"""Viewer axes: x stays, our z becomes glTF's y (up), our y becomes glTF's -z."""


def write_glb(path: Path, mesh: TriMesh) -> None:
    """Write one mesh: its texture as 8-bit sRGB, or linear float vertex colours without one.

    Faces are grouped by material; materials without faces are left out.

    Raises:
        InputError: the mesh has no face, or the folder does not exist.
    """
    if not len(mesh.faces):
        raise InputError(
            "a mesh without faces is not written", where=path, expected="one face or more"
        )
    pieces = glb_pieces(mesh, _GLTF_FROM_Z_UP)
    with whole_file(path) as temporary, temporary.open("wb") as handle:
        handle.writelines(pieces)


def read_glb(path: Path, frame: str, texture_edge_m: float = 0.06) -> TriMesh:
    """All triangles of a .glb file as one mesh in `frame` (z up, x forward, metres).

    Nodes are placed by their transforms and turned from glTF's y up. A file of ours keeps its
    texture. In other files, a textured triangle is split until no edge is longer than
    `texture_edge_m` (at most a million faces), then the texture is sampled at its vertices, in
    linear light.

    Raises:
        InputError: the file is missing, damaged, or has no triangles.
    """
    data = read_bytes(path, "mesh", _MAX_BYTES)
    try:
        primitives = parse_glb(data)
        if not primitives:
            raise ValueError("it has no triangles")
        mesh = _joined(primitives, frame)
        return _foreign(primitives, frame, texture_edge_m) if mesh is None else mesh
    except (
        ValueError,
        ArithmeticError,
        LookupError,
        TypeError,
        AttributeError,
        struct.error,
    ) as error:
        raise InputError(
            "the model cannot be read",
            where=path,
            got=f"{type(error).__name__}: {error}"[:200],
            expected="glTF 2.0 binary (.glb)",
            remedy=_REMEDY,
        ) from error
    except InputError as error:
        raise InputError(
            error.what, where=path, got=error.got, expected=error.expected, remedy=_REMEDY
        ) from error


def _foreign(primitives: list[Primitive], frame: str, texture_edge_m: float) -> TriMesh:
    """Textures become vertex colours."""
    most = _MAX_FACES // len(primitives)
    parts = [_textured(p, texture_edge_m, most) for p in primitives]
    offsets = np.cumsum([0] + [len(vertices) for vertices, _, _ in parts[:-1]])
    faces = [f + np.int32(o) for (_, f, _), o in zip(parts, offsets, strict=True)]
    vertices = np.concatenate([v for v, _, _ in parts]) @ _GLTF_FROM_Z_UP[:3, :3]
    colour = np.clip(np.concatenate([c for _, _, c in parts]), 0.0, 1.0)
    materials, face_material = _materials(primitives, [len(f) for f in faces])
    return TriMesh(
        frame,
        vertices.astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        colour.astype(np.float32),
        materials,
        face_material,
    )


def _materials(
    primitives: list[Primitive], counts: list[int]
) -> tuple[tuple[Material, ...], UInt8[np.ndarray, " m"] | None]:
    """The materials that occur, and each face's; beyond 256 their face-weighted mean."""
    of_primitive = [p.material for p in primitives]
    materials = tuple(dict.fromkeys(of_primitive))
    if len(materials) > _MAX_MATERIALS:
        weights = np.array(counts, dtype=np.float64) / sum(counts)
        numbers = np.array([[m.roughness, m.metallic] for m in of_primitive])
        roughness, metallic = (weights @ numbers).tolist()
        return (Material(float(roughness), float(metallic)),), None
    if len(materials) == 1:
        return materials, None
    numbers = np.array([materials.index(m) for m in of_primitive], dtype=np.uint8)
    return materials, np.repeat(numbers, counts)


def _joined(primitives: list[Primitive], frame: str) -> TriMesh | None:
    """A mesh that `write_glb` took apart; None if it was another program that wrote the file.

    Raises:
        ValueError: it is of ours, but its parts do not fit together.
    """
    if all(VERTEX_NUMBER not in p.own for p in primitives):
        return None
    if any(VERTEX_NUMBER not in p.own for p in primitives):
        raise ValueError("some of its parts lack their vertex numbers")
    if any(p.texture is not primitives[0].texture for p in primitives):
        raise ValueError("its parts have several textures")
    is_textured = primitives[0].texture is not None
    if is_textured and any(VERTEX_COLOUR not in p.own or p.uv is None for p in primitives):
        raise ValueError("some of its parts lack colours or texture coordinates")
    number = np.concatenate([p.own[VERTEX_NUMBER][:, 0] for p in primitives])
    _, first, vertex = np.unique(number, return_index=True, return_inverse=True)
    vertices = np.concatenate([p.vertices for p in primitives])
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
    materials, face_material = _materials(primitives, [len(p.faces) for p in primitives])
    return TriMesh(
        frame,
        (vertices[first] @ _GLTF_FROM_Z_UP[:3, :3]).astype(np.float32),
        vertex[corners].astype(np.int32),
        (colour if is_textured else colour[first]).astype(np.float32),
        materials,
        face_material,
        _texture(primitives, corners) if is_textured else None,
        own[CONFIDENCE][:, 0].astype(np.float32) if CONFIDENCE in own else None,
        _provenance(primitives, corners),
    )


def _provenance(
    primitives: list[Primitive], corners: Int[np.ndarray, "m 3"]
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


def _texture(primitives: list[Primitive], corners: Int[np.ndarray, "m 3"]) -> Texture:
    """In pixels; rounded to what float32 coordinates in [0, 1] keep of them."""
    image = primitives[0].texture
    assert image is not None
    uv = np.concatenate([p.uv for p in primitives if p.uv is not None])
    pixels = np.rint(uv * np.array(image.shape[1::-1]) * _STEPS_PER_PX) / _STEPS_PER_PX
    return Texture(linear_from_srgb8(image), pixels[corners].astype(np.float32))


def _textured(
    primitive: Primitive, edge_m: float, most_faces: int
) -> tuple[Float64[np.ndarray, "n 3"], Int32[np.ndarray, "m 3"], Float32[np.ndarray, "n 3"]]:
    """Vertices, faces and linear colour with the texture multiplied in."""
    if primitive.uv is None or primitive.texture is None:
        return primitive.vertices, primitive.faces, primitive.colour
    values = np.concatenate([primitive.vertices, primitive.uv, primitive.colour], axis=1)
    values, faces = _split_long_edges(values, primitive.faces, edge_m, most_faces)
    texels = _sample_texture(primitive.texture, values[:, 3:5])
    return values[:, :3], faces, texels * values[:, 5:].astype(np.float32)


def _split_long_edges(
    values: Float64[np.ndarray, "n c"],
    faces: Int32[np.ndarray, "m 3"],
    edge_m: float,
    most_faces: int,
) -> tuple[Float64[np.ndarray, "n2 c"], Int32[np.ndarray, "m2 3"]]:
    """Halve edges longer than `edge_m` (by the first three columns) until there is none, or the
    next round would make more than `most_faces`.

    An edge is split in all its faces at once, so no cracks open.
    """
    while True:
        corners = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
        low, high = np.sort(corners, axis=1).astype(np.int64).T
        # One integer an edge: `unique` of rows takes ten times as long.
        keys, edge_of_corner = np.unique(low * len(values) + high, return_inverse=True)
        ends = values[np.stack(np.divmod(keys, len(values)), axis=1)]
        is_long = np.linalg.norm(ends[:, 0, :3] - ends[:, 1, :3], axis=1) > edge_m
        n_faces = len(faces) + int(is_long[edge_of_corner].sum())
        if not is_long.any() or n_faces > most_faces:
            return values, faces
        middle = np.full(len(keys), -1, dtype=np.int32)
        middle[is_long] = len(values) + np.arange(is_long.sum(), dtype=np.int32)
        values = np.concatenate([values, ends[is_long].mean(axis=1)])
        faces = _split_faces(faces, middle[edge_of_corner.reshape(-1)].reshape(-1, 3))


def _split_faces(
    faces: Int32[np.ndarray, "m 3"], middles: Int32[np.ndarray, "m 3"]
) -> Int32[np.ndarray, "k 3"]:
    """Faces (a, b, c) with the new vertices on ab, bc, ca (-1: none) as 1 to 4 faces each."""
    count = (middles >= 0).sum(axis=1)
    # Turned so that one split edge is ab, and with two, the whole one is ca.
    turn = np.where(count == 1, (middles >= 0).argmax(axis=1), 0)
    turn = np.where(count == 2, ((middles < 0).argmax(axis=1) + 1) % 3, turn)
    order = (np.arange(3)[None, :] + turn[:, None]) % 3
    a, b, c = np.take_along_axis(faces, order, axis=1).T
    ab, bc, ca = np.take_along_axis(middles, order, axis=1).T
    patterns = {
        0: [(a, b, c)],
        1: [(a, ab, c), (ab, b, c)],
        2: [(ab, b, bc), (a, ab, bc), (a, bc, c)],
        3: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
    }
    pieces = [
        np.stack(corners, axis=1)[count == number]
        for number, triangles in patterns.items()
        for corners in triangles
    ]
    return np.concatenate(pieces).astype(np.int32)


def _sample_texture(
    texture: UInt8[np.ndarray, "h w 3"], uv: Float[np.ndarray, "n 2"]
) -> Float32[np.ndarray, "n 3"]:
    """Bilinear look-up in linear light; coordinates repeat, row 0 is v = 0."""
    linear = linear_from_srgb8(texture)
    height, width = linear.shape[:2]
    x, y = uv[:, 0] % 1.0 * width - 0.5, uv[:, 1] % 1.0 * height - 0.5
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    left, right, top, bottom = x0 % width, (x0 + 1) % width, y0 % height, (y0 + 1) % height
    upper = linear[top, left] * (1 - fx) + linear[top, right] * fx
    lower = linear[bottom, left] * (1 - fx) + linear[bottom, right] * fx
    return (upper * (1 - fy) + lower * fy).astype(np.float32)
