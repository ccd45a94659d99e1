"""Writer of binary glTF 2.0: one mesh, one primitive per material.

A textured mesh is written with one vertex per corner of each face, since texture coordinates of a
vertex may differ between faces. A mesh without a texture is written with one vertex per provenance
of the adjacent faces. Application-specific attributes (names start with "_", section 3.7.2.1) store
the original vertex number, colour, confidence and provenance, from which `meshes.read_glb` restores
the mesh.

Reference: Khronos glTF 2.0 specification (registry.khronos.org/glTF/specs/2.0).
"""

from __future__ import annotations

import io
import json
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int, Int32, Int64, Shaped, UInt8

from lightsim.core.colour import srgb8_from_linear
from lightsim.core.mesh import Material, Provenance, TriMesh
from lightsim.store.gltf_accessors import WIDTH_BY_TYPE
from lightsim.store.gltf_document import GLB_MAGIC, GltfCode

# Attribute names of the original vertex number, base colour, confidence and provenance.
VERTEX_NUMBER = "_VERTEX"
VERTEX_COLOUR = "_BASE_COLOUR"
CONFIDENCE = "_CONFIDENCE"
PROVENANCE = "_PROVENANCE"
_TYPE_BY_WIDTH = {width: name for name, width in WIDTH_BY_TYPE.items()}


