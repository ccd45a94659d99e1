"""Triangle meshes as glTF 2.0 binary (.glb), the form that viewers and CAD libraries use.

glTF is y up; our frames are z up with x forward. The vertex data stay as they are in memory, and
a root node `gltf_from_<frame>` turns them upright for viewers. Vertex colours are linear in glTF
as they are here; they are stored as float32 (COLOR_0 allows it), so nothing is lost.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, UInt8

from lightsim.core.colour import linear_from_srgb8
from lightsim.core.mesh import Material, TriMesh
from lightsim.errors import InputError
from lightsim.store.atomic import read_bytes, whole_file
from lightsim.store.gltf import BINARY_CHUNK, GLB_MAGIC, JSON_CHUNK, Primitive, parse_glb

_REMEDY = "Export the model again as glTF 2.0 binary (.glb) with triangles."
_MAX_FACES = 1_000_000
_FLOAT, _UNSIGNED_INT = 5126, 5125
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_GLTF_FROM_Z_UP = np.array(
    [[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]], dtype=np.float64
)
"""Viewer axes: x stays, our z becomes glTF's y (up), our y becomes glTF's -z."""


def write_glb(path: Path, mesh: TriMesh) -> None:
    """Write one mesh with linear float vertex colours and its material's two numbers.

    Raises:
        InputError: the mesh has no face, or the folder does not exist.
    """
    if not len(mesh.faces):
        raise InputError("a mesh without faces is not written", where=path)
    arrays = (
        (mesh.vertices, _ARRAY_BUFFER),
        (np.clip(mesh.base_colour, 0.0, 1.0), _ARRAY_BUFFER),
        (mesh.faces.reshape(-1).astype("<u4"), _ELEMENT_ARRAY_BUFFER),
    )
    blobs = [np.ascontiguousarray(array).tobytes() for array, _ in arrays]
    offsets = np.cumsum([0] + [len(blob) for blob in blobs]).tolist()
    document = _document(mesh)
    document["buffers"] = [{"byteLength": offsets[-1]}]
    document["bufferViews"] = [
        {"buffer": 0, "byteOffset": offset, "byteLength": len(blob), "target": target}
        for offset, blob, (_, target) in zip(offsets, blobs, arrays, strict=False)
    ]
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + offsets[-1]
    with whole_file(path) as temporary, temporary.open("wb") as handle:
        handle.write(struct.pack("<4sII", GLB_MAGIC, 2, total))
        handle.write(struct.pack("<II", len(text), JSON_CHUNK) + text)
        handle.write(struct.pack("<II", offsets[-1], BINARY_CHUNK))
        handle.writelines(blobs)


def read_glb(path: Path, frame: str, texture_edge_m: float = 0.06) -> TriMesh:
    """All triangles of a .glb file as one mesh in `frame` (z up, x forward, metres).

    Nodes are placed by their transforms and turned from glTF's y up. A textured triangle is split
    until no edge is longer than `texture_edge_m` (at most a million faces), then the texture is
    sampled at its vertices, in linear light. Roughness and metallic are the face-weighted means
    of the materials.

    Raises:
        InputError: the file is missing, damaged, or has no triangles.
    """
    data = read_bytes(path, "mesh")
    try:
        primitives = parse_glb(data)
        if not primitives:
            raise ValueError("it has no triangles")
        parts = [_textured(p, texture_edge_m) for p in primitives]
    except (ValueError, LookupError, TypeError, AttributeError, struct.error) as error:
        raise InputError(
            "the model cannot be read",
            where=path,
            got=f"{type(error).__name__}: {error}"[:200],
            expected="glTF 2.0 binary (.glb)",
            remedy=_REMEDY,
        ) from error
    offsets = np.cumsum([0] + [len(vertices) for vertices, _, _ in parts[:-1]])
    faces = [f + np.int32(o) for (_, f, _), o in zip(parts, offsets, strict=True)]
    vertices = np.concatenate([v for v, _, _ in parts]) @ _GLTF_FROM_Z_UP[:3, :3]
    colour = np.clip(np.concatenate([c for _, _, c in parts]), 0.0, 1.0)
    weights = np.array([len(f) for f in faces], dtype=np.float64)
    materials = np.array([[p.roughness, p.metallic] for p in primitives])
    roughness, metallic = (weights @ materials / weights.sum()).tolist()
    try:
        return TriMesh(
            frame,
            vertices.astype(np.float32),
            np.concatenate(faces).astype(np.int32),
            colour.astype(np.float32),
            (Material(float(roughness), float(metallic)),),
        )
    except InputError as error:
        raise InputError(error.what, where=path, remedy=_REMEDY) from error


def _document(mesh: TriMesh) -> dict[str, Any]:
    count = len(mesh.vertices)
    accessors: list[dict[str, Any]] = [
        {
            "bufferView": 0,
            "componentType": _FLOAT,
            "count": count,
            "type": "VEC3",
            "min": mesh.vertices.min(axis=0).tolist(),
            "max": mesh.vertices.max(axis=0).tolist(),
        },
        {"bufferView": 1, "componentType": _FLOAT, "count": count, "type": "VEC3"},
        {
            "bufferView": 2,
            "componentType": _UNSIGNED_INT,
            "count": 3 * len(mesh.faces),
            "type": "SCALAR",
        },
    ]
    return {
        "asset": {"version": "2.0", "generator": "LightSim"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {
                "name": f"gltf_from_{mesh.frame}",
                "matrix": _GLTF_FROM_Z_UP.T.reshape(-1).tolist(),
                "children": [1],
            },
            {"name": mesh.frame, "mesh": 0},
        ],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
                ]
            }
        ],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorFactor": [1.0, 1.0, 1.0, 1.0],
                    "roughnessFactor": float(mesh.material.roughness),
                    "metallicFactor": float(mesh.material.metallic),
                },
                "doubleSided": True,
            }
        ],
        "accessors": accessors,
    }


def _textured(
    primitive: Primitive, edge_m: float
) -> tuple[Float64[np.ndarray, "n 3"], Int32[np.ndarray, "m 3"], Float32[np.ndarray, "n 3"]]:
    """Vertices, faces and linear colour with the texture multiplied in."""
    if primitive.uv is None or primitive.texture is None:
        return primitive.vertices, primitive.faces, primitive.colour
    values = np.concatenate([primitive.vertices, primitive.uv, primitive.colour], axis=1)
    values, faces = _split_long_edges(values, primitive.faces, edge_m)
    texels = _sample_texture(primitive.texture, values[:, 3:5])
    return values[:, :3], faces, texels * values[:, 5:].astype(np.float32)


def _split_long_edges(
    values: Float64[np.ndarray, "n c"], faces: Int32[np.ndarray, "m 3"], edge_m: float
) -> tuple[Float64[np.ndarray, "n2 c"], Int32[np.ndarray, "m2 3"]]:
    """Halve edges longer than `edge_m` (by the first three columns) until there is none.

    An edge is split in all its faces at once, so no cracks open.
    """
    while True:
        corners = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
        edges, edge_of_corner = np.unique(np.sort(corners, axis=1), axis=0, return_inverse=True)
        ends = values[edges]
        is_long = np.linalg.norm(ends[:, 0, :3] - ends[:, 1, :3], axis=1) > edge_m
        if not is_long.any() or len(faces) > _MAX_FACES:
            return values, faces
        middle = np.full(len(edges), -1, dtype=np.int32)
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
