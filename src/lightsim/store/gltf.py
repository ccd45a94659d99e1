"""A reader of binary glTF 2.0: triangles, linear colours, base-colour textures, node transforms.

Reference: Khronos glTF 2.0 specification (registry.khronos.org/glTF/specs/2.0).
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Shaped
from scipy.spatial.transform import Rotation

from lightsim.core.mesh import Material
from lightsim.errors import InputError
from lightsim.store.images import decode_srgb8
from lightsim.store.primitives import ImageTexture, ModelFile, Primitive
from lightsim.store.reading import MAX_JSON_BYTES, read_bytes

_REMEDY = "Export the model again as glTF 2.0 binary (.glb) with triangles."
_MAX_BYTES = 2 << 30
"""A street of ten million vertices takes half of it; glTF itself ends at 4 GiB."""

GLB_MAGIC = b"glTF"
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
_DTYPE_BY_COMPONENT = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTH_BY_TYPE = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_UNDERSTOOD = {"KHR_mesh_quantization", "KHR_materials_unlit", "KHR_materials_specular"}
_TRIANGLES = 4
_MAX_DEPTH = 64
_MAX_INSTANCES = 100_000
_MAX_VERTICES = 20_000_000
"""Of all instances together; our largest street has half of it."""


def read_gltf(path: Path) -> ModelFile:
    """Return the triangles of a .glb or .gltf file, with notes on what was not read.

    Raises:
        InputError: the file is missing or damaged, has no triangles, or needs an extension that is
            not supported.
    """
    try:
        primitives = parse_glb(read_bytes(path, "model", _MAX_BYTES))
        if not primitives:
            raise ValueError("it has no triangles")
    except (ValueError, ArithmeticError, LookupError, TypeError, AttributeError, struct.error) as e:
        raise InputError(
            "the model cannot be read",
            where=path,
            got=f"{type(e).__name__}: {e}"[:200],
            expected="glTF 2.0",
            remedy=_REMEDY,
        ) from e
    return ModelFile(path, tuple(primitives))


def parse_glb(data: bytes) -> list[Primitive]:
    """All triangles of the default scene; points and lines are left out.

    A material that does not name its metallic factor counts as non-metallic: exporters of older
    formats leave it out, and the standard's 1 would leave such models without diffuse colour.

    Raises:
        ValueError, LookupError, TypeError, struct.error: the file breaks the standard, or needs
            an extension that is not understood.
    """
    document, binary = _chunks(data)
    required = set(document.get("extensionsRequired", ())) - _UNDERSTOOD
    if required:
        raise ValueError(f"it needs the extensions {sorted(required)}, which are not understood")
    file = _File(document, binary)
    primitives: list[Primitive] = []
    n_vertices = 0
    for matrix, mesh_index in file.placed_meshes():
        for primitive in document["meshes"][mesh_index]["primitives"]:
            if primitive.get("mode", _TRIANGLES) > _TRIANGLES:
                raise ValueError("triangle strips and fans are not understood")
            if primitive.get("mode", _TRIANGLES) == _TRIANGLES:
                primitives.append(file.primitive(primitive, matrix))
                n_vertices += len(primitives[-1].vertices)
            if n_vertices > _MAX_VERTICES:
                raise ValueError(f"its instances have more than {_MAX_VERTICES} vertices")
    return [p for p in primitives if len(p.faces)]


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, total = struct.unpack_from("<4sII", data)
    if magic != GLB_MAGIC or version != 2:
        raise ValueError(f"it is no glTF 2 binary file but {magic!r} version {version}")
    if total > len(data):
        raise ValueError(f"it is truncated: {len(data)} of {total} bytes")
    chunks: dict[int, bytes] = {}
    position = 12
    while position + 8 <= total:
        length, kind = struct.unpack_from("<II", data, position)
        if position + 8 + length > total:
            raise ValueError("a chunk runs past the end")
        chunks.setdefault(kind, data[position + 8 : position + 8 + length])
        position += 8 + length
    if len(chunks[JSON_CHUNK]) > MAX_JSON_BYTES:
        raise ValueError(f"its JSON has {len(chunks[JSON_CHUNK])} bytes")
    try:
        document = json.loads(chunks[JSON_CHUNK])
    except RecursionError as error:
        raise ValueError("its JSON is nested too deep") from error
    if not isinstance(document, dict):
        raise ValueError("its JSON is no object")
    return document, chunks.get(BINARY_CHUNK, b"")


@dataclass(frozen=True, eq=False)
class _File:
    document: dict[str, Any]
    binary: bytes
    images: dict[int, ImageTexture] = field(default_factory=dict)

    def placed_meshes(self) -> Iterator[tuple[Float64[np.ndarray, "4 4"], int]]:
        """(scene_from_mesh, mesh index) of every node with a mesh."""
        nodes = self.document.get("nodes", [])
        if "scenes" in self.document:
            roots = self.document["scenes"][self.document.get("scene", 0)].get("nodes", [])
        else:
            children = {c for node in nodes for c in node.get("children", ())}
            roots = [i for i in range(len(nodes)) if i not in children]
        stack = [(np.eye(4), root, 0) for root in roots]
        visited = 0
        while stack:
            parent, index, depth = stack.pop()
            visited += 1
            if depth > _MAX_DEPTH or visited > _MAX_INSTANCES:
                raise ValueError("its nodes form a loop or are nested too deep")
            node = nodes[index]
            matrix = parent @ _node_matrix(node)
            if "mesh" in node:
                yield matrix, int(node["mesh"])
            stack.extend((matrix, child, depth + 1) for child in node.get("children", ()))

    def primitive(self, value: dict[str, Any], matrix: Float64[np.ndarray, "4 4"]) -> Primitive:
        """One primitive with its vertices in the scene's frame; ValueError for bad indices."""
        attributes = value["attributes"]
        local = self.accessor(attributes["POSITION"]).astype(np.float64)
        vertices = local @ matrix[:3, :3].T + matrix[:3, 3]
        if "indices" in value:
            indices = self.accessor(value["indices"]).astype(np.int64).reshape(-1)
        else:
            indices = np.arange(len(vertices))
        faces = indices[: len(indices) // 3 * 3].reshape(-1, 3).astype(np.int32)
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise ValueError("a triangle names no vertex")
        if np.linalg.det(matrix[:3, :3]) < 0:
            faces = np.ascontiguousarray(faces[:, ::-1])
        material = self.document["materials"][value["material"]] if "material" in value else {}
        pbr = material.get("pbrMetallicRoughness", {})
        colour = np.ones((len(vertices), 3), dtype=np.float32)
        if "COLOR_0" in attributes:
            colour = self.accessor(attributes["COLOR_0"])[:, :3].astype(np.float32)
        colour = colour * np.array(pbr.get("baseColorFactor", [1.0] * 4), np.float32)[:3]
        uv, texture = self._texture(pbr, attributes)
        own = {
            name: self.accessor(index).astype(np.float32)
            for name, index in attributes.items()
            if name.startswith("_")
        }
        if any(len(values) != len(vertices) for values in own.values()):
            raise ValueError("an attribute has other vertices")
        return Primitive(vertices, faces, colour, uv, texture, _material(material, value), own)

    def _texture(
        self, pbr: dict[str, Any], attributes: dict[str, Any]
    ) -> tuple[Float64[np.ndarray, "n 2"] | None, ImageTexture | None]:
        if "baseColorTexture" not in pbr:
            return None, None
        reference = pbr["baseColorTexture"]
        name = f"TEXCOORD_{int(reference.get('texCoord', 0))}"
        if name not in attributes:
            return None, None
        uv = self.accessor(attributes[name]).astype(np.float64)
        if uv.shape[1] != 2 or not np.isfinite(uv).all():
            raise ValueError("a texture coordinate is broken")
        texture = self.document["textures"][reference["index"]]
        source = int(texture["source"])
        if source not in self.images:
            pixels = decode_srgb8(self._image_bytes(self.document["images"][source]))
            self.images[source] = ImageTexture(pixels)
        return uv, self.images[source]

    def _image_bytes(self, image: dict[str, Any]) -> bytes:
        if "bufferView" in image:
            start, length, _ = self._view(image["bufferView"])
            return self.binary[start : start + length]
        head, _, body = image["uri"].partition(",")
        if not head.startswith("data:"):
            raise ValueError(f"its texture is another file ({image['uri'][:60]}); embed it")
        return base64.b64decode(body)

    def _view(self, index: int) -> tuple[int, int, int]:
        view = self.document["bufferViews"][index]
        if view.get("buffer", 0) != 0 or "uri" in self.document["buffers"][0]:
            raise ValueError("its data lie in another file; embed them")
        start, length = int(view.get("byteOffset", 0)), int(view["byteLength"])
        if start < 0 or length < 0 or start + length > len(self.binary):
            raise ValueError("a buffer view runs past the end")
        return start, length, int(view.get("byteStride", 0))

    def accessor(self, index: int) -> Shaped[np.ndarray, "n c"]:
        """Rows of an accessor; normalised integers come as floats in [0, 1] or [-1, 1]."""
        accessor = self.document["accessors"][index]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError("sparse accessors are not understood")
        dtype = np.dtype(_DTYPE_BY_COMPONENT[accessor["componentType"]])
        width, count = _WIDTH_BY_TYPE[accessor["type"]], int(accessor["count"])
        start, length, stride = self._view(accessor["bufferView"])
        offset = int(accessor.get("byteOffset", 0))
        stride = stride or width * dtype.itemsize
        needed = offset + stride * (count - 1) + width * dtype.itemsize
        if count < 1 or offset < 0 or stride < width * dtype.itemsize or needed > length:
            raise ValueError("an accessor runs past its buffer view")
        rows = np.ndarray(
            (count, width), dtype, self.binary, start + offset, (stride, dtype.itemsize)
        )
        if not accessor.get("normalized", False):
            return rows.copy()
        return np.maximum(rows.astype(np.float32) / np.iinfo(dtype).max, np.float32(-1.0))


def _material(material: dict[str, Any], primitive: dict[str, Any]) -> Material:
    pbr = material.get("pbrMetallicRoughness", {})
    name = material.get("name", f"material {primitive.get('material', 'by default')}")
    roughness, metallic = pbr.get("roughnessFactor", 1.0), pbr.get("metallicFactor", 0.0)
    return Material(float(roughness), float(metallic), str(name))


def _node_matrix(node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    if "matrix" in node:
        matrix = np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    else:
        matrix = np.eye(4)
        if "rotation" in node:
            quaternion = np.array(node["rotation"], dtype=np.float64)
            if not (np.abs(quaternion) < 2.0).all():
                raise ValueError("a node's rotation is no unit quaternion")
            matrix[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
        matrix[:3, :3] *= np.array(node.get("scale", [1.0] * 3), dtype=np.float64)
        matrix[:3, 3] = np.array(node.get("translation", [0.0] * 3), dtype=np.float64)
    if not np.isfinite(matrix).all():
        raise ValueError("a node's transform is not finite")
    return matrix