@dataclass(eq=False)
class GltfFile:
    """A glTF document under construction, and its binary data."""

    document: dict[str, Any]
    blobs: list[bytes] = field(default_factory=list)
    size: int = 0

    def add_view(self, blob: bytes, target: int | None = None) -> int:
        """Append a buffer view, padded to 4 bytes (section 3.6.2.4), and return its index."""
        blob += b"\0" * (-len(blob) % 4)
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": len(blob)}
        if target is not None:
            view["target"] = target
        self.document["bufferViews"].append(view)
        self.blobs.append(blob)
        self.size += len(blob)
        return len(self.document["bufferViews"]) - 1

    def add_accessor(
        self, values: Shaped[np.ndarray, "n *c"], target: int = GltfCode.ARRAY_BUFFER
    ) -> int:
        """Append an accessor of float attributes, or of vertex indices, and return its index."""
        is_index = target == GltfCode.ELEMENT_ARRAY_BUFFER
        array = np.ascontiguousarray(values, dtype="<u4" if is_index else "<f4")
        accessor: dict[str, Any] = {
            "bufferView": self.add_view(array.tobytes(), target),
            "componentType": GltfCode.UNSIGNED_INT if is_index else GltfCode.FLOAT,
            "count": len(array),
            "type": _TYPE_BY_WIDTH[array.shape[1] if array.ndim == 2 else 1],
        }
        self.document["accessors"].append(accessor)
        return len(self.document["accessors"]) - 1

    def add_positions(self, positions: Float32[np.ndarray, "n 3"]) -> int:
        """Append an accessor of positions with their bounds, which the standard requires."""
        index = self.add_accessor(positions)
        low, high = positions.min(axis=0).tolist(), positions.max(axis=0).tolist()
        self.document["accessors"][index] |= {"min": low, "max": high}
        return index

    def to_bytes(self) -> list[bytes]:
        """Return the pieces whose concatenation is the file."""
        self.document["buffers"] = [{"byteLength": self.size}]
        text = json.dumps(self.document, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + self.size
        head = struct.pack("<4sII", GLB_MAGIC, 2, total)
        head += struct.pack("<II", len(text), GltfCode.JSON_CHUNK) + text
        return [head, struct.pack("<II", self.size, GltfCode.BINARY_CHUNK), *self.blobs]


def glb_pieces(mesh: TriMesh, gltf_from_mesh: Float64[np.ndarray, "4 4"]) -> list[bytes]:
    """Return the bytes of a .glb file with one mesh, in pieces.

    Base colour becomes an 8-bit sRGB texture, or linear float vertex colours if the mesh has no
    texture. Faces are grouped by material.
    """
    file = GltfFile(_document(mesh, gltf_from_mesh))
    if mesh.texture is None:
        primitives = _with_vertex_colours(file, mesh)
    else:
        _add_texture(file, srgb8_from_linear(mesh.texture.image))
        primitives = _with_texture(file, mesh)
    file.document["meshes"] = [{"primitives": primitives}]
    return file.to_bytes()


def _document(mesh: TriMesh, gltf_from_mesh: Float64[np.ndarray, "4 4"]) -> dict[str, Any]:
    texture = {} if mesh.texture is None else {"baseColorTexture": {"index": 0}}
    return {
        "asset": {"version": "2.0", "generator": "LightSim"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {
                "name": f"gltf_from_{mesh.frame}",
                "matrix": gltf_from_mesh.T.reshape(-1).tolist(),
                "children": [1],
            },
            {"name": mesh.frame, "mesh": 0},
        ],
        "materials": [_material(material, texture) for material in mesh.materials],
        "accessors": [],
        "bufferViews": [],
    }


def _material(material: Material, texture: dict[str, Any]) -> dict[str, Any]:
    return {
        "name": material.name,
        "pbrMetallicRoughness": {
            "baseColorFactor": [1.0, 1.0, 1.0, 1.0],
            "roughnessFactor": float(material.roughness),
            "metallicFactor": float(material.metallic),
            **texture,
        },
        "doubleSided": True,
    }


def _add_texture(file: GltfFile, srgb8: UInt8[np.ndarray, "h w 3"]) -> None:
    """Add the base colour texture; without mipmaps, which would mix texels of adjacent faces."""
    from PIL import Image

    handle = io.BytesIO()
    # Level 2 instead of zlib's 6 for speed; the effect on time and size is not measured.
    Image.fromarray(srgb8).save(handle, format="PNG", compress_level=2)
    file.document["images"] = [
        {"bufferView": file.add_view(handle.getvalue()), "mimeType": "image/png"}
    ]
    wrap = {"wrapS": GltfCode.CLAMP_TO_EDGE, "wrapT": GltfCode.CLAMP_TO_EDGE}
    filters = {"magFilter": GltfCode.LINEAR, "minFilter": GltfCode.LINEAR}
    file.document["samplers"] = [{**filters, **wrap}]
    file.document["textures"] = [{"source": 0, "sampler": 0}]


def _groups(mesh: TriMesh) -> list[tuple[int, Int32[np.ndarray, " k"]]]:
    """Return the face numbers of each material that has faces."""
    if mesh.face_material is None:
        return [(0, np.arange(len(mesh.faces), dtype=np.int32))]
    groups = [
        (number, np.flatnonzero(mesh.face_material == number).astype(np.int32))
        for number in range(len(mesh.materials))
    ]
    return [(number, faces) for number, faces in groups if len(faces)]


def _with_vertex_colours(file: GltfFile, mesh: TriMesh) -> list[dict[str, Any]]:
    number, corners, provenance = _split_by_provenance(mesh)
    attributes = {
        "POSITION": file.add_positions(mesh.vertices[number]),
        "COLOR_0": file.add_accessor(np.clip(mesh.base_colour[number], 0.0, 1.0)),
    }
    groups = _groups(mesh)
    if mesh.confidence is not None:
        attributes[CONFIDENCE] = file.add_accessor(mesh.confidence[number])
    if provenance is not None:
        attributes[PROVENANCE] = file.add_accessor(provenance)
    if len(groups) > 1 or mesh.confidence is not None or provenance is not None:
        attributes[VERTEX_NUMBER] = file.add_accessor(number)
    return [
        {
            "attributes": attributes,
            "indices": file.add_accessor(corners[faces].reshape(-1), GltfCode.ELEMENT_ARRAY_BUFFER),
            "material": material,
        }
        for material, faces in groups
    ]


def _split_by_provenance(
    mesh: TriMesh,
) -> tuple[Int64[np.ndarray, " v"], Int[np.ndarray, "m 3"], Int64[np.ndarray, " v"] | None]:
    """Duplicate vertices whose faces differ in provenance.

    Returns:
        The original number of each vertex to write, the corners of the faces among these vertices,
        and the provenance of each vertex (None if the mesh has no provenance).
    """
    if mesh.face_provenance is None:
        return np.arange(len(mesh.vertices)), mesh.faces, None
    # One number for each pair of vertex and provenance.
    pairs = mesh.faces * np.int64(len(Provenance)) + mesh.face_provenance[:, None]
    pairs, corners = np.unique(pairs, return_inverse=True)
    number, provenance = np.divmod(pairs, len(Provenance))
    return number, corners.reshape(-1, 3), provenance


def _with_texture(file: GltfFile, mesh: TriMesh) -> list[dict[str, Any]]:
    assert mesh.texture is not None
    size = np.array(mesh.texture.image.shape[1::-1], dtype=np.float32)
    primitives: list[dict[str, Any]] = []
    for material, faces in _groups(mesh):
        corners = mesh.faces[faces].reshape(-1)
        uv = mesh.texture.corner_uv[faces].reshape(-1, 2) / size
        attributes = {
            "POSITION": file.add_positions(mesh.vertices[corners]),
            "TEXCOORD_0": file.add_accessor(uv),
            VERTEX_NUMBER: file.add_accessor(corners),
            VERTEX_COLOUR: file.add_accessor(np.clip(mesh.base_colour[corners], 0.0, 1.0)),
        }
        if mesh.confidence is not None:
            attributes[CONFIDENCE] = file.add_accessor(mesh.confidence[corners])
        if mesh.face_provenance is not None:
            attributes[PROVENANCE] = file.add_accessor(np.repeat(mesh.face_provenance[faces], 3))
        primitives.append({"attributes": attributes, "material": material})
    return primitives
