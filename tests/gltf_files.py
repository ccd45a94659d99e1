"""Builds small glTF files in tests, in every form that exporters write."""

from __future__ import annotations

import base64
import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

_COMPONENT = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_TYPE = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
BOX = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)  # fmt: skip
QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
QUAD_FACES = np.array([[0, 1, 2], [0, 2, 3]])
QUAD_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)


class GltfBuilder:
    """A document and its one buffer; `document` may be changed freely before it is written."""

    def __init__(self, **top: Any) -> None:
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}], "meshes": [{"primitives": []}], "materials": [],
            "accessors": [], "bufferViews": [], "textures": [], "images": [], "samplers": [], **top,
        }  # fmt: skip
        self.blob = b""

    def view(self, data: bytes, **more: Any) -> int:
        self.blob += b"\0" * (-len(self.blob) % 4)
        start = len(self.blob)
        self.blob += data
        views = self.document["bufferViews"]
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(data), **more})
        return len(views) - 1

    def accessor(self, values: Any, dtype: str = "f4", **more: Any) -> int:
        array = np.asarray(values).astype("<" + dtype)
        width = 1 if array.ndim == 1 else array.shape[1]
        accessors = self.document["accessors"]
        accessors.append({
            "bufferView": self.view(array.tobytes()), "componentType": _COMPONENT[dtype],
            "count": len(array), "type": _TYPE[width], **more,
        })  # fmt: skip
        return len(accessors) - 1

    def primitive(self, vertices: Any, faces: Any = None, **more: Any) -> dict[str, Any]:
        """Adds a primitive to the first mesh, and returns it."""
        value: dict[str, Any] = {"attributes": {"POSITION": self.accessor(vertices)}, **more}
        if faces is not None:
            value["indices"] = self.accessor(np.ravel(faces), "u2")
        self.document["meshes"][0]["primitives"].append(value)
        return value

    def quad(self, material: dict[str, Any] | None = None, uv: Any = QUAD_UV) -> dict[str, Any]:
        """A square of one metre with this material; front to +z, its picture upright."""
        value = self.primitive(QUAD, QUAD_FACES)
        value["attributes"]["TEXCOORD_0"] = self.accessor(uv)
        if material is not None:
            self.document["materials"].append(material)
            value["material"] = len(self.document["materials"]) - 1
        return value

    def texture(self, pixels: Any, form: str = "PNG", **sampler: Any) -> dict[str, Any]:
        """Adds a picture and its sampler; returns a reference to the texture."""
        view = self.view(picture(pixels, form))
        self.document["images"].append({"bufferView": view, "mimeType": f"image/{form.lower()}"})
        self.document["samplers"].append(sampler)
        n = len(self.document["images"]) - 1
        self.document["textures"].append({"source": n, "sampler": n})
        return {"index": len(self.document["textures"]) - 1}

    def write(self, path: Path, form: str = "glb") -> Path:
        """Writes the file as "glb", "embedded" (.gltf in one file) or "separate" (with .bin)."""
        path.parent.mkdir(parents=True, exist_ok=True)
        buffer: dict[str, Any] = {"byteLength": len(self.blob)}
        if form == "embedded":
            data = base64.b64encode(self.blob).decode()
            buffer["uri"] = f"data:application/octet-stream;base64,{data}"
        elif form == "separate":
            path.with_suffix(".bin").write_bytes(self.blob)
            buffer["uri"] = path.with_suffix(".bin").name.replace(" ", "%20")
        document = {k: v for k, v in self.document.items() if v != []}
        text = json.dumps({"buffers": [buffer], **document}).encode()
        path.write_bytes(text if form != "glb" else glb(text, self.blob))
        return path


def glb(text: bytes, blob: bytes) -> bytes:
    """The bytes of a .glb file."""
    text += b" " * (-len(text) % 4)
    blob += b"\0" * (-len(blob) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(blob))
    head += struct.pack("<I4s", len(text), b"JSON") + text
    return head + struct.pack("<I4s", len(blob), b"BIN\0") + blob


def picture(pixels: Any, form: str = "PNG") -> bytes:
    """The bytes of a picture file of 8-bit pixels."""
    from PIL import Image

    handle = io.BytesIO()
    options = {"lossless": True} if form == "WEBP" else {}
    Image.fromarray(np.asarray(pixels, np.uint8)).save(handle, format=form, **options)
    return handle.getvalue()


def disc_picture(size: int = 64) -> np.ndarray:
    """A green disc of radius 0.4 of the picture, on magenta that alpha hides."""
    y, x = (np.indices((size, size)) + 0.5) / size - 0.5
    is_in = np.hypot(x, y) <= 0.4
    pixels = np.empty((size, size, 4), np.uint8)
    pixels[...] = np.where(is_in[..., None], [0, 128, 0, 255], [255, 0, 255, 0])
    return pixels


def rich_document() -> GltfBuilder:
    """A file with most features of the format: input of tests that damage files."""
    b = GltfBuilder(extensionsUsed=["KHR_texture_transform", "EXT_mesh_gpu_instancing"])
    b.texture(disc_picture(8), wrapS=33648)
    transform = {"KHR_texture_transform": {"scale": [2, 2], "rotation": 0.5}}
    reference = {"index": 0, "extensions": transform}
    b.quad({"alphaMode": "MASK", "pbrMetallicRoughness": {"baseColorTexture": reference}})
    glossy = {"diffuseTexture": {"index": 0}, "specularGlossinessTexture": {"index": 0}}
    b.quad({"extensions": {"KHR_materials_pbrSpecularGlossiness": glossy}, "alphaMode": "BLEND"})
    b.quad({"pbrMetallicRoughness": {"metallicRoughnessTexture": {"index": 0}}})["mode"] = 5
    box = b.primitive(BOX, BOX_FACES, material=2)
    box["attributes"]["COLOR_0"] = b.accessor(BOX > 0, "u1")
    b.document["meshes"][0]["weights"] = [0.5]
    box["targets"] = [{"POSITION": box["attributes"]["POSITION"]}]
    accessor = b.document["accessors"][box["attributes"]["POSITION"]]
    accessor["sparse"] = {
        "count": 1, "indices": {"bufferView": b.view(b"\1"), "componentType": 5121},
        "values": {"bufferView": b.view(np.array([0, 1, 0], np.float32).tobytes())},
    }  # fmt: skip
    person = b.primitive(BOX, BOX_FACES)
    b.document["meshes"][0]["primitives"].pop()
    person["attributes"]["JOINTS_0"] = b.accessor(np.tile([0, 1, 0, 0], (8, 1)), "u1")
    person["attributes"]["WEIGHTS_0"] = b.accessor(np.tile([128, 127, 0, 0], (8, 1)), "u1")
    b.document["meshes"].append({"primitives": [person]})
    bind = b.accessor(np.tile(np.eye(4).ravel(), (2, 1)))
    b.document["skins"] = [{"joints": [1, 2], "inverseBindMatrices": bind}]
    moves = b.accessor([[0, 0, 0], [3, 0, 0]])
    instances = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": moves}}}
    b.document["nodes"] = [
        {"mesh": 0, "children": [1], "extensions": instances, "scale": [1, -1, 1]},
        {"translation": [0, 1, 0], "children": [2]}, {"rotation": [0, 0, 0.6, 0.8]},
        {"mesh": 1, "skin": 0},
    ]  # fmt: skip
    b.document["scenes"] = [{"nodes": [0, 3]}]
    return b
