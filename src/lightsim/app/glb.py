"""Meshes as binary glTF for the viewer's scene, which is z up: vertices in the mesh's own frame.

The client of viser 1.1 (three.js) decides the layout. It shades a mesh without a NORMAL attribute
flat; for all others it computes the normals again, as the mean over the faces that share an index.
So vertices are shared where the surface is smooth, and split at creases, materials and borders of
texture patches. Base colours keep glTF's spaces: textures are sRGB, vertex colours linear.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from jaxtyping import Float32, Int, Int64, UInt8

from lightsim.core.colour import srgb8_from_linear
from lightsim.core.mesh import Material, TriMesh
from lightsim.core.resample import resize_area
from lightsim.errors import InputError
from lightsim.store.gltf_document import GltfCode
from lightsim.store.gltf_writer import GltfFile

MAX_TEXTURE_PX = 2048
"""Largest width and height of a texture: every WebGL implementation accepts it."""
_UNLIT = "KHR_materials_unlit"
# Quality of JPEG textures. On the atlas of a street (1818x1775 px) 90 gives 2.3 MB, PNG 6.1 MB.
_JPEG_QUALITY = 90
# Rounding of positions, metres, and of light, as a factor of base colour: powers of 2, whose zero
# bits compress.
_POSITION_STEP_M, _LIGHT_STEP = 2.0**-10, 2.0**-8
# Materials of open surfaces, which are seen from behind, too. For all others the client draws only
# the back of the faces into its shadow maps, so that a lit surface does not shade itself.
_TWO_SIDED = frozenset({"vegetation"})


def mesh_glb(mesh: TriMesh, light: Float32[np.ndarray, "m 3 3"] | None = None) -> bytes:
    """Return a mesh with its base colour as the bytes of a .glb file; axes are the mesh's own.

    Args:
        light: irradiance / pi at each face's three corners, RGB. With it the file shows the
            radiance, base colour times light, and the client does not shade it again. Equal for
            corners at one vertex with one `main_axis`.

    Raises:
        InputError: the mesh has no face.
    """
    if not len(mesh.faces):
        raise InputError("a mesh without faces cannot be shown", expected="one face or more")
    materials = [_material(material, mesh.texture is not None) for material in mesh.materials]
    if light is not None:
        materials = [{**material, "extensions": {_UNLIT: {}}} for material in materials]
    file = GltfFile(_document(materials) | ({} if light is None else {"extensionsUsed": [_UNLIT]}))
    if mesh.texture is not None:
        _add_jpeg(file, srgb8_from_linear(_bounded(mesh.texture.image)), is_periodic=False)
    primitives = [_primitive(file, mesh, number, faces, light) for number, faces in _groups(mesh)]
    file.document["meshes"] = [{"primitives": primitives}]
    return b"".join(file.to_bytes())


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
    material = {
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
        "extensions": {_UNLIT: {}},
    }
    file = GltfFile(_document([material]) | {"extensionsUsed": [_UNLIT]})
    _add_jpeg(file, srgb8, is_periodic=True)
    attributes = {"POSITION": file.add_positions(vertices), "TEXCOORD_0": file.add_accessor(uv)}
    indices = file.add_accessor(faces.reshape(-1), GltfCode.ELEMENT_ARRAY_BUFFER)
    primitive = {"attributes": attributes, "indices": indices, "material": 0}
    file.document["meshes"] = [{"primitives": [primitive]}]
    return b"".join(file.to_bytes())


def _document(materials: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "asset": {"version": "2.0", "generator": "LightSim"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "materials": materials,
        "accessors": [],
        "bufferViews": [],
    }


def _material(material: Material, is_textured: bool) -> dict[str, Any]:
    texture = {"baseColorTexture": {"index": 0}} if is_textured else {}
    surface = {
        "roughnessFactor": float(material.roughness),
        "metallicFactor": float(material.metallic),
        **texture,
    }
    return {
        "name": material.name,
        "pbrMetallicRoughness": surface,
        "doubleSided": material.name in _TWO_SIDED,
    }


def _add_jpeg(file: GltfFile, srgb8: UInt8[np.ndarray, "h w 3"], *, is_periodic: bool) -> None:
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


def _primitive(
    file: GltfFile,
    mesh: TriMesh,
    material: int,
    faces: Int64[np.ndarray, " k"],
    light: Float32[np.ndarray, "m 3 3"] | None,
) -> dict[str, Any]:
    """Add the faces of one material. They share no vertex with other materials: the client would
    overwrite the normals of shared ones."""
    corners = mesh.faces[faces].reshape(-1)
    keys = [corners, np.repeat(main_axis(mesh, faces), 3)]
    if mesh.texture is not None:
        # Equal coordinates are equal bits: patches of one chart repeat them.
        uv = mesh.texture.corner_uv[faces].reshape(-1, 2)
        keys.extend(np.ascontiguousarray(uv).view(np.int32).T)
    _, first, indices = np.unique(
        np.stack(keys, axis=1), axis=0, return_index=True, return_inverse=True
    )
    number = corners[first]
    triangles = indices.reshape(-1, 3).astype(np.int32)
    part = TriMesh(mesh.frame, mesh.vertices[number], triangles, mesh.base_colour[number])
    attributes = {"POSITION": file.add_positions(_rounded(part.vertices, _POSITION_STEP_M))}
    colour = None if mesh.texture is not None else np.clip(part.base_colour, 0.0, 1.0)
    if light is None:
        attributes["NORMAL"] = file.add_accessor(_unit_normals(part))
    else:
        lit = _rounded(light[faces].reshape(-1, 3)[first], _LIGHT_STEP)
        colour = lit if colour is None else colour * lit
    if colour is not None:
        attributes["COLOR_0"] = file.add_accessor(colour)
    if mesh.texture is not None:
        size = np.array(mesh.texture.image.shape[1::-1], dtype=np.float32)
        coordinates = mesh.texture.corner_uv[faces].reshape(-1, 2)[first] / size
        attributes["TEXCOORD_0"] = file.add_accessor(coordinates)
    return {
        "attributes": attributes,
        "indices": file.add_accessor(triangles.reshape(-1), GltfCode.ELEMENT_ARRAY_BUFFER),
        "material": material,
    }


def _rounded(values: Float32[np.ndarray, "n 3"], step: float) -> Float32[np.ndarray, "n 3"]:
    return np.round(values / np.float32(step)) * np.float32(step)


def main_axis(mesh: TriMesh, faces: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, " k"]:
    """Return which of the six directions along the axes is nearest to the normal of each face.

    Faces of two directions share no vertex, so that edges of 90 degrees remain sharp.
    """
    normals = mesh.face_normals()[faces]
    axis = np.abs(normals).argmax(axis=1)
    is_positive = np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0
    return 2 * axis + is_positive


def _unit_normals(mesh: TriMesh) -> Float32[np.ndarray, "n 3"]:
    """Return the normals of the vertices; up where all faces of a vertex are degenerate."""
    normals = mesh.vertex_normals()
    normals[~normals.any(axis=1)] = (0.0, 0.0, 1.0)
    return normals
