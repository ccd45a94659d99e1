"""Unlit meshes as binary glTF for the viewer's scene, z up: vertices in the mesh's own frame.

The client of viser 1.1 (three.js) shows base colour times vertex colour of such files and adds no
shading. Base colours keep glTF's spaces: textures are sRGB, vertex colours linear.
"""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float32, Int, Int64, UInt8

from lightsim.core.colour import srgb8_from_linear
from lightsim.core.mesh import TriMesh
from lightsim.core.resample import resize_area
from lightsim.errors import InputError
from lightsim.store.gltf_document import GltfCode
from lightsim.store.gltf_writer import GltfFile

MAX_TEXTURE_PX = 2048
"""Largest width and height of a texture: every WebGL implementation accepts it."""
_UNLIT = "KHR_materials_unlit"
# Quality of JPEG textures. On the atlas of a street (1818x1775 px) 90 gives 2.3 MB, PNG 6.1 MB.
_JPEG_QUALITY = 90
# Rounding of positions, metres: a power of 2, so that trailing bits are 0 and compress well.
_POSITION_STEP_M = 2.0**-10
# Rounding of light, as a factor of base colour, for the same reason.
_LIGHT_STEP = 2.0**-8
# Materials of open surfaces, which are seen from behind, too.
_TWO_SIDED = frozenset({"vegetation"})


class LitFile:
    """A mesh as a binary glTF file whose light can be exchanged: all else is encoded once.

    Args:
        mesh: with one face or more.
        point: index of the point from which each corner of a face takes its light.

    Raises:
        InputError: the mesh has no face.
    """

    def __init__(self, mesh: TriMesh, point: Int64[np.ndarray, "m 3"]) -> None:
        if not len(mesh.faces):
            raise InputError("a mesh without faces cannot be shown", expected="one face or more")
        texture = {} if mesh.texture is None else {"baseColorTexture": {"index": 0}}
        materials = [
            {
                "name": material.name,
                "pbrMetallicRoughness": texture,
                "doubleSided": material.name in _TWO_SIDED,
            }
            for material in mesh.materials
        ]
        self._file = GltfFile(_document(materials))
        if mesh.texture is not None:
            _add_jpeg(self._file, srgb8_from_linear(_bounded(mesh.texture.image)), False)
        # For each material: buffer view of the colours, and point and base colour of the vertices.
        self._colours: list[
            tuple[int, Int64[np.ndarray, " n"], Float32[np.ndarray, "n 3"] | None]
        ] = []
        primitives = [
            self._add_primitive(mesh, material, faces, point) for material, faces in _groups(mesh)
        ]
        self._file.document["meshes"] = [{"primitives": primitives}]

    def glb(self, light: Float32[np.ndarray, "p 3"]) -> bytes:
        """Return the file with light: it shows the radiance, base colour times light.

        Args:
            light: irradiance / pi at each point, RGB.
        """
        blobs = list(self._file.blobs)
        rounded = np.round(light / np.float32(_LIGHT_STEP)) * np.float32(_LIGHT_STEP)
        for view, number, base_colour in self._colours:
            colour = rounded[number]
            colour = colour if base_colour is None else base_colour * colour
            blobs[view] = colour.astype("<f4").tobytes()
        return b"".join(replace(self._file, blobs=blobs).to_bytes())

    def _add_primitive(
        self,
        mesh: TriMesh,
        material: int,
        faces: Int64[np.ndarray, " k"],
        point: Int64[np.ndarray, "m 3"],
    ) -> dict[str, Any]:
        """Add the faces of one material; the colours remain 0."""
        file, keys = self._file, [point[faces].reshape(-1)]
        if mesh.texture is not None:
            # Equal coordinates are equal bits: patches of one chart repeat them.
            uv = mesh.texture.corner_uv[faces].reshape(-1, 2)
            keys.extend(np.ascontiguousarray(uv).view(np.int32).T)
        _, first, indices = np.unique(
            np.stack(keys, axis=1), axis=0, return_index=True, return_inverse=True
        )
        number = mesh.faces[faces].reshape(-1)[first]
        steps = np.round(mesh.vertices[number] / np.float32(_POSITION_STEP_M))
        attributes = {
            "POSITION": file.add_positions(steps * np.float32(_POSITION_STEP_M)),
            "COLOR_0": file.add_accessor(np.zeros((len(number), 3), np.float32)),
        }
        view = file.document["accessors"][attributes["COLOR_0"]]["bufferView"]
        colour = None
        if mesh.texture is None:
            colour = np.clip(mesh.base_colour[number], 0.0, 1.0)
        else:
            size = np.array(mesh.texture.image.shape[1::-1], dtype=np.float32)
            coordinates = mesh.texture.corner_uv[faces].reshape(-1, 2)[first] / size
            attributes["TEXCOORD_0"] = file.add_accessor(coordinates)
        self._colours.append((view, point[faces].reshape(-1)[first], colour))
        triangles = file.add_accessor(indices.reshape(-1), GltfCode.ELEMENT_ARRAY_BUFFER)
        return {"attributes": attributes, "indices": triangles, "material": material}


def unlit_glb(
    vertices: Float32[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    uv: Float32[np.ndarray, "n 2"],
    srgb8: UInt8[np.ndarray, "h w 3"],
) -> bytes:
    """Return a surface that shows its texture without shading, on the front of its faces only.

    Args:
        uv: fractions of the texture's width and height from its upper left corner; the texture
            repeats along u.
    """
    file = GltfFile(_document([{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]))
    _add_jpeg(file, srgb8, is_periodic=True)
    attributes = {"POSITION": file.add_positions(vertices), "TEXCOORD_0": file.add_accessor(uv)}
    indices = file.add_accessor(faces.reshape(-1), GltfCode.ELEMENT_ARRAY_BUFFER)
    primitive = {"attributes": attributes, "indices": indices, "material": 0}
    file.document["meshes"] = [{"primitives": [primitive]}]
    return b"".join(file.to_bytes())


def _document(materials: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "asset": {"version": "2.0", "generator": "LightSim"},
        "extensionsUsed": [_UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "materials": [{**material, "extensions": {_UNLIT: {}}} for material in materials],
        "accessors": [],
        "bufferViews": [],
    }


def _add_jpeg(file: GltfFile, srgb8: UInt8[np.ndarray, "h w 3"], is_periodic: bool) -> None:
    """Add the only texture; without mipmaps, which would mix texels of adjacent patches."""
    from PIL import Image

    handle = io.BytesIO()
    # Colours at full resolution: patches of one atlas differ in colour.
    Image.fromarray(srgb8).save(handle, "JPEG", quality=_JPEG_QUALITY, subsampling=0)
    picture = {"bufferView": file.add_view(handle.getvalue()), "mimeType": "image/jpeg"}
    file.document["images"] = [picture]
    across = GltfCode.REPEAT if is_periodic else GltfCode.CLAMP_TO_EDGE
    wrap = {"wrapS": across, "wrapT": GltfCode.CLAMP_TO_EDGE}
    filters = {"magFilter": GltfCode.LINEAR, "minFilter": GltfCode.LINEAR}
    file.document["samplers"] = [{**filters, **wrap}]
    file.document["textures"] = [{"source": 0, "sampler": 0}]


def _bounded(image: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h2 w2 3"]:
    """Return a texture of at most `MAX_TEXTURE_PX` in both directions."""
    height, width = (min(size, MAX_TEXTURE_PX) for size in image.shape[:2])
    return image if (height, width) == image.shape[:2] else resize_area(image, height, width)


def _groups(mesh: TriMesh) -> list[tuple[int, Int64[np.ndarray, " k"]]]:
    """Return the face numbers of each material that has faces."""
    if mesh.face_material is None:
        return [(0, np.arange(len(mesh.faces)))]
    found = [np.flatnonzero(mesh.face_material == k) for k in range(len(mesh.materials))]
    return [(number, faces) for number, faces in enumerate(found) if len(faces)]
